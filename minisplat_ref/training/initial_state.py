"""The state before the first iteration, and whether a given state belongs to a scene."""

import math
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from minisplat_ref.errors import InputError, InputWarning, one_line
from minisplat_ref.io.frames import choose_frame
from minisplat_ref.strategy.initialization import initial_gaussians
from minisplat_ref.strategy.ops import contiguous
from minisplat_ref.strategy.track_gains import spread_of_gains, store_gains
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.calibration import EXPOSURE, REFINED, TRACKS, exposures_of_gains
from minisplat_ref.training.dense_start import densify_points
from minisplat_ref.training.pace import Decision, Pace
from minisplat_ref.training.population_check import check_population
from minisplat_ref.training.recipe_settings import apply_decisions, settings_of
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import FILE_FRAME, Floats, Scene


def initial_state(
    scene: Scene, recipe: Recipe, seed: int, populate: Callable[[np.random.Generator], Any] | None = None
) -> TrainState:
    """Return the state before the first iteration.

    Parameters
    ----------
    scene : Scene
    recipe : Recipe
    seed : int
        Of all random draws.
    populate : callable, optional
        ``populate(rng)`` makes the population; by default the representation does, of the scene's points.

    Raises
    ------
    InputError
        The scene has no training views, or fewer than the recipe needs, or a term of its loss has no weight that makes
        sense.
    """
    n_views = len(scene.train_views)
    if n_views == 0:
        raise InputError(f"scene {scene.name} has no training views: lower the share of test views or add photographs")
    if n_views < recipe.min_views:
        raise InputError(
            f"scene {scene.name} has {n_views} training views, recipe {recipe.name} needs at least"
            f" {recipe.min_views}: add photographs or use 3dgs-accel"
        )
    for term in recipe.losses:
        if not 0 <= term.weight < math.inf:
            raise InputError(
                f"recipe {recipe.name} weighs its loss term {term.name} by {term.weight:g}: a weight is at least 0"
            )
    rng = np.random.default_rng(seed)
    representation = recipe.representation
    if populate is None:
        if recipe.starts_densely:
            scene = _add_dense_points(scene, settings_of(recipe).get("budget"))
        first = initial_gaussians(scene, recipe.sh_degree, rng, representation.is_inside)
        gaussians = representation.extend(first, rng)
    else:
        gaussians = populate(rng)
    gaussians = contiguous(gaussians)
    shared = dict(representation.shared(scene, rng))
    check_population(recipe, gaussians, shared)
    for calibration in recipe.active_calibrations:
        shared |= calibration.initial(n_views)
    pace = Pace()
    if recipe.exposure in (TRACKS, REFINED) and (
        spread := spread_of_gains(photographs := store_gains(scene).train_views)
    ):
        shared |= exposures_of_gains(photographs)
        why = f"exposures differ by {spread:.1%}, as the tracks of the sparse points show"
        pace = Pace(decisions=(Decision(0, "exposures", why, None, None),), switched_on=(EXPOSURE.name,))
    shared = {name: np.ascontiguousarray(array) for name, array in shared.items()}  # Adam writes through views
    rates = apply_decisions(recipe, pace).rates
    without_rate = [name for name in (*gaussians._fields, *shared) if name not in rates.of]
    if without_rate:
        raise InputError(
            f"recipe {recipe.name} has no learning rate for {', '.join(without_rate)} of {representation.name}: give"
            " the representation Rates for them"
        )
    return TrainState(
        gaussians,
        zero_moments(gaussians),
        step=0,
        view_order=[],
        rng=rng,
        stats={},
        shared=shared,
        shared_adam=zero_moments(shared),
        frame=scene.frame,
        pace=pace,
    )


def begin_with(state: TrainState, population: Any, shared: Mapping[str, Floats], rng: np.random.Generator) -> None:
    """Let the state before the first iteration begin with a trained model; moments and statistics begin afresh.

    Parameters
    ----------
    state : TrainState
        Of :func:`initial_state`.
    population : NamedTuple
        Of the recipe's representation.
    shared : mapping
        The model's shared parameters. Those of the state that are not among them begin as they would, and others are
        left out.
    rng : numpy.random.Generator
        Of the training.
    """
    state.gaussians = contiguous(population)
    state.adam = zero_moments(state.gaussians)
    state.shared = {name: np.array(shared.get(name, first)) for name, first in state.shared.items()}
    state.rng = rng


def _add_dense_points(scene: Scene, budget: int | None) -> Scene:
    """Return the scene with stereo's points besides its own, evenly chosen if there are more than the budget allows."""
    points, colors = densify_points(scene)
    n_own, n = len(scene.points), len(points)
    room = n - n_own if budget is None else min(max(budget - n_own, 0), n - n_own)
    rows = np.concatenate([np.arange(n_own), np.linspace(n_own, n - 1, room).astype(int)])
    return scene._replace(points=points[rows], point_colors=colors[rows])


def check_fits(state: TrainState, scene: Scene, recipe: Recipe) -> None:
    """Refuse a state of another scene: its views, and its arrays with a row per view, must match the scene's.

    It warns of a scene that should have been moved or scaled: float32 or the near plane will spoil it.
    """
    n_views = len(scene.train_views)
    usual = choose_frame([view.camera for view in scene.train_views], scene.extent)
    if scene.frame == FILE_FRAME and usual != FILE_FRAME:
        message = (
            f"scene {scene.name} is {scene.extent:.4g} units large and {math.hypot(*usual.origin):.4g} from the origin,"
            " for which neither float32 nor the near plane is made: train io.frames.place_scene(scene)"
        )
        warnings.warn(one_line(message), InputWarning, stacklevel=3)
    if state.frame != scene.frame:
        raise InputError(
            f"scene {scene.name} is in another frame than the run to continue: place it in that of the run"
            " (io.frames.place_scene)"
        )
    if max(state.view_order, default=0) >= n_views:
        raise InputError(f"scene {scene.name} has fewer training views than the run to continue: give the same scene")
    expected = {name: a.shape for c in recipe.active_calibrations for name, a in c.initial(n_views).items()}
    differing = [name for name, shape in expected.items() if getattr(state.shared.get(name), "shape", None) != shape]
    per_view = [name for name in ("is_visible", "is_seen") if name in state.stats]
    differing += [name for name in per_view if state.stats[name].shape[1:] != (n_views,)]
    if differing:
        raise InputError(
            f"scene {scene.name} has {n_views} training views, for which the run to continue holds no"
            f" {', '.join(differing)}: give the same scene"
        )
