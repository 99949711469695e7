"""Two studies of whether exposures and poses that were disturbed on purpose are found again.

Here are their names and arguments; the work is in :mod:`.exposures` and :mod:`.poses`, which load what is heavy, and so
wait until a study runs.
"""

import argparse
from pathlib import Path

from minisplat_ref.experiments.arguments import integer
from minisplat_ref.study import Study


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", metavar="SCENE", help="a synthetic scene: room, plain-wall, glossy or outdoor")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder for the JSON and the figure")
    parser.add_argument(
        "--iterations", type=integer(1), default=3000, metavar="N", help="of each of three trainings (default 3000)"
    )
    parser.add_argument("--views", type=integer(4), default=24, metavar="V", help="to train on (default 24)")
    parser.add_argument("--width", type=integer(16), default=160, metavar="PX", help="of 4:3 images (default 160)")
    parser.add_argument(
        "--seed", type=integer(0), default=0, metavar="S", help="of the disturbance and the trainings (default 0)"
    )


def _add_pose_arguments(parser: argparse.ArgumentParser) -> None:
    _add_arguments(parser)
    parser.add_argument(
        "--degrees", type=float, default=0.5, metavar="A", help="by which each camera is turned (default 0.5)"
    )
    parser.add_argument(
        "--shift", type=float, default=0.005, metavar="F", help="of the extent, of each camera (default 0.005)"
    )


def _run_exposure(args: argparse.Namespace) -> None:
    from minisplat_ref.experiments.studies import exposures

    exposures.run(args)


def _run_pose(args: argparse.Namespace) -> None:
    from minisplat_ref.experiments.studies import poses

    poses.run(args)


EXPOSURE_STUDY = Study(
    name="exposure",
    summary="exposure per photograph: disturbed by known maps, and recovered",
    add_arguments=_add_arguments,
    run=_run_exposure,
)
POSE_STUDY = Study(
    name="pose",
    summary="pose refinement: cameras moved by known amounts, and recovered",
    add_arguments=_add_pose_arguments,
    run=_run_pose,
)
