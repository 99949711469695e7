"""How right the points of a dense start are, on scenes of known depth.

``python -m data_tools.measure_stereo [SCENE ...]`` makes synthetic scenes of 14 views of 192 x 144 pixels, of which two
are test views, finds points by :func:`minisplat_ref.training.dense_start.densify_points`, and prints how many of them
lie more than 5 % of their distance from the nearest camera away from everything that a photograph shows.
"""

import argparse
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from minisplat_ref.datasets.synthetic import SyntheticScene, make_scene
from minisplat_ref.interface.reporting import describe_machine, markdown_table
from minisplat_ref.strategy.plane_sweep import surface_points
from minisplat_ref.training.dense_start import densify_points
from minisplat_ref.types import Floats

SCENES = ("outdoor", "room", "staircase", "park-1")
SIZE: dict[str, Any] = {"width": 192, "height": 144, "n_views": 14, "supersampling": 1, "n_points": 2000}
TOLERANCE = 0.05
HEADING = ("scene", "points", "off by more than 5 %", "processor seconds")


def errors_of(made: SyntheticScene, points: Floats) -> Floats:
    """Return the distance of points [P] from all surfaces that are shown, over that from the nearest camera."""
    shown, centers = [], []
    for view, depths in zip(made.scene.train_views, made.train_depths, strict=True):
        shown.append(surface_points(view.camera, depths, *np.nonzero(depths > 0)))
        centers.append(view.camera.center)
    return cKDTree(np.concatenate(shown)).query(points)[0] / cKDTree(np.array(centers)).query(points)[0]


def measure(made: SyntheticScene) -> list[str]:
    """Return the row of a scene, as in :data:`HEADING`."""
    start = time.process_time()
    points = densify_points(made.scene)[0][len(made.scene.points) :]
    seconds = time.process_time() - start
    share = np.mean(errors_of(made, points) > TOLERANCE) if len(points) else 0.0
    return [made.scene.name, f"{len(points):,}", f"{share:.1%}", f"{seconds:.1f}"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m data_tools.measure_stereo", description=__doc__.split("\n\n")[0])
    parser.add_argument("scenes", nargs="*", metavar="SCENE", default=SCENES, help="synthetic scenes with surfaces")
    names = parser.parse_args(arguments).scenes
    rows = [measure(make_scene(name, **SIZE)) for name in names]
    print(describe_machine(), "", markdown_table(HEADING, rows), sep="\n")


if __name__ == "__main__":
    main()
