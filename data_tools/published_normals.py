"""Runs of Lego measured by the normals that are published with its test images.

``python -m data_tools.published_normals RUN --data DIR`` prints the mean and median angle between the normals of the
surface through the run's expected depths and those of the files ``test/r_*_normal_0001.png`` in DIR.

The files have no negative numbers: each component of a world-space normal is cut off at 0 and stored in sRGB. So a
normal is known only where the components that are left have the length 1; elsewhere nothing is compared. Counted are
pixels that the image covers altogether and the run at least by half, without those of the border.
"""

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from data_tools.claims import kit
from minisplat_ref.app.runs.opened_run import Run, open_run
from minisplat_ref.errors import InputError
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.interface.reporting import describe_machine, markdown_table
from minisplat_ref.io import read_image
from minisplat_ref.io.srgb import decode_srgb
from minisplat_ref.mechanisms.depth_maps.normals import central_normals
from minisplat_ref.reference.depth import expected_depth
from minisplat_ref.types import Bools, Floats

LENGTH_ERROR_MAX = 0.02  # of a normal whose components are all there; rounding to bytes makes it 0.01 at most
COVERED = 255  # alpha of a pixel that the image covers altogether
ALPHA_MIN = 0.5  # of a rendered pixel that has a surface


class Known(NamedTuple):
    """What a test view's files say of its normals."""

    normals: Floats
    """[H, W, 3] world frame."""
    is_known: Bools
    """[H, W] pixels whose normal is known."""
    is_covered: Bools
    """[H, W] pixels that the image covers altogether."""


def read_normals(image: Path) -> Known:
    """Read the normals that are published with a test image.

    Raises
    ------
    InputError
        A file is missing, or the image has no alpha.
    """
    pixels, encoded = read_image(image), read_image(image.with_name(f"{image.stem}_normal_0001.png"))
    if pixels.shape[2] < 4:
        raise InputError(f"{image} has no alpha: it is not of NeRF-Synthetic")
    normals = decode_srgb(encoded[..., :3] / 255)
    is_whole = np.abs(np.linalg.norm(normals, axis=2) - 1) < LENGTH_ERROR_MAX
    is_covered = pixels[..., 3] == COVERED
    return Known(normals, is_whole & is_covered, is_covered)


class Angles(NamedTuple):
    """The errors of a run's normals."""

    mean: float
    """Degrees."""
    median: float
    """Degrees."""
    share: float
    """Part of the covered pixels that are compared."""


def measure(run: Run, data: Path) -> Angles:
    """Compare the normals of a run with the published ones.

    Raises
    ------
    InputError
        A file is missing, or nothing can be compared.
    """
    angles, n_covered = [], 0
    for view in with_progress(run.scene.test_views, "test views"):
        known = read_normals(data / "test" / f"{view.name.removeprefix('test_')}.png")
        output, _ = run.render_settings.render_view(run.model, view, frozenset({"depth"}))
        depth = expected_depth(output.image[..., 3], output.alpha).astype(np.float64)
        found = central_normals(depth, view.camera) @ view.camera.cam_from_world_R
        is_counted = known.is_known & (output.alpha > ALPHA_MIN) & found.any(axis=2)
        angles.append(kit.angles(found[is_counted], known.normals[is_counted]))
        n_covered += int(known.is_covered.sum())
    together = np.concatenate(angles) if angles else np.zeros(0)
    if not len(together):
        raise InputError(f"no pixel of {run.folder} can be compared with a normal of {data}")
    return Angles(float(together.mean()), float(np.median(together)), len(together) / n_covered)


def main(arguments: list[str] | None = None) -> int:
    """Measure runs by their normals."""
    parser = argparse.ArgumentParser(prog="python -m data_tools.published_normals", description=__doc__.split("\n")[0])
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="--out folder of a training")
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="folder of Lego")
    args = parser.parse_args(arguments)
    rows = []
    try:
        for folder in args.runs:
            run = open_run(folder)
            found = measure(run, args.data)
            n_gaussians = f"{len(run.model.gaussians.means):,}"
            rows.append([folder.name, n_gaussians, f"{found.mean:.1f}", f"{found.median:.1f}", f"{found.share:.2f}"])
    except InputError as error:
        print(f"published_normals: error: {error}", file=sys.stderr)
        return 2
    heading = ["run", "Gaussians", "mean angle (degrees)", "median", "part of the pixels"]
    print(f"{describe_machine()}\n\n{markdown_table(heading, rows)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
