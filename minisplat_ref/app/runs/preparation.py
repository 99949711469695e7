"""Everything that a training needs, made from its settings and checked before a file of the run is written."""

import sys
from pathlib import Path

from minisplat_ref import memory
from minisplat_ref.app.runs import curve, fingerprint, memory_needs
from minisplat_ref.app.runs.continued_part import continue_part
from minisplat_ref.app.runs.opened_run import Run
from minisplat_ref.app.runs.options import Settings
from minisplat_ref.app.runs.run import Training
from minisplat_ref.app.runs.scene_part import keep_rows, read_region
from minisplat_ref.app.runs.settings import (
    check_frame,
    configure_recipe,
    find_owner,
    load_frame,
    load_lpips,
    load_photographs,
)
from minisplat_ref.app.runs.simplification import Target, check_before_training
from minisplat_ref.app.runs.start import make_start
from minisplat_ref.errors import InputError
from minisplat_ref.strategy.track_gains import store_gains
from minisplat_ref.training.calibration import REFINED, TRACKS
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import Scene

MINUTES_MIN = 0.1  # the first iterations take seconds, to compile what has not been


def prepare(folder: Path, settings: Settings) -> Training:
    """Return a training that begins.

    Raises
    ------
    InputError
        There is no such recipe, it does not go with a setting, or the scene, its photographs, the weights of LPIPS or
        the start cannot be used.
    """
    recipe = configure_recipe(settings)
    _check_minutes(settings.minutes, recipe)
    scene = _expose(load_photographs(settings), recipe)
    check_frame(settings, scene)
    if settings.eval_every:
        curve.check_views(scene)
    network = load_lpips(settings, scene)
    return Training(folder, scene, settings, recipe, _first_state(settings, scene, recipe), network)


def prepare_continued(folder: Path, settings: Settings, state: TrainState | None) -> Training:
    """Return a training that continues from a saved state, or begins again where there is none.

    Raises
    ------
    InputError
        As for :func:`prepare`, or the scene is not the one that the run was trained on.
    """
    recipe = configure_recipe(settings)
    scene = _expose(load_photographs(settings, load_frame(folder)), recipe)
    fingerprint.check(folder, scene, settings.scene)
    network = load_lpips(settings, scene)
    state = _first_state(settings, scene, recipe) if state is None else state
    return Training(folder, scene, settings, recipe, state, network)


def _expose(scene: Scene, recipe: Recipe) -> Scene:
    """Return the scene with the gains that its tracks show, where they are trained with or measured with."""
    return store_gains(scene) if scene.test_views or recipe.exposure in (TRACKS, REFINED) else scene


def _check_minutes(minutes: float | None, recipe: Recipe) -> None:
    """Refuse a time limit that means nothing to the recipe, or is over before the training begins."""
    if minutes is None:
        return
    if recipe.cooling is None:
        raise InputError(f"--minutes means nothing to recipe {recipe.name}: give --iterations, or --recipe adaptive")
    if minutes < MINUTES_MIN:
        raise InputError(f"--minutes {minutes:g} is too short to learn anything: give at least {MINUTES_MIN:g}")


def _first_state(settings: Settings, scene: Scene, recipe: Recipe) -> TrainState:
    """Return the state before the run's first iteration: from the scene's points, from --init, or of a whole."""
    region = None if settings.block is None else read_region(Path(settings.block))
    if settings.whole_iterations is not None and region is not None:
        return continue_part(settings, region, scene)
    start = make_start(settings.init, scene, recipe, settings.seed)
    for notice in start.notices:
        print(f"minisplat-ref: {notice}", file=sys.stderr)
    if start.source is not None:
        print(f"starts from {start.source}")
    return start.state if region is None else keep_rows(start.state, region.find_rows(start.state))


def simplification_target(settings: Settings) -> Target | None:
    """Return the target of the simplification after the training; None where there is none."""
    target = Target(max_drop=settings.max_drop, max_bytes=settings.max_bytes)
    return None if target == Target() else target


def check_simplification(training: Training) -> None:
    """Refuse a simplification that could not follow the training; errors as for :func:`check_before_training`."""
    folder, scene, settings, recipe, state = training[:5]
    target = simplification_target(settings)
    if target is not None:
        run = Run(folder, settings, recipe, find_owner(settings), scene, state.model, None, None)
        check_before_training(run, target)


def check_memory(training: Training) -> str:
    """Return a line about the memory that the training takes.

    Raises
    ------
    InputError
        It does not fit.
    """
    render = training.render_settings(training.state.model)
    needs = memory_needs.foresee(training.scene, training.state, render.conventions, render.backend)
    return memory.check_start(needs)
