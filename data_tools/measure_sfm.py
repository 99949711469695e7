"""Measure what ``sfm`` makes of folders of photographs: cameras, points and time, as docs/measured/sfm.md reports.

``python -m data_tools.measure_sfm PHOTOS...`` prints a table. Where a COLMAP model of the same photographs lies beside
the folder (``../sparse/0``), the camera centres are compared with it. Processor seconds are those of all threads, so
that other work on the machine matters little.
"""

import argparse
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np

from minisplat_ref.app.cli.sfm import FEATURES
from minisplat_ref.datasets.sfm import run_sfm
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


def measure(photos: Path, features: str, work: Path) -> list[list[str]]:
    """Make a scene; return a row of the table for each result, the one that was kept first."""
    scene = work / "scene"
    start = time.process_time()
    result = run_sfm(photos, scene, features=features)
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
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as work:
        rows = [row for photos in args.photos for row in measure(photos, args.features, Path(work))]
    print(f"\n{describe_machine()}\n\n{markdown_table(HEADING, rows, is_aligned=False)}")


if __name__ == "__main__":
    main()
