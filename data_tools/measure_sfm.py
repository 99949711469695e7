"""Measure what ``sfm`` makes of folders of photographs: cameras, points and time, as docs/measured/sfm.md reports.

``python -m data_tools.measure_sfm PHOTOS...`` prints two tables: the results, and the parts of the work with their
times. Where a COLMAP model of the same photographs lies beside the folder (``../sparse/0``), the camera centres are
compared with it. Processor seconds are those of all threads, so that other work on the machine matters little.
"""

import argparse
import shutil
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from minisplat_ref.app.cli.sfm import FEATURES, MATCHINGS
from minisplat_ref.datasets.sfm import run_sfm
from minisplat_ref.datasets.sfm.attempts import Part
from minisplat_ref.interface.reporting import describe_machine, markdown_table
from minisplat_ref.io.colmap import find_model, read_model
from minisplat_ref.io.lens import import_quiet_pycolmap
from minisplat_ref.types import Floats

HEADING = (
    "photographs",
    "mapper",
    "features",
    "placed",
    "points",
    "matches explained",
    "centres off by",
    "processor s",
)
PARTS_HEADING = ("photographs", "part", "photographs or pairs", "processor s", "each")


def measure(photos: Path, features: str, matching: str | None, work: Path) -> tuple[list[list[str]], list[list[str]]]:
    """Make a scene; return a row for each result, the one that was kept first, and a row for each part of the work."""
    scene = work / "scene"
    start = time.process_time()
    result = run_sfm(photos, scene, features=features, matching=matching)
    seconds = time.process_time() - start
    error = f"{center_error(scene, photos.parent):.2%}" if find_model(photos.parent) is not None else ""
    rows = [
        [
            "",
            mapped.mapper,
            mapped.features,
            f"{mapped.n_placed} of {result.n_photos}",
            f"{mapped.n_points:,}",
            f"{mapped.n_explained / result.n_matches:.1%}",
            "",
            "",
        ]
        for mapped in (result.kept, *result.others)
    ]
    rows[0][0], rows[0][6:] = f"**{photos.parent.name}**", [error, f"{seconds:.0f}"]
    shutil.rmtree(scene)
    return rows, describe_parts(photos.parent.name, result.parts)


def describe_parts(name: str, parts: Sequence[Part]) -> list[list[str]]:
    """Return a row for each part of the work; the first one has the name of the photographs."""
    rows = [["", part.name, f"{part.n:,}", f"{part.seconds:.1f}", f"{part.seconds / part.n:.2f}"] for part in parts]
    rows[0][0] = f"**{name}**"
    return rows


def center_error(scene: Path, reference: Path) -> float:
    """Return the median distance of camera centres after a similarity, relative to the cameras' extent."""
    found, truth = (_centers(path) for path in (scene, reference))
    names = sorted(found.keys() & truth.keys())
    a, b = (np.stack([centers[name] for name in names]) for centers in (found, truth))
    b_from_a = import_quiet_pycolmap().estimate_sim3d(a, b).matrix()  # [3, 4]
    errors = np.linalg.norm(a @ b_from_a[:, :3].T + b_from_a[:, 3] - b, axis=1)
    return float(np.median(errors) / np.linalg.norm(b - b.mean(axis=0), axis=1).max())


def _centers(scene: Path) -> dict[str, Floats]:
    """Return the camera centres of a scene by the names of its photographs."""
    images = read_model(scene).images.values()
    return {Path(image.name).stem: image.projection_center() for image in images if image.has_pose}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path, nargs="+", metavar="PHOTOS", help="folders of photographs")
    parser.add_argument("--features", choices=FEATURES, default=FEATURES[0], metavar="F", help="default: auto")
    parser.add_argument("--matching", choices=MATCHINGS, default=MATCHINGS[0], metavar="M", help="default: auto")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as work:
        measured = [measure(photos, args.features, args.matching, Path(work)) for photos in args.photos]
    results, parts = ([row for rows in part for row in rows] for part in zip(*measured, strict=True))
    print("", describe_machine(), sep="\n")
    for heading, rows in ((HEADING, results), (PARTS_HEADING, parts)):
        print("", markdown_table(heading, rows, is_aligned=False), sep="\n")


if __name__ == "__main__":
    main()
