"""The studies of this package: smaller claims of the papers, measured. ``minisplat-ref study NAME --help``.

==========================  =====================================================================
:data:`ADAPTIVE`            :mod:`.adaptive`: the recipe that decides for itself, beside those with a schedule
:data:`FOLDS`               :mod:`.folds`: recipes photograph by photograph, each held out once
:data:`ABLATION`            :mod:`.ablation`: what each mechanism of Mini-Splatting is worth
:data:`CULLING`             :mod:`.culling`: what visibility culling removes, saves and costs
:data:`SIMPLIFY`            :mod:`.simplify`: sampling, rank and mass, and merging at equal counts
:data:`MAX_DROP`            :mod:`..runs.max_drop_study`: what ``simplify --max-drop`` promises, and what it keeps
:data:`MESH`                :mod:`..runs.mesh_study`: meshes of runs against the exact surface of synthetic scenes
:data:`DEPTH`               :mod:`.depth_types`: from which depth Gaussians start again
:data:`EXPOSURE`            :mod:`.exposures`: exposures that were disturbed, found again
:data:`POSE`                :mod:`.poses`: poses that were disturbed, found again
:data:`DEFECTS`             :mod:`.defects`: planted defects of photographs, found by ``adaptive`` where they are
:data:`PRECISION`           :mod:`.precision`: a training in float64, float32, and with colours in float16
==========================  =====================================================================

This module has their names and arguments. The other modules do the work and load matplotlib and Numba, so they are
imported when a study runs. :mod:`.study`, :mod:`.kit` and :mod:`.figures` have what they share with those of
extensions, and :mod:`.conditions` how they disturb a scene.
"""

from minisplat_ref.arguments import decibels, fraction, list_of, name
from minisplat_ref.studies.study import (
    CONTINUES,
    OUT,
    PLY,
    RESUMED_OUT,
    SCENE,
    SEEDS,
    Study,
    argument,
    declare,
    downscale,
    fine_tune,
    iterations,
    number,
    one_of,
    recipe,
    seed,
    synthetic_scene,
)

CONDITION_HELP = (
    "whole, few (every fifth photograph), gains (wrong exposures), few-gains (both), poses (wrong cameras),"
    " sizes (every second at half the size), sky (synthetic scenes, cut off)"
)
_CONDITION = argument("--condition", type=name, default="whole", metavar="C", help=f"{CONDITION_HELP} (default whole)")
_RESUMED_SCENE = (SCENE, RESUMED_OUT, downscale())
_SYNTHETIC_SCENE = synthetic_scene()
_CALIBRATION = (
    _SYNTHETIC_SCENE,
    OUT,
    iterations(3000, "of each of three trainings"),
    number("--views", 24, "to train on", minimum=4, metavar="V"),
    number("--width", 160, "of 4:3 images", minimum=16, metavar="PX"),
    seed("of the disturbance and the trainings"),
)


def all_studies() -> dict[str, Study]:
    """Return the studies of this package by the name that users type; an extension's are EXTENSION/NAME."""
    studies = (ADAPTIVE, FOLDS, ABLATION, CULLING, SIMPLIFY, MAX_DROP, MESH, DEPTH, EXPOSURE, POSE, DEFECTS, PRECISION)
    return {each.name: each for each in studies}


ADAPTIVE = declare(
    "adaptive",
    "the recipe that decides for itself, beside those with a schedule",
    f"{__name__}.adaptive.run",
    *_RESUMED_SCENE,
    argument(
        "--recipes",
        type=list_of(name),
        default=("3dgs-accel", "mini-splatting", "mini-splatting2", "adaptive"),
        metavar="R,Q",
        help="the first is what the others are compared with; also names of --rules (default: three of 3000 iterations,"
        " and adaptive)",
    ),
    one_of(
        argument("--rules", action="store_true", help="adaptive beside itself without each of its rules"),
        argument("--sweep", action="store_true", help="adaptive beside itself with more Gaussians and fewer"),
    ),
    argument(
        "--conditions",
        type=list_of(name),
        default=("whole", "few", "gains"),
        metavar="C,D",
        help=f"{CONDITION_HELP} (default: the first three)",
    ),
    SEEDS,
    description=f"Train a scene by adaptive and by recipes with a schedule, as it is and disturbed. {CONTINUES}",
)
FOLDS = declare(
    "folds",
    "recipes photograph by photograph: each is held out once",
    f"{__name__}.folds.run",
    argument("scenes", nargs="+", metavar="SCENE", help="folders of scenes, or synthetic ones"),
    RESUMED_OUT,
    number("--folds", 4, "held out is every K-th photograph", minimum=2, metavar="K"),
    argument(
        "--recipes",
        type=list_of(name),
        default=("adaptive", "3dgs-accel", "mini-splatting", "mini-splatting2"),
        metavar="R,Q",
        help="the first is compared with the others; R+NAME=VALUE changes a setting (default: adaptive, and three of"
        " 3000 iterations)",
    ),
    argument(
        "--photographs",
        choices=("whole", "thinned", "both"),
        default="whole",
        metavar="P",
        help="whole: all photographs (default); thinned: about ten; both",
    ),
    number("--long-side", 480, "make photographs a whole number of times smaller, to this", 16, "PX"),
    SEEDS,
    description="Hold out each photograph once, train recipes on the others, and measure. " + CONTINUES,
)
ABLATION = declare(
    "ablation",
    "Mini-Splatting without each of its mechanisms",
    f"{__name__}.ablation.run",
    *_RESUMED_SCENE,
    iterations(6000),
    recipe("mini-splatting2"),
    argument("--deviations", action="store_true", help="take back what deviates from the published method instead"),
    _CONDITION,
    SEEDS,
    description=f"Train a scene by a recipe, and by the recipe without each of its mechanisms. {CONTINUES}",
)
CULLING = declare(
    "culling",
    "visibility culling: what it removes, and the time it saves",
    f"{__name__}.culling.run",
    SCENE,
    OUT,
    downscale(),
    iterations(1800),
    PLY,
    seed("of the training"),
    number("--repeats", 100, "iterations to time, of either kind"),
    description="Train a scene with mini-splatting2, and measure what visibility culling does.",
)
SIMPLIFY = declare(
    "simplify",
    "quality against count: sampling, rank and mass, merging",
    f"{__name__}.simplify.run",
    SCENE,
    OUT,
    downscale(),
    iterations(3000),
    recipe("mini-splatting-d", "of the dense population"),
    PLY,
    argument(
        "--fractions",
        type=list_of(fraction),
        default=(0.05, 0.1, 0.2, 0.4),
        metavar="F,G",
        help="of the candidates to keep (default 0.05,0.1,0.2,0.4)",
    ),
    fine_tune(500),
    argument("--restart", action="store_true", help="fine-tune from centres and colours alone, as mini-splatting does"),
    SEEDS,
    description="Simplify a dense population in several ways to equal numbers, and fine-tune what is left.",
)
MAX_DROP = declare(
    "max-drop",
    "simplify --max-drop: dB that were asked for, dB that are lost",
    "minisplat_ref.runs.max_drop_study.run",  # which simplifies runs, and so is above this layer
    *_RESUMED_SCENE,
    recipe("adaptive"),
    iterations(3000, "per training, of recipes with a schedule"),
    argument(
        "--limits",
        type=list_of(decibels),
        default=(0.1, 0.5, 1.0),
        metavar="L,M",
        help="of --max-drop, dB (default 0.1,0.5,1)",
    ),
    fine_tune(300),
    _CONDITION,
    SEEDS,
    description=f"Train a scene, simplify to each limit, and measure what test views lose. {CONTINUES}",
)
MESH = declare(
    "mesh",
    "meshes of runs against the exact surface of a synthetic scene",
    "minisplat_ref.runs.mesh_study.run",  # which makes meshes of runs, and so is above this layer
    _SYNTHETIC_SCENE,
    RESUMED_OUT,
    argument(
        "--recipes",
        type=list_of(name),
        default=("3dgs-accel", "mini-splatting2", "adaptive", "surfels"),
        metavar="R,Q",
        help="names as in train --recipe; R+NAME=VALUE changes a setting (default"
        " 3dgs-accel,mini-splatting2,adaptive,surfels)",
    ),
    iterations(2000),
    SEEDS,
)
DEPTH = declare(
    "depth",
    "depth reinitialisation: mid-points, centres, blended depth; guards",
    f"{__name__}.depth_types.run",
    _SYNTHETIC_SCENE,
    OUT,
    iterations(3000),
    recipe("mini-splatting"),
    SEEDS,
    description="Train a synthetic scene by a recipe that reinitialises from depth, which is done in several"
    " ways, and compare with the truth.",
)
EXPOSURE = declare(
    "exposure",
    "exposure per photograph: disturbed by known maps, and recovered",
    f"{__name__}.exposures.run",
    *_CALIBRATION,
)
POSE = declare(
    "pose",
    "pose refinement: cameras moved by known amounts, and recovered",
    f"{__name__}.poses.run",
    *_CALIBRATION,
    argument("--degrees", type=float, default=0.5, metavar="A", help="by which each camera is turned (default 0.5)"),
    argument("--shift", type=float, default=0.005, metavar="F", help="of the extent, of each camera (default 0.005)"),
)
DEFECTS = declare(
    "defects",
    "planted defects of photographs: found where they are, nowhere else",
    f"{__name__}.defects.run",
    *_RESUMED_SCENE,
    argument(
        "--conditions",
        type=list_of(name),
        default=(),
        metavar="C,D",
        help="clean, gains, poses, sizes, sky (default: all, sky of synthetic scenes alone)",
    ),
    argument(
        "--asked",
        type=list_of(name),
        default=("sky", "exposure", "pose", "antialiasing"),
        metavar="A,B",
        help="train until it is decided about these alone (default: all: sky,exposure,pose,antialiasing)",
    ),
    number("--trials", 10, "of each kind"),
    description=f"Disturb the photographs of a scene in known ways, and count what adaptive switches on. {CONTINUES}",
)
PRECISION = declare(
    "precision",
    "float64, float32 exact and fast, colours in float16: what it takes",
    f"{__name__}.precision.run",
    *_RESUMED_SCENE,
    iterations(3000),
    recipe("mini-splatting2"),
    SEEDS,
    description="Train a scene in float64, in float32 with exact and with fast kernels, and with colours in float16. "
    f"{CONTINUES}",
)
