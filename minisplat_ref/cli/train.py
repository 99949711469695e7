"""``train``: from photographs with cameras to a folder with Gaussians, measures and pictures."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.errors import InputError
from minisplat_ref.experiments.arguments import (
    Commands,
    HelpFormatter,
    add_renderer_arguments,
    assignment,
    integer,
    option_name,
)

if TYPE_CHECKING:
    from minisplat_ref.experiments.settings import Settings
    from minisplat_ref.lpips import Network
    from minisplat_ref.training.loop import TrainState
    from minisplat_ref.training.schedule import Recipe
    from minisplat_ref.types import Scene

DEFAULTS = {
    "downscale": 1,
    "test_every": 8,
    "undistort": False,
    "recipe": "3dgs-accel",
    "iterations": 3000,
    "budget": None,
    "simplify": None,
    "scene_type": None,
    "extension": None,
    "set": {},
    "eval_every": 0,
    "lpips_weights": None,
    "init": None,
    "seed": 0,
    "profile": GSPLAT_MAIN.name,
    "backend": "cpu",
}
RESUMABLE = ("iterations", "lpips_weights")  # what may be new when a run is continued

DESCRIPTION = """\
Train Gaussians on photographs with cameras. DIR will hold point_cloud.ply,
metrics.json and renders/ (truth | render | error of each test view). --resume
goes on after Ctrl-C, or with more --iterations on the schedules as they were.
"""
EPILOG = """\
examples:
  minisplat-ref train photos/fox --out runs/fox
  minisplat-ref train --resume runs/fox --iterations 4000
"""


def add_parser(commands: Commands) -> None:
    """Add the command. Options that are not given are absent, so that ``--resume`` can tell."""
    parser = commands.add_parser(
        "train",
        help="train Gaussians on photographs with cameras",
        usage="minisplat-ref train [-h] SCENE [options]\n       minisplat-ref train --resume DIR [--iterations N]",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
        argument_default=argparse.SUPPRESS,
    )
    parser.add_argument(
        "scene",
        nargs="?",
        metavar="SCENE",
        help="folder of a COLMAP scene or of a transforms.json",
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="new folder for the results (default runs/SCENE-RECIPE)"
    )
    parser.add_argument("--resume", type=Path, metavar="DIR", help="continue the run in DIR from its last checkpoint")

    data = parser.add_argument_group("photographs")
    data.add_argument("--downscale", type=integer(1), metavar="D", help="make them D times smaller (default 1)")
    data.add_argument(
        "--test-every", type=integer(0), metavar="K", help="hold out every K-th for testing, 0: none (default 8)"
    )
    data.add_argument("--undistort", action="store_true", help="remove lens distortion instead of refusing it")

    training = parser.add_argument_group("training")
    training.add_argument(
        "--recipe",
        metavar="R",
        help="3dgs-accel, which is the default, 3dgs, mini-splatting, mini-splatting2, mini-splatting-d or"
        " mini-splatting2-d",
    )
    training.add_argument("--init", type=Path, metavar="PLY", help="points to start from (default: the scene's)")
    training.add_argument("--iterations", type=integer(1), metavar="N", help="one view each (default 3000)")
    training.add_argument(
        "--budget", type=integer(1), metavar="N", help="Gaussians that simplification keeps (default: a part)"
    )
    training.add_argument(
        "--simplify",
        choices=("sampling", "rank", "merging"),
        metavar="S",
        help="by sampling (default), rank or merging",
    )
    training.add_argument(
        "--scene-type",
        choices=("indoor", "outdoor"),
        metavar="T",
        help="indoor (default) or outdoor: what counts as important",
    )
    training.add_argument("--extension", metavar="E", help="train with it; its own recipes are names for --recipe")
    training.add_argument(
        "--set",
        type=assignment,
        action="append",
        metavar="NAME=VALUE",
        help="a setting of the recipe, such as exposure=true",
    )
    training.add_argument(
        "--eval-every",
        type=integer(0),
        metavar="K",
        help="measure every K iterations, into curve.jsonl (default 0)",
    )
    training.add_argument(
        "--lpips-weights", type=Path, metavar="NPZ", help="measure LPIPS in the end; eval --help tells how"
    )
    training.add_argument("--seed", type=integer(0), metavar="S", help="of all random draws (default 0)")
    add_renderer_arguments(training, argparse.SUPPRESS)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Train, or continue a training; nothing is written before the input has been read and found good."""
    given = vars(args)
    return _resume(args.resume, given) if "resume" in given else _start(given)


def _start(given: dict[str, Any]) -> int:
    if "scene" not in given:
        raise InputError("give a SCENE to train on, or --resume DIR to continue a run")
    options = {name: given.get(name, default) for name, default in DEFAULTS.items()}
    options["set"] = dict(options["set"])  # of equal names the last
    for name in ("lpips_weights", "init"):
        options[name] = _absolute(options[name])
    scene_path = Path(given["scene"])
    scene_folder = scene_path.parent if scene_path.is_file() else scene_path
    folder: Path = given.get("out", Path("runs") / f"{scene_folder.resolve().name}-{options['recipe']}")

    from minisplat_ref.experiments import curve, run_folder
    from minisplat_ref.experiments.first_use import compile_kernels
    from minisplat_ref.experiments.notices import warn_of_scene
    from minisplat_ref.experiments.settings import Settings, load_lpips, load_photographs, recipe_of
    from minisplat_ref.experiments.start import load_start
    from minisplat_ref.training.loop import initial_state

    run_folder.check_free(folder)
    settings = Settings(scene=str(scene_path.resolve()), schedule_iterations=options["iterations"], **options)
    recipe = recipe_of(settings)
    scene = load_photographs(settings)
    if settings.eval_every:
        curve.check_views(scene)
    network = load_lpips(settings, scene)
    start, notices = (scene, []) if settings.init is None else load_start(settings.init, scene)
    state = initial_state(start, recipe, settings.seed)
    for notice in notices:
        print(f"minisplat-ref: {notice}", file=sys.stderr)
    if settings.init is not None:
        print(f"starts from {len(start.points):,} points of {settings.init}")
    compile_kernels(settings.backend)
    run_folder.create(folder)
    warn_of_scene(scene, settings.downscale)
    try:
        return _train(folder, scene, settings, recipe, state, network)
    except InputError:  # a budget, for one, can only be found too large when there is something to choose from
        run_folder.remove(folder)
        raise


def _resume(folder: Path, given: dict[str, Any]) -> int:
    surplus = [name for name in ("scene", "out", *DEFAULTS) if name in given and name not in RESUMABLE]
    if surplus:
        raise InputError(
            f"--resume takes the run's own settings: leave out {', '.join(option_name(name) for name in surplus)}"
        )

    from minisplat_ref.experiments import run_folder, settings
    from minisplat_ref.experiments.first_use import compile_kernels
    from minisplat_ref.training.loop import load_state

    ours = settings.load(folder)
    ours = ours._replace(iterations=given.get("iterations", ours.iterations))
    if "lpips_weights" in given:
        ours = ours._replace(lpips_weights=_absolute(given["lpips_weights"]))
    recipe = settings.recipe_of(ours)
    state = load_state(folder / run_folder.CHECKPOINT, recipe)
    is_done = state.step == ours.iterations and run_folder.is_finished(folder, ours.iterations)
    if state.step > ours.iterations or is_done:  # one that was killed while it was measured goes on with that
        raise InputError(
            f"{folder} has done {state.step} iterations: give --iterations above {state.step} to train further"
        )
    scene = settings.load_photographs(ours)
    network = settings.load_lpips(ours, scene)
    compile_kernels(ours.backend)
    return _train(folder, scene, ours, recipe, state, network)


def _train(
    folder: Path,
    scene: "Scene",
    settings: "Settings",
    recipe: "Recipe",
    state: "TrainState",
    network: "Network | None",
) -> int:
    from minisplat_ref.experiments.run import run_training
    from minisplat_ref.experiments.scoring import summary

    size = scene.train_views[0].camera
    print(
        f"{scene.name}: {len(scene.train_views)} training and {len(scene.test_views)} test views of"
        f" {size.width} x {size.height}, {len(scene.points):,} points"
    )
    outcome = run_training(folder, scene, settings, recipe, state, network)
    if not outcome.is_complete:
        print(
            f"minisplat-ref: stopped after {state.step} of {settings.iterations} iterations, all saved;"
            f" to continue: minisplat-ref train --resume {folder}",
            file=sys.stderr,
        )
        return 130
    print(
        f"{summary(outcome.evaluation)}, {len(state.gaussians.means):,} Gaussians, {outcome.seconds:.0f} s of training"
    )
    print(f"results in {folder}: point_cloud.ply, metrics.json, renders/")
    return 0


def _absolute(path: Path | None) -> str | None:
    """Return a path as the settings of a run keep it: they are read from other folders, too."""
    return None if path is None else str(path.resolve())
