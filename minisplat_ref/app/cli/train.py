"""``train``: from photographs with cameras to a folder with Gaussians, metrics and images."""

import argparse
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import (
    VIEWER_PORT,
    Commands,
    HelpFormatter,
    add_renderer_arguments,
    add_worker_arguments,
    assignment,
    color,
    decibels,
    integer,
    option_name,
    positive,
)

if TYPE_CHECKING:
    from minisplat_ref.app.blocks.plan import Asked
    from minisplat_ref.app.runs.run import Watch
    from minisplat_ref.app.runs.settings import Settings
    from minisplat_ref.app.runs.simplification import Target
    from minisplat_ref.metrics.lpips import Network
    from minisplat_ref.training.schedule import Recipe
    from minisplat_ref.training.state import TrainState
    from minisplat_ref.types import Scene

N_ITERATIONS = 3000  # of recipes with a schedule
SIMPLIFIED = "simplified"  # the run inside of a run that --max-drop and --max-bytes leave
MINUTES_MIN = 0.1  # the first iterations take seconds, to compile what has not been

DEFAULTS: dict[str, Any] = {
    "downscale": 1,
    "test_every": 8,
    "undistort": False,
    "model": None,
    "recipe": "adaptive",
    "iterations": None,
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
    "drop_bad_steps": False,
    "minutes": None,
    "background": None,
    "max_drop": None,
    "max_bytes": None,
    "block": None,
    "fold": 0,
}
AFRESH = ("iterations", "lpips_weights", "drop_bad_steps")  # what may be new when a run is continued

DESCRIPTION = """\
Train Gaussians on SCENE, the folder of a COLMAP scene or of a transforms.json.
DIR will hold report.html, point_cloud.ply, metrics.json, renders/, checkpoints.
"""
EPILOG = """\
example:
  minisplat-ref train photos/fox --downscale 2 --minutes 5 --preview"""


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
    parser.add_argument("scene", nargs="?", metavar="SCENE", help=argparse.SUPPRESS)
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="new folder for the results (default runs/SCENE-RECIPE)"
    )
    parser.add_argument(
        "--resume", type=Path, metavar="DIR", help="continue the run in DIR; Ctrl-C saves what there is"
    )
    parser.add_argument("--scene", dest="moved", metavar="PATH", help="with --resume: where its photographs are now")
    parser.add_argument("--rescale", action="store_true", help="with --resume: stretch its schedule to --iterations")

    parser.add_argument("--preview", action="store_true", help="keep DIR/preview.png up to date; --view: in a browser")
    parser.add_argument(
        "--blocks", type=_shape, metavar="AxB", help="in A x B parts; at once: --workers N, --cluster ADDRESS"
    )
    parser.add_argument("--block", type=Path, metavar="PART", help=argparse.SUPPRESS)  # one of them
    add_worker_arguments(parser, argparse.SUPPRESS, argparse.SUPPRESS)
    parser.add_argument("--view", nargs="?", type=integer(0), const=VIEWER_PORT, metavar="PORT", help=argparse.SUPPRESS)

    data = parser.add_argument_group("photographs")
    data.add_argument("--downscale", type=integer(1), metavar="D", help="make them D times smaller (default 1)")
    data.add_argument(
        "--test-every", type=integer(0), metavar="K", help="hold out every K-th for testing, 0: none (default 8)"
    )
    data.add_argument(
        "--background", type=color, metavar="R,G,B", help="behind the scene (default 0,0,0; white 255,255,255)"
    )
    data.add_argument("--undistort", action="store_true", help="remove lens distortion instead of refusing it")
    data.add_argument("--fold", type=integer(0), metavar="N", help=argparse.SUPPRESS)  # one of compare --folds
    data.add_argument("--model", metavar="M", help="folder of the COLMAP model in SCENE (default sparse/0)")

    training = parser.add_argument_group("training")
    training.add_argument(
        "--recipe",
        metavar="R",
        help="adaptive (default), 3dgs[-accel], mini-splatting[2][-d]",
    )
    training.add_argument("--config", type=Path, metavar="RUN", help="run, or its config.json, whose settings to take")
    training.add_argument("--init", type=Path, metavar="START", help="points (PLY) or run to start from")
    training.add_argument(
        "--iterations",
        type=integer(1),
        metavar="N",
        help="one view each (default 3000; adaptive decides itself)",
    )
    training.add_argument("--minutes", type=positive, metavar="T", help="with adaptive: the most minutes to take")
    training.add_argument(
        "--budget", type=integer(1), metavar="N", help="the most Gaussians, for recipes that choose their number"
    )
    target = training.add_mutually_exclusive_group()
    target.add_argument(
        "--max-drop", type=decibels, metavar="dB", help="simplify at the end, into DIR/simplified: PSNR to lose"
    )
    target.add_argument("--max-bytes", type=integer(1), metavar="B", help="likewise: size that its PLY may have")
    training.add_argument(
        "--simplify",
        choices=("sampling", "rank", "merging"),
        metavar="S",
        help="simplify by sampling (default), rank or merging",
    )
    training.add_argument(
        "--scene-type",
        choices=("indoor", "outdoor"),
        metavar="T",
        help="indoor (default) or outdoor: what counts as important",
    )
    training.add_argument("--extension", metavar="E", help="extension to train with; its own recipes go to --recipe")
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
        help="measure every K iterations, into curve.jsonl",
    )
    training.add_argument(
        "--lpips-weights", type=Path, metavar="NPZ", help="measure LPIPS at the end; eval --help says how"
    )
    training.add_argument("--seed", type=integer(0), metavar="S", help="seed of all random draws (default 0)")
    training.add_argument(
        "--check-every", type=integer(1), metavar="K", help="look for NaN every K steps (10); --drop-bad-steps: skip"
    )
    training.add_argument("--drop-bad-steps", action="store_true", help=argparse.SUPPRESS)
    add_renderer_arguments(training, argparse.SUPPRESS)
    parser.set_defaults(run=run, needs=("matplotlib",))


def run(args: argparse.Namespace) -> int:
    """Train, or continue a training; nothing is written before the input has been read and found good."""
    from minisplat_ref.training.interruption import terminated_like_interrupted

    given = vars(args)
    if "view" in given:
        from minisplat_ref.app.viewer.browser import open_server

        given["server"] = open_server(given["view"], "training")
    with terminated_like_interrupted():
        return _resume(args.resume, given) if "resume" in given else _start(given)


def _start(given: dict[str, Any]) -> int:
    if "config" in given:
        given = _with_config(given)
    if "scene" not in given:
        raise InputError("give a SCENE to train on, or --resume DIR to continue a run")
    surplus = [option for name, option in (("moved", "--scene"), ("rescale", "--rescale")) if name in given]
    if surplus:
        raise InputError(f"{surplus[0]} is for a run that is continued: leave it out, or give --resume DIR")
    options = {name: given.get(name, default) for name, default in DEFAULTS.items()}
    if options["iterations"] is None:
        options["iterations"] = _default_iterations(options["recipe"])
    options["set"] = dict(options["set"])  # of equal names the last
    options["background"] = None if options["background"] is None else list(options["background"])
    for name in ("lpips_weights", "init", "block"):
        options[name] = _absolute(options[name])
    scene_path = Path(given["scene"])
    scene_folder = scene_path.parent if scene_path.is_file() else scene_path
    if "blocks" in given and options["block"] is not None:
        raise InputError("--block is one part of a training in --blocks: give one of the two")
    folder: Path = given.get("out", Path("runs") / f"{scene_folder.resolve().name}-{options['recipe']}")

    from minisplat_ref.app.cli import train_blocks
    from minisplat_ref.app.runs import curve, run_folder
    from minisplat_ref.app.runs.first_use import compile_kernels
    from minisplat_ref.app.runs.notices import report_inventory, warn_of_scene
    from minisplat_ref.app.runs.proposed_size import propose
    from minisplat_ref.app.runs.settings import Settings, check_frame, load_lpips, load_photographs, recipe_of

    if "blocks" in given:
        train_blocks.refuse_options(given)
    elif given["workers"] or given["cluster"]:
        raise InputError("--workers and --cluster train blocks at once: give --blocks AxB, too, or leave them out")
    run_folder.check_free(folder)
    settings = Settings(scene=str(scene_path.resolve()), schedule_iterations=options["iterations"], **options)
    recipe = recipe_of(settings)
    _check_time(settings, recipe)
    scene = load_photographs(settings)
    check_frame(settings, scene)
    if settings.eval_every:
        curve.check_views(scene)
    network = load_lpips(settings, scene)
    state = _first_state(settings, scene, recipe)
    if "blocks" in given:
        from minisplat_ref.app.blocks.plan import Asked

        asked = Asked(folder, settings, given["blocks"])
        train_blocks.start(asked, recipe, scene, state)
        return _train_blocks(asked, given)
    _check_target(folder, settings, recipe, scene, state)
    room = _check_room(scene, state, settings)
    compile_kernels(settings.backend)
    run_folder.create(folder)
    warn_of_scene(scene, is_dense=recipe.starts_densely)
    if settings.block is None:  # else the training of the whole has said so
        report_inventory(Path(settings.scene), scene, settings.model)
    proposal = None if "downscale" in given else propose(scene, state, recipe, settings)
    if proposal is not None:
        print(f"minisplat-ref: {proposal}", file=sys.stderr)
    with run_folder.hold_folder(folder):
        run_folder.check_free(folder)  # another process may have trained there meanwhile
        try:
            return _train(folder, scene, recipe, state, settings, given, network, room)
        except InputError:
            if state.step == 0:
                run_folder.remove(folder)
            raise


def _train_blocks(asked: "Asked", given: dict[str, Any]) -> int:
    """Train in blocks from where that is, and end like a run of the whole."""
    from minisplat_ref.app.cli.train_blocks import go_on
    from minisplat_ref.app.runs import run_folder
    from minisplat_ref.app.runs.cluster import Workers

    end = go_on(asked, Workers(given["workers"], given["cluster"]))
    if isinstance(end, int):
        return end
    with run_folder.hold_folder(asked.folder):
        return _train(asked.folder, *end, asked.settings, given)


def _with_config(given: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments with the settings of another run where the command line has none."""
    from minisplat_ref.app.runs.run_folder import CONFIG
    from minisplat_ref.app.runs.settings import load

    path: Path = given["config"]
    config = load(path.parent if path.name == CONFIG else path)
    settings: dict[str, Any] = {name: getattr(config, name) for name in ("scene", *DEFAULTS)}
    settings["set"] = [*config.set.items(), *given.get("set", ())]
    for name in ("lpips_weights", "init", "block"):
        settings[name] = None if settings[name] is None else Path(settings[name])
    return {**settings, **given, "set": settings["set"]}


def _check_time(settings: "Settings", recipe: "Recipe") -> None:
    """Refuse a time limit that means nothing to the recipe, or is over before the training begins."""
    if settings.minutes is None:
        return
    if recipe.cooling is None:
        raise InputError(f"--minutes means nothing to recipe {recipe.name}: give --iterations, or --recipe adaptive")
    if settings.minutes < MINUTES_MIN:
        raise InputError(
            f"--minutes {settings.minutes:g} is too short to learn anything: give at least {MINUTES_MIN:g}"
        )


def _target(settings: "Settings") -> "Target | None":
    """Return what a simplification after the training is to reach; None where there is none."""
    from minisplat_ref.app.runs.simplification import Target

    target = Target(max_drop=settings.max_drop, max_bytes=settings.max_bytes)
    return None if target == Target() else target


def _check_target(folder: Path, settings: "Settings", recipe: "Recipe", scene: "Scene", state: "TrainState") -> None:
    """Refuse, before the training, a simplification that could not follow it."""
    from minisplat_ref.app.runs.opened_run import Run
    from minisplat_ref.app.runs.simplification import check_before_training
    from minisplat_ref.extensions.extension import CORE, owner_of

    target = _target(settings)
    if target is not None:
        owner = owner_of(settings.recipe, settings.extension) or CORE
        check_before_training(Run(folder, settings, recipe, owner, scene, state.model, None, None), target)


def _default_iterations(name: str) -> int:
    """Return how long a recipe is trained unless told otherwise: one that decides it itself, as long as it takes."""
    from minisplat_ref.extensions.extension import find_recipe

    recipe = find_recipe(name)
    return N_ITERATIONS if recipe.cooling is None else recipe.iterations


def _first_state(settings: "Settings", scene: "Scene", recipe: "Recipe") -> "TrainState":
    """Return the state before the first iteration, from the scene's points or from what --init gives."""
    from minisplat_ref.app.runs.part import read_region
    from minisplat_ref.app.runs.start import start_from

    start = start_from(settings.init, scene, recipe, settings.seed)
    for notice in start.notices:
        print(f"minisplat-ref: {notice}", file=sys.stderr)
    if start.source is not None:
        print(f"starts from {start.source}")
    return start.state if settings.block is None else read_region(Path(settings.block)).crop(start.state)


def _resume(folder: Path, given: dict[str, Any]) -> int:
    surplus = [name for name in ("scene", "out", "config", *DEFAULTS) if name in given and name not in AFRESH]
    if surplus:
        raise InputError(
            f"--resume takes the run's own settings: leave out {', '.join(option_name(name) for name in surplus)}"
        )

    from minisplat_ref.app.blocks.plan import load_asked
    from minisplat_ref.app.blocks.train import is_unfinished
    from minisplat_ref.app.runs import checkpoints, fingerprint, run_folder, settings
    from minisplat_ref.app.runs.first_use import compile_kernels

    if is_unfinished(folder):
        if surplus := [name for name in (*AFRESH, "moved", "rescale") if name in given]:
            raise InputError(f"the blocks of {folder} have not ended: leave out {option_name(surplus[0])}")
        return _train_blocks(load_asked(folder), given)
    ours = settings.load(folder)
    with run_folder.hold_folder(folder):
        ours = ours._replace(**{name: given[name] for name in AFRESH if name in given})
        if "lpips_weights" in given:
            ours = ours._replace(lpips_weights=_absolute(given["lpips_weights"]))
        if "moved" in given:
            ours = ours._replace(scene=str(Path(given["moved"]).resolve()))
        state = checkpoints.load(folder, ours) if run_folder.has_begun(folder) else None
        if state is not None and state.pace.last_step == state.step and run_folder.is_finished(folder, state.step):
            raise InputError(
                f"{folder} has ended after {state.step} iterations, of which the last had falling rates: train again"
            )
        is_done = state is not None and state.step == ours.iterations and run_folder.is_finished(folder, state.step)
        if state is not None and (is_done or state.step > ours.iterations):
            raise InputError(
                f"{folder} has done {state.step} iterations: give --iterations above {state.step} to train further"
            )
        if "rescale" in given:
            ours = ours._replace(schedule_iterations=ours.iterations)
        recipe = settings.recipe_of(ours)
        scene = settings.load_photographs(ours, settings.load_frame(folder))
        fingerprint.check(folder, scene, ours.scene)
        network = settings.load_lpips(ours, scene)
        state = _first_state(ours, scene, recipe) if state is None else state
        room = _check_room(scene, state, ours)
        compile_kernels(ours.backend)
        print(_how_it_goes_on(state, ours, is_rescaled="rescale" in given))
        return _train(folder, scene, recipe, state, ours, given, network, room)


def _check_room(scene: "Scene", state: "TrainState", settings: "Settings") -> str:
    """Say what the training takes of memory; refuse one that does not fit."""
    from minisplat_ref import memory
    from minisplat_ref.app.runs import room
    from minisplat_ref.constants import PROFILES
    from minisplat_ref.rendering.backends import get_backend

    return memory.check_start(room.foresee(scene, state, PROFILES[settings.profile], get_backend(settings.backend)))


def _how_it_goes_on(state: "TrainState", settings: "Settings", is_rescaled: bool) -> str:
    """Say by which schedule a run continues."""
    if state.step >= settings.iterations:
        return f"all {state.step} iterations are done: measuring"
    length = settings.schedule_iterations
    how = f"going on from iteration {state.step} to {settings.iterations} by the schedule of {length}"
    if is_rescaled:
        return f"{how}, to which it has been stretched: what was done before stays"
    if state.step >= length:
        return f"{how}, which is over: rates stay at their last; --rescale would stretch it"
    return how


def _train(
    folder: Path,
    scene: "Scene",
    recipe: "Recipe",
    state: "TrainState",
    settings: "Settings",
    given: dict[str, Any],
    network: "Network | None" = None,
    room: str = "",
) -> int:
    from minisplat_ref.app.runs import checkpoints, run_folder
    from minisplat_ref.app.runs.model_file import describe_parts, missing_parts
    from minisplat_ref.app.runs.next_steps import ways_to_look
    from minisplat_ref.app.runs.notices import describe_place, describe_sizes
    from minisplat_ref.app.runs.run import run_training
    from minisplat_ref.app.runs.scoring import summary
    from minisplat_ref.training.guard import Guard

    views = (*scene.train_views, *scene.test_views)
    print(
        f"{scene.name}: {len(scene.train_views)} training and {len(scene.test_views)} test views of"
        f" {describe_sizes([(view.camera.width, view.camera.height) for view in views])}, {len(scene.points):,} points"
    )
    if place := describe_place(scene):
        print(place)
    if room:
        print(room)
    check_every = given.get("check_every", Guard().every)
    outcome = run_training(folder, scene, settings, recipe, state, network, check_every, _watches(given))
    if outcome.evaluation is None or not outcome.is_complete:
        if state.is_whole:
            measured = "" if outcome.evaluation else " but not measured"
            how = f"stopped after {state.step} of {settings.iterations} iterations, all saved{measured}"
        else:
            how = f"stopped in the middle of iteration {state.step + 1}, saved is {checkpoints.step_of(folder)}"
        print(f"minisplat-ref: {how}; to continue: minisplat-ref train --resume {folder}", file=sys.stderr)
        return 130
    print(
        f"{summary(outcome.evaluation)}, {len(state.gaussians.means):,} Gaussians, {outcome.seconds:.0f} s of training"
    )
    print(f"results in {folder}: point_cloud.ply (SuperSplat opens it, too), metrics.json, renders/")
    if parts := missing_parts(state.shared):
        print(
            f"point_cloud.ply does not hold {describe_parts(parts)}, which other programs therefore leave out;"
            f" minisplat-ref render {folder} has all"
        )
    for step in ways_to_look(folder, state.gaussians._fields):
        print(f"{step.purpose.lower()}: {step.line}")
    print(f"how good it is, and what to try next: open {(folder / run_folder.REPORT).resolve()}")
    return _simplify(folder, settings)


def _watches(given: dict[str, Any]) -> "list[Watch]":
    """Return what shows the training while it runs, as the command line asks for it."""
    from minisplat_ref.app.runs.preview import make_preview

    watches: list[Watch] = [make_preview] if given.get("preview", False) else []
    if "server" in given:
        from minisplat_ref.app.viewer.browser import address
        from minisplat_ref.app.viewer.live import make_live_view

        print(f"open {address(given['server'])} in a browser to watch")
        watches.append(make_live_view(given["server"]))
    return watches


def _simplify(folder: Path, settings: "Settings") -> int:
    """Make the finished run smaller if that was asked for; return the exit code."""
    from minisplat_ref.app.cli.simplify import FINE_TUNE, simplify
    from minisplat_ref.app.runs.simplified_run import Asked

    target, out = _target(settings), folder / SIMPLIFIED
    if target is None:
        return 0
    if out.exists():
        command = f"minisplat-ref simplify {folder} --out NEW {target}"
        print(f"minisplat-ref: {out} is of an earlier end of the run; for a new one: {command}", file=sys.stderr)
        return 0
    try:
        simplify(Asked(folder, out, target, FINE_TUNE))
    except KeyboardInterrupt:
        command = f"minisplat-ref simplify {folder} --out {out} {target}"
        print(f"minisplat-ref: trained, but not simplified; to do so: {command}", file=sys.stderr)
        return 130
    return 0


def _absolute(path: Path | None) -> str | None:
    """Return a path as the settings of a run keep it: they are read from other folders, too."""
    return None if path is None else str(path.resolve())


def _shape(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([1-9]\d{0,3})[xX]([1-9]\d{0,3})", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of blocks along two axes such as 2x2")
    return int(match[1]), int(match[2])
