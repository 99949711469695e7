"""The studies of this package: smaller claims of the papers, measured. ``minisplat-ref study NAME --help``.

==========================  =====================================================================
:data:`ADAPTIVE`            :mod:`.adaptive`: the recipe that decides for itself, beside those with a schedule
:data:`ABLATION`            :mod:`.ablation`: what each mechanism of Mini-Splatting is worth
:data:`SPLIT`               :mod:`.split_forms`: which children blur split has, and whether any
:data:`CULLING`             :mod:`.culling`: what visibility culling removes, saves and costs
:data:`SIMPLIFY`            :mod:`.simplify`: sampling, rank and mass, and merging at equal counts
:data:`DEPTH`               :mod:`.depth_types`: from which depth Gaussians begin anew
:data:`EXPOSURE`            :mod:`.exposures`: exposures that were disturbed, found again
:data:`POSE`                :mod:`.poses`: poses that were disturbed, found again
:data:`DEFECTS`             :mod:`.defects`: planted defects of photographs, found by ``adaptive`` where they are
:data:`PRECISION`           :mod:`.precision`: a training in float64, float32, and with colours in float16
==========================  =====================================================================

This module has their names and arguments. The other modules do the work and load matplotlib and Numba, so they are
imported when a study runs. :mod:`.front` has what they share, and :mod:`.conditions` how they disturb a scene.
"""

import argparse
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from minisplat_ref.arguments import SYNTHETIC_SCENES, fraction, integer, list_of, name
from minisplat_ref.studies.study import Study

RESULT, FIGURE = "result.json", "figure.png"  # files that every study writes
RECIPE_HELP = "name as in train --recipe"
CONDITION_HELP = (
    "whole, few (every fifth photograph), gains (wrong exposures), few-gains (both), poses (wrong cameras),"
    " sizes (every second at half the size), sky (synthetic scenes, cut off)"
)


def all_studies() -> dict[str, Study]:
    """Return the studies of this package by the name that users type; an extension's are EXTENSION/NAME."""
    studies = (ADAPTIVE, ABLATION, SPLIT, CULLING, SIMPLIFY, DEPTH, EXPOSURE, POSE, DEFECTS, PRECISION)
    return {study.name: study for study in studies}


def _run_of(module: str) -> Callable[[argparse.Namespace], None]:
    """Return ``run`` of a module of this folder, which is imported when it is called."""

    def run(args: argparse.Namespace) -> None:
        import_module(f"{__name__}.{module}").run(args)

    return run


def _add_folder_arguments(parser: argparse.ArgumentParser, iterations: int, whose: str) -> None:
    """Add ``--out`` and ``--iterations``."""
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help=f"new folder for {RESULT} and {FIGURE}")
    parser.add_argument(
        "--iterations", type=integer(1), default=iterations, metavar="N", help=f"{whose} (default {iterations})"
    )


def _add_scene_arguments(parser: argparse.ArgumentParser, iterations: int) -> None:
    """Add a scene of any kind, ``--downscale``, ``--out`` and ``--iterations``."""
    names = ", ".join(SYNTHETIC_SCENES)
    parser.add_argument("scene", metavar="SCENE", help=f"folder of a scene, or a synthetic one: {names}")
    _add_folder_arguments(parser, iterations, "of a training")
    parser.add_argument(
        "--downscale", type=integer(1), default=1, metavar="D", help="make a folder's photographs D times smaller"
    )


def _add_resumed_scene_arguments(parser: argparse.ArgumentParser) -> None:
    """Add a scene of any kind, ``--downscale`` and a folder with which the study goes on."""
    names = ", ".join(SYNTHETIC_SCENES)
    parser.add_argument("scene", metavar="SCENE", help=f"folder of a scene, or a synthetic one: {names}")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help=f"folder for {RESULT} and {FIGURE}")
    parser.add_argument(
        "--downscale", type=integer(1), default=1, metavar="D", help="make a folder's photographs D times smaller"
    )


def _add_seeds(parser: argparse.ArgumentParser) -> None:
    """Add ``--seeds``."""
    parser.add_argument(
        "--seeds", type=list_of(integer(0)), default=(0, 1, 2), metavar="S,T", help="of the trainings (default 0,1,2)"
    )


def _add_adaptive_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Train a scene by adaptive and by recipes with a schedule, as it is and\ndisturbed. The same command with "
        "the same folder goes on where it was\ninterrupted."
    )
    _add_resumed_scene_arguments(parser)
    parser.add_argument(
        "--recipes",
        type=list_of(name),
        default=("3dgs-accel", "mini-splatting", "mini-splatting2", "adaptive"),
        metavar="R,Q",
        help="the first is what the others are compared with; also names of --rules (default: three of 3000 iterations,"
        " and adaptive)",
    )
    variants = parser.add_mutually_exclusive_group()
    variants.add_argument("--rules", action="store_true", help="adaptive beside itself without each of its rules")
    variants.add_argument("--candidates", action="store_true", help="adaptive beside itself with rules it lacks")
    variants.add_argument("--sweep", action="store_true", help="adaptive beside itself with more Gaussians and fewer")
    parser.add_argument(
        "--conditions",
        type=list_of(name),
        default=("whole", "few", "gains"),
        metavar="C,D",
        help=f"{CONDITION_HELP} (default: the first three)",
    )
    _add_seeds(parser)


def _add_ablation_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Train a scene by a recipe, and by the recipe without each of its mechanisms. The\nsame command with the same "
        "folder goes on where it was interrupted."
    )
    _add_scene_arguments(parser, iterations=6000)
    parser.add_argument(
        "--recipe", type=name, default="mini-splatting2", metavar="R", help=f"{RECIPE_HELP} (default %(default)s)"
    )
    parser.add_argument(
        "--deviations", action="store_true", help="take back what deviates from the published method instead"
    )
    parser.add_argument(
        "--condition", type=name, default="whole", metavar="C", help=f"{CONDITION_HELP} (default whole)"
    )
    _add_seeds(parser)


def _add_split_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Train a scene with blur split in its two forms and without it."
    _add_scene_arguments(parser, iterations=3000)
    parser.add_argument(
        "--recipe", type=name, default="mini-splatting-d", metavar="R", help=f"{RECIPE_HELP} (default %(default)s)"
    )
    _add_seeds(parser)


def _add_culling_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Train a scene with mini-splatting2, and measure what visibility culling does."
    _add_scene_arguments(parser, iterations=1800)
    parser.add_argument("--ply", type=Path, metavar="FILE", help="measure these Gaussians, and train nothing")
    parser.add_argument("--seed", type=integer(0), default=0, metavar="S", help="of the training (default 0)")
    parser.add_argument(
        "--repeats", type=integer(1), default=100, metavar="N", help="iterations to time, of either kind (default 100)"
    )


def _add_simplify_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Simplify a dense population in several ways to equal numbers, and fine-tune\nwhat is left."
    _add_scene_arguments(parser, iterations=3000)
    parser.add_argument(
        "--recipe",
        type=name,
        default="mini-splatting-d",
        metavar="R",
        help=f"of the dense population, {RECIPE_HELP} (default %(default)s)",
    )
    parser.add_argument("--ply", type=Path, metavar="FILE", help="simplify these Gaussians, and train none")
    parser.add_argument(
        "--fractions",
        type=list_of(fraction),
        default=(0.05, 0.1, 0.2, 0.4),
        metavar="F,G",
        help="of the candidates to keep (default 0.05,0.1,0.2,0.4)",
    )
    parser.add_argument(
        "--fine-tune", type=integer(1), default=500, metavar="M", help="iterations after simplification (default 500)"
    )
    parser.add_argument(
        "--restart", action="store_true", help="fine-tune from centres and colours alone, as mini-splatting does"
    )
    _add_seeds(parser)


def _add_depth_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Train a synthetic scene by a recipe that reinitialises from depth, which is done\n"
        "in several ways, and compare with the truth."
    )
    parser.add_argument("scene", metavar="SCENE", help=f"a synthetic scene: {', '.join(SYNTHETIC_SCENES)}")
    _add_folder_arguments(parser, 3000, "of a training")
    parser.add_argument(
        "--recipe", type=name, default="mini-splatting", metavar="R", help=f"{RECIPE_HELP} (default %(default)s)"
    )
    _add_seeds(parser)


def _add_calibration_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", metavar="SCENE", help=f"a synthetic scene: {', '.join(SYNTHETIC_SCENES)}")
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
    _add_calibration_arguments(parser)
    parser.add_argument(
        "--degrees", type=float, default=0.5, metavar="A", help="by which each camera is turned (default 0.5)"
    )
    parser.add_argument(
        "--shift", type=float, default=0.005, metavar="F", help="of the extent, of each camera (default 0.005)"
    )


def _add_defects_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Disturb the photographs of a scene in known ways, and count what adaptive\nswitches on. The same command with "
        "the same folder goes on where it was\ninterrupted."
    )
    _add_resumed_scene_arguments(parser)
    parser.add_argument(
        "--conditions",
        type=list_of(name),
        default=(),
        metavar="C,D",
        help="clean, gains, poses, sizes, sky (default: all, sky of synthetic scenes alone)",
    )
    parser.add_argument(
        "--asked",
        type=list_of(name),
        default=("sky", "exposure", "pose", "antialiasing"),
        metavar="A,B",
        help="train until it is decided about these alone (default: all: sky,exposure,pose,antialiasing)",
    )
    parser.add_argument("--trials", type=integer(1), default=10, metavar="N", help="of each kind (default 10)")


def _add_precision_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Train a scene in float64, in float32 with exact and with fast kernels, and with\ncolours in float16. The same "
        "command with the same folder goes on where it was\ninterrupted."
    )
    _add_scene_arguments(parser, iterations=3000)
    parser.add_argument(
        "--recipe", type=name, default="mini-splatting2", metavar="R", help=f"{RECIPE_HELP} (default %(default)s)"
    )
    _add_seeds(parser)


ADAPTIVE = Study(
    name="adaptive",
    summary="the recipe that decides for itself, beside those with a schedule",
    add_arguments=_add_adaptive_arguments,
    run=_run_of("adaptive"),
)
ABLATION = Study(
    name="ablation",
    summary="Mini-Splatting without each of its mechanisms",
    add_arguments=_add_ablation_arguments,
    run=_run_of("ablation"),
)
SPLIT = Study(
    name="split",
    summary="blur split: random children, children on the longest axis, and none",
    add_arguments=_add_split_arguments,
    run=_run_of("split_forms"),
)
CULLING = Study(
    name="culling",
    summary="visibility culling: what it removes, and the time it saves",
    add_arguments=_add_culling_arguments,
    run=_run_of("culling"),
)
SIMPLIFY = Study(
    name="simplify",
    summary="quality against count: sampling, rank and mass, merging",
    add_arguments=_add_simplify_arguments,
    run=_run_of("simplify"),
)
DEPTH = Study(
    name="depth",
    summary="depth reinitialisation: mid-points, centres, blended depth; guards",
    add_arguments=_add_depth_arguments,
    run=_run_of("depth_types"),
)
EXPOSURE = Study(
    name="exposure",
    summary="exposure per photograph: disturbed by known maps, and recovered",
    add_arguments=_add_calibration_arguments,
    run=_run_of("exposures"),
)
POSE = Study(
    name="pose",
    summary="pose refinement: cameras moved by known amounts, and recovered",
    add_arguments=_add_pose_arguments,
    run=_run_of("poses"),
)
DEFECTS = Study(
    name="defects",
    summary="planted defects of photographs: found where they are, nowhere else",
    add_arguments=_add_defects_arguments,
    run=_run_of("defects"),
)
PRECISION = Study(
    name="precision",
    summary="float64, float32 exact and fast, colours in float16: what it takes",
    add_arguments=_add_precision_arguments,
    run=_run_of("precision"),
)
