"""``train``: from photographs with cameras to a folder with Gaussians, metrics and images."""

import argparse
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from minisplat_ref.app.runs.options import HIDDEN, N_ITERATIONS, NEW_ON_RESUME, OPTIONS, Settings, add_settings
from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import (
    VIEWER_PORT,
    Commands,
    HelpFormatter,
    add_worker_arguments,
    integer,
    option_name,
)

if TYPE_CHECKING:
    from minisplat_ref.app.blocks.plan import Asked
    from minisplat_ref.app.runs.run import Training, Watch
    from minisplat_ref.app.runs.simplification import Target
    from minisplat_ref.training.schedule import Recipe
    from minisplat_ref.training.state import TrainState
    from minisplat_ref.types import Scene

SIMPLIFIED = "simplified"  # the run inside of a run that --max-drop and --max-bytes leave
MINUTES_MIN = 0.1  # the first iterations take seconds, to compile what has not been

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
    parser.add_argument("scene", nargs="?", metavar="SCENE", help=HIDDEN)
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
    add_settings(parser, "block")  # one of them
    add_worker_arguments(parser, argparse.SUPPRESS, argparse.SUPPRESS)
    parser.add_argument("--view", nargs="?", type=integer(0), const=VIEWER_PORT, metavar="PORT", help=HIDDEN)

    data = parser.add_argument_group("photographs")
    add_settings(data, "downscale", "test_every", "fold", "background", "undistort", "model")
    training = parser.add_argument_group("training")
    add_settings(training, "recipe")
    training.add_argument("--config", type=Path, metavar="RUN", help="run, or its config.json, whose settings to take")
    add_settings(training, "init", "iterations", "minutes", "budget")
    add_settings(training.add_mutually_exclusive_group(), "max_drop", "max_bytes")
    add_settings(training, "simplify", "scene_type", "extension", "set", "eval_every", "lpips_weights", "seed")
    training.add_argument(
        "--check-every", type=integer(1), metavar="K", help="look for NaN every K steps (10); --drop-bad-steps: skip"
    )
    add_settings(training, "drop_bad_steps", "profile", "backend")
    parser.set_defaults(run=run, needs=("matplotlib",))


def run(args: argparse.Namespace) -> int:
    """Train, or continue a training; nothing is written before the input has been read and found good."""
    from minisplat_ref.training.interruption import terminated_like_interrupted

    given = vars(args)
    if "view" in given:
        from minisplat_ref.app.viewer.browser import open_server

        given["server"] = open_server(given["view"], "training")
    with terminated_like_interrupted():
        return _resume(args.resume, given) if "resume" in given else _start(_with_config(given))


def _start(given: dict[str, Any]) -> int:
    if "scene" not in given:
        raise InputError("give a SCENE to train on, or --resume DIR to continue a run")
    surplus = [option for name, option in (("moved", "--scene"), ("rescale", "--rescale")) if name in given]
    if surplus:
        raise InputError(f"{surplus[0]} is for a run that is continued: leave it out, or give --resume DIR")
    settings = _settings_of(given)
    if "blocks" in given and settings.block is not None:
        raise InputError("--block is one part of a training in --blocks: give one of the two")
    scene_path = Path(given["scene"])
    scene_folder = scene_path.parent if scene_path.is_file() else scene_path
    folder: Path = given.get("out", Path("runs") / f"{scene_folder.resolve().name}-{settings.recipe}")

    from minisplat_ref.app.cli import train_blocks
    from minisplat_ref.app.runs import curve, run_folder
    from minisplat_ref.app.runs.first_use import compile_kernels
    from minisplat_ref.app.runs.notices import report_inventory, warn_of_scene
    from minisplat_ref.app.runs.proposed_size import propose
    from minisplat_ref.app.runs.run import Training
    from minisplat_ref.app.runs.settings import check_frame, load_lpips, load_photographs, recipe_of

    if "blocks" in given:
        train_blocks.refuse_options(given)
    elif given["workers"] or given["cluster"]:
        raise InputError("--workers and --cluster train blocks at once: give --blocks AxB, too, or leave them out")
    run_folder.check_free(folder)
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
            return _train(Training(folder, scene, settings, recipe, state, network, *_watching(given, room)))
        except InputError:
            if state.step == 0:
                run_folder.remove(folder)
            raise


def _train_blocks(asked: "Asked", given: dict[str, Any]) -> int:
    """Train in blocks from where that is, and end like a run of the whole."""
    from minisplat_ref.app.cli.train_blocks import go_on
    from minisplat_ref.app.runs import run_folder
    from minisplat_ref.app.runs.cluster import Workers
    from minisplat_ref.app.runs.run import Training

    end = go_on(asked, Workers(given["workers"], given["cluster"]))
    if isinstance(end, int):
        return end
    with run_folder.hold_folder(asked.folder):
        scene, recipe, state = end
        return _train(Training(asked.folder, scene, asked.settings, recipe, state, None, *_watching(given)))


def _with_config(given: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments with the settings of --config where the command line has none."""
    if "config" not in given:
        return given
    from minisplat_ref.app.runs.run_folder import CONFIG
    from minisplat_ref.app.runs.settings import load

    path: Path = given["config"]
    config = load(path.parent if path.name == CONFIG else path)
    settings = {name: getattr(config, name) for name in ("scene", *OPTIONS)}
    return {**settings, **given, "set": [*config.set.items(), *given.get("set", ())]}


def _settings_of(given: dict[str, Any]) -> Settings:
    """Return the settings of a run that begins; what is not given has its default."""
    values = {name: given[name] for name in OPTIONS if name in given}
    values["set"] = dict(values.get("set", ()))  # of equal names the last
    if "iterations" not in values:
        values["iterations"] = _default_iterations(values.get("recipe", Settings.recipe))
    scene = str(Path(given["scene"]).resolve())
    return Settings(scene=scene, schedule_iterations=values["iterations"], **values)


def _check_time(settings: Settings, recipe: "Recipe") -> None:
    """Refuse a time limit that means nothing to the recipe, or is over before the training begins."""
    if settings.minutes is None:
        return
    if recipe.cooling is None:
        raise InputError(f"--minutes means nothing to recipe {recipe.name}: give --iterations, or --recipe adaptive")
    if settings.minutes < MINUTES_MIN:
        raise InputError(
            f"--minutes {settings.minutes:g} is too short to learn anything: give at least {MINUTES_MIN:g}"
        )


def _target(settings: Settings) -> "Target | None":
    """Return what a simplification after the training is to reach; None where there is none."""
    from minisplat_ref.app.runs.simplification import Target

    target = Target(max_drop=settings.max_drop, max_bytes=settings.max_bytes)
    return None if target == Target() else target


def _check_target(folder: Path, settings: Settings, recipe: "Recipe", scene: "Scene", state: "TrainState") -> None:
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


def _first_state(settings: Settings, scene: "Scene", recipe: "Recipe") -> "TrainState":
    """Return the state before the first iteration, from the scene's points or from what --init gives."""
    from minisplat_ref.app.runs.scene_part import read_region
    from minisplat_ref.app.runs.start import start_from

    start = start_from(settings.init, scene, recipe, settings.seed)
    for notice in start.notices:
        print(f"minisplat-ref: {notice}", file=sys.stderr)
    if start.source is not None:
        print(f"starts from {start.source}")
    return start.state if settings.block is None else read_region(Path(settings.block)).crop(start.state)


def _resume(folder: Path, given: dict[str, Any]) -> int:
    surplus = [name for name in ("scene", "out", "config", *OPTIONS) if name in given and name not in NEW_ON_RESUME]
    if surplus:
        raise InputError(
            f"--resume takes the run's own settings: leave out {', '.join(option_name(name) for name in surplus)}"
        )

    from minisplat_ref.app.blocks.plan import load_asked
    from minisplat_ref.app.blocks.train import is_unfinished
    from minisplat_ref.app.runs import checkpoints, fingerprint, run_folder, settings
    from minisplat_ref.app.runs.first_use import compile_kernels
    from minisplat_ref.app.runs.run import Training

    if is_unfinished(folder):
        if surplus := [name for name in (*NEW_ON_RESUME, "moved", "rescale") if name in given]:
            raise InputError(f"the blocks of {folder} have not ended: leave out {option_name(surplus[0])}")
        return _train_blocks(load_asked(folder), given)
    ours = settings.load(folder)
    with run_folder.hold_folder(folder):
        ours = replace(ours, **{name: given[name] for name in NEW_ON_RESUME if name in given})
        if "moved" in given:
            ours = replace(ours, scene=str(Path(given["moved"]).resolve()))
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
            ours = replace(ours, schedule_iterations=ours.iterations)
        recipe = settings.recipe_of(ours)
        scene = settings.load_photographs(ours, settings.load_frame(folder))
        fingerprint.check(folder, scene, ours.scene)
        network = settings.load_lpips(ours, scene)
        state = _first_state(ours, scene, recipe) if state is None else state
        room = _check_room(scene, state, ours)
        compile_kernels(ours.backend)
        print(_how_it_goes_on(state, ours, is_rescaled="rescale" in given))
        return _train(Training(folder, scene, ours, recipe, state, network, *_watching(given, room)))


def _check_room(scene: "Scene", state: "TrainState", settings: Settings) -> str:
    """Say what the training takes of memory; refuse one that does not fit."""
    from minisplat_ref import memory
    from minisplat_ref.app.runs import memory_needs
    from minisplat_ref.constants import PROFILES
    from minisplat_ref.rendering.backends import get_backend

    needs = memory_needs.foresee(scene, state, PROFILES[settings.profile], get_backend(settings.backend))
    return memory.check_start(needs)


def _how_it_goes_on(state: "TrainState", settings: Settings, is_rescaled: bool) -> str:
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


def _train(training: "Training") -> int:
    """Train, say what came of it, and simplify it if that was asked for; return the exit code."""
    from minisplat_ref.app.runs import checkpoints, run_folder
    from minisplat_ref.app.runs.model_file import describe_parts, missing_parts
    from minisplat_ref.app.runs.next_steps import ways_to_look
    from minisplat_ref.app.runs.notices import describe_place, describe_sizes
    from minisplat_ref.app.runs.run import run_training
    from minisplat_ref.app.runs.scoring import summary

    folder, scene, settings, _, state = training[:5]
    views = (*scene.train_views, *scene.test_views)
    print(
        f"{scene.name}: {len(scene.train_views)} training and {len(scene.test_views)} test views of"
        f" {describe_sizes([(view.camera.width, view.camera.height) for view in views])}, {len(scene.points):,} points"
    )
    if place := describe_place(scene):
        print(place)
    for note in training.notes:
        print(note)
    outcome = run_training(training)
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


def _watching(given: dict[str, Any], room: str = "") -> "tuple[list[str], int, list[Watch]]":
    """Return notes, check_every and watches of a :class:`Training`; ``room`` is the first note, if there is any."""
    from minisplat_ref.app.runs.preview import make_preview
    from minisplat_ref.training.guard import Guard

    notes = [room] if room else []
    watches: list[Watch] = [make_preview] if given.get("preview", False) else []
    if "server" in given:
        from minisplat_ref.app.viewer.browser import address
        from minisplat_ref.app.viewer.live import make_live_view

        notes.append(f"open {address(given['server'])} in a browser to watch")
        watches.append(make_live_view(given["server"]))
    return notes, given.get("check_every", Guard().every), watches


def _simplify(folder: Path, settings: Settings) -> int:
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


def _shape(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([1-9]\d{0,3})[xX]([1-9]\d{0,3})", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of blocks along two axes such as 2x2")
    return int(match[1]), int(match[2])
