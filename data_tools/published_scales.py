"""Runs measured at the size of their photographs, and at 1/2, 1/4 and 1/8 of it, as Mip-Splatting's tables have it.

``python -m data_tools.published_scales RUN [RUN ...]`` prints the PSNR of the test views of each run at every size, the
mean over the views, and the mean over the sizes. The run was trained at the full size alone: Yu et al. 2023 (arXiv
2311.16493) call it "single-scale training and multi-scale testing". A smaller image has the same camera with fewer
pixels, and is compared with means over blocks of the photograph's pixels.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from data_tools.claims import kit
from minisplat_ref.app.runs.opened_run import Run, open_run
from minisplat_ref.errors import InputError
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.interface.reporting import describe_machine, markdown_table
from minisplat_ref.mechanisms.sampling import zoom_camera
from minisplat_ref.types import view_from

SIDES = (1, 2, 4, 8)  # pixels of the photograph along the side of a pixel of the image


def measure(run: Run) -> list[float]:
    """Return the PSNR of the test views, dB, the mean over the views for each of ``SIDES``.

    Raises
    ------
    InputError
        There are no test views, or one has fewer than 8 pixels along a side.
    """
    if not run.scene.test_views:
        raise InputError(f"{run.folder} has no test views: train with --test-every above 0")
    found = []
    for view in with_progress(run.scene.test_views, "test views"):
        photograph = view.load()
        if min(photograph.camera.width, photograph.camera.height) < SIDES[-1]:
            raise InputError(f"test view {view.name} of {run.folder} has no pixel left at 1/{SIDES[-1]} of its size")
        cameras = [zoom_camera(photograph.camera, 1 / n) for n in SIDES]
        images = [run.render_settings.render_view(run.model, view_from(camera))[0].image for camera in cameras]
        pairs = zip(images, SIDES, strict=True)
        found.append([kit.psnr_of(image, kit.photograph_at(photograph, n)) for image, n in pairs])
    return [float(mean) for mean in np.mean(found, axis=0)]


def main(arguments: list[str] | None = None) -> int:
    """Measure runs at every size."""
    parser = argparse.ArgumentParser(prog="python -m data_tools.published_scales", description=__doc__.split("\n")[0])
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="--out folder of a training")
    args = parser.parse_args(arguments)
    rows = []
    try:
        for folder in args.runs:
            run = open_run(folder)
            found = measure(run)
            n_gaussians = f"{len(run.model.gaussians.means):,}"
            rows.append([folder.name, n_gaussians, *(f"{x:.2f}" for x in [*found, float(np.mean(found))])])
    except InputError as error:
        print(f"published_scales: error: {error}", file=sys.stderr)
        return 2
    heading = ["run", "Gaussians", *("1" if n == 1 else f"1/{n}" for n in SIDES), "mean"]
    print(f"{describe_machine()}\n\n{markdown_table(heading, rows)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
