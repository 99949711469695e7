"""The training loop: one photograph, one gradient step, and whatever the recipe says is due.

The order inside an iteration is: render, loss, gradients, Adam, then the events that are due. 3DGS runs its density
control *before* Adam, and because it replaces the parameter tensors, that iteration's step is silently lost (likewise
in Mini-Splatting; gsplat steps first, as here). Here no step is lost, not even the last.

While a recipe trains on smaller views, these are the scene's views for everything in the loop. If an event
has made a culling table (Mini-Splatting2), it says which Gaussians are rendered in a view; if one has given each
Gaussian a degree of its harmonics, neither colours nor Adam compute with the bands above it.
"""

import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref import memory
from minisplat_ref.backends import CPU, Backend
from minisplat_ref.constants import GSPLAT_MAIN, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.io.checkpoint import load_checkpoint, save_checkpoint
from minisplat_ref.io.scene import half_size
from minisplat_ref.io.stored_views import ReadingAhead, make_room
from minisplat_ref.rendering import RenderGradient, Request
from minisplat_ref.strategy.initialization import initial_gaussians
from minisplat_ref.strategy.ops import contiguous, n_rows
from minisplat_ref.training.adam import AdamRule, AdamState, adam_step, fields_of, zero_moments
from minisplat_ref.training.case import Case
from minisplat_ref.training.guard import Guard, Wrong
from minisplat_ref.training.interruption import Interruptions
from minisplat_ref.training.losses import Loss, Rendered, total_loss
from minisplat_ref.training.pace import COOLED, Cooling, Decision, Pace, to_metadata, trained_ids
from minisplat_ref.training.rates import active_sh_degree, n_coefficients
from minisplat_ref.training.saved_state import read_bundles, read_counters, read_generator, read_pace, written_by
from minisplat_ref.training.schedule import During, Event, Recipe, action_name, as_decided, describe
from minisplat_ref.training.state import (
    DEGREES,
    FiredEvent,
    Iteration,
    StepReport,
    TrainState,
    begin_cooling,
    smallest_side,
)
from minisplat_ref.types import NOTHING, Floats, Ints, Scene, View, numbered

HALF_SIZE = "half_size_views"  # name of training on views of half the size in the record of what fired
SHARED_RULE = AdamRule(is_visible_only=False, has_bias_correction=True)  # shared parameters have no visible rows

__all__ = ["StepReport", "TrainState", "initial_state", "load_state", "save_state", "train"]


def initial_state(scene: Scene, recipe: Recipe, seed: int) -> TrainState:
    """Return the state before the first iteration.

    Raises
    ------
    InputError
        The scene has no training views, or fewer than the recipe needs.
    """
    n_views = len(scene.train_views)
    if n_views == 0:
        raise InputError(f"scene {scene.name} has no training views: lower the share of test views or add photographs")
    if n_views < recipe.min_views:
        raise InputError(
            f"scene {scene.name} has {n_views} training views, recipe {recipe.name} needs at least"
            f" {recipe.min_views}: add photographs or use 3dgs-accel"
        )
    rng = np.random.default_rng(seed)
    representation = recipe.representation
    gaussians = contiguous(representation.extend(initial_gaussians(scene, recipe.sh_degree, rng), rng))
    shared = dict(representation.shared(scene, rng))
    for calibration in recipe.active_calibrations:
        shared |= calibration.initial(n_views)
    shared = {name: np.ascontiguousarray(array) for name, array in shared.items()}  # Adam writes through views
    without_rate = [name for name in (*gaussians._fields, *shared) if name not in recipe.rates.of]
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
    )


def train(
    scene: Scene,
    recipe: Recipe,
    *,
    seed: int,
    state: TrainState | None = None,
    on_step: Callable[[StepReport], None] | None = None,
    backend: Backend = CPU,
    conventions: Conventions = GSPLAT_MAIN,
    guard: Guard = Guard(),  # noqa: B008  (a constant)
) -> TrainState:
    """Train until ``recipe.iterations``, or until the recipe decides to stop.

    Parameters
    ----------
    scene : Scene
    recipe : Recipe
    seed : int
        Seed of the whole run; ignored when ``state`` is given, which has its own generator.
    state : TrainState, optional
        Where to start or continue, changed in place and returned; default ``initial_state(scene, recipe, seed)``.
    on_step : callable, optional
        Called with a :class:`StepReport` after every iteration.
    backend : Backend
    conventions : Conventions
    guard : Guard
        How often numbers are checked, and what happens when one is not finite.

    Returns
    -------
    state : TrainState
        The same seed gives the same bytes, and so does a state that was saved, loaded and continued.

    Raises
    ------
    InputError
        The scene has no training views or is not the one that ``state`` was trained on; it lacks what a loss term
        needs; a number is not finite; more Gaussians do not fit into memory; or a photograph that has to be read again
        is gone or has changed.
    KeyboardInterrupt
        After Ctrl-C: at once, or at the end of the iteration if that has begun to change the state, so that the
        ``state`` that was passed in is whole and can be saved. A second Ctrl-C does not wait for the end.

    After any of these ``state.is_whole`` says whether the state lies between two iterations and can be saved.
    """
    state = initial_state(scene, recipe, seed) if state is None else state
    scene = scene._replace(train_views=numbered(scene.train_views))
    _check_fits(state, scene, as_decided(recipe, state.pace))
    n_halvings, seen = 0, scene
    with ReadingAhead() as ahead, Interruptions() as interruptions:
        around = _Surroundings(as_decided(recipe, state.pace), backend, conventions, guard, ahead)
        switched_on = state.pace.switched_on
        while state.step < last_step(state, recipe):
            _cool_in_time(state, recipe)
            if state.pace.switched_on != switched_on:
                around, switched_on = around._replace(recipe=as_decided(recipe, state.pace)), state.pace.switched_on
            if (now := _n_halvings(state, recipe, scene)) != n_halvings:
                n_halvings, seen = now, _halved(scene, now)
            report = _iterate(state, seen, around, interruptions)
            if report.step == 1 and n_halvings and recipe.half_size_until:
                report = report._replace(fired=(_half_size_event(report, recipe), *report.fired))
            if on_step is not None:
                on_step(report)
            del report  # frees its image before the next is made
            interruptions.release()
    return state


def last_step(state: TrainState, recipe: Recipe, iterations: int | None = None) -> int:
    """Return the iteration at which the training ends, as far as is known.

    Parameters
    ----------
    state : TrainState
    recipe : Recipe
    iterations : int, optional
        Upper limit; that of the recipe by default.
    """
    most = recipe.iterations if iterations is None else iterations
    return most if recipe.cooling is None or state.pace.last_step is None else min(state.pace.last_step, most)


def _cool_in_time(state: TrainState, recipe: Recipe) -> None:
    """Begin the cool-down now if it would otherwise not end within the given iterations."""
    if recipe.cooling is None or state.pace.cooling_from is not None:
        return
    if state.step >= recipe.cooling.latest_start(recipe.iterations):
        why = f"the limit of {recipe.iterations} iterations leaves no more time"
        begin_cooling(state, recipe.cooling, recipe.iterations, Decision(state.step, COOLED, why, None, None))


def _check_fits(state: TrainState, scene: Scene, recipe: Recipe) -> None:
    """Refuse a state of another scene: its views, and its arrays with a row per view, must match the scene's."""
    n_views = len(scene.train_views)
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


def _iterate(state: TrainState, scene: Scene, around: "_Surroundings", interruptions: Interruptions) -> StepReport:
    """Do one iteration; an error before the step leaves the state as if the iteration had not begun."""
    view_order, draws = list(state.view_order), state.rng.bit_generator.state
    try:
        differentiated = _differentiate(state, scene, around)
        interruptions.defer()
    except BaseException:
        state.view_order, state.rng.bit_generator.state = view_order, draws
        raise
    state.is_whole = False
    report = _change(state, scene, around, differentiated)
    state.is_whole = True
    return report


class _Surroundings(NamedTuple):
    """What stays the same from iteration to iteration."""

    recipe: Recipe
    backend: Backend
    conventions: Conventions
    guard: Guard
    ahead: ReadingAhead


class _Differentiated(NamedTuple):
    """One training view, rendered and differentiated."""

    case: Case
    rendered: Rendered
    loss: Loss
    gradient: RenderGradient
    visible_ids: Ints
    """[V] rows that the view sees, ascending."""
    wrong: Wrong | None
    """Why the step is to be skipped, if it is."""


def _differentiate(state: TrainState, scene: Scene, around: _Surroundings) -> _Differentiated:
    """Choose a view at random, render it and differentiate its loss; only the state's random draws change."""
    recipe, step = around.recipe, state.step + 1
    renderer = recipe.renderer
    view_id = _next_view(state, len(scene.train_views), recipe.cooling)
    view = around.ahead.load(scene.train_views[view_id], _following_view(state, scene))
    terms = [term for term in recipe.losses if term.is_due(step)]
    background = state.rng.random(3) if recipe.has_random_background else scene.background
    request = Request(
        background.astype(np.float32),
        sh_degree=state.stats.get(DEGREES, active_sh_degree(step, recipe.sh_milestones)),
        conventions=around.conventions,
        backend=around.backend,
        is_visible=state.stats["is_visible"][:, view_id] if "is_visible" in state.stats else None,
        wants=frozenset().union(
            *(term.wants for term in terms),
            *(event.wants for event in _due(recipe, step) if isinstance(event, During)),
        ),
    )
    case = Case(step, state.model, view, scene, request, recipe)
    output, tape = renderer.render(case.model, view, request)
    rendered = Rendered(output, renderer.channels(request.wants), view, scene, case.model, step, request)
    loss = total_loss(terms, rendered)
    gradient = renderer.render_vjp(tape, loss.v_image, loss.v_alpha)
    assert output.visible_ids is not None, "a renderer says which rows a view sees"
    wrong = around.guard.wrong_in(case, loss, gradient)
    return _Differentiated(case, rendered, loss, gradient, output.visible_ids, wrong)


def _change(state: TrainState, scene: Scene, around: _Surroundings, differentiated: _Differentiated) -> StepReport:
    """Take the step, and run the events that are due."""
    case, rendered, loss, gradient, visible_ids, wrong = differentiated
    recipe, backend, guard, view = around.recipe, around.backend, around.guard, case.view
    notes: list[str] = []
    due = _due(recipe, case.step)
    if wrong is None:
        _step(state, _rates(state, recipe, case.step, scene.extent), around, differentiated)
    else:
        notes.append(f"iteration {case.step}, view {view.name}, {wrong}; step left out")
        due = [event for event in due if not isinstance(event, During)]  # which would collect it
    is_editing = any(not isinstance(event, During) for event in due)
    if is_editing or guard.is_due(case.step):
        guard.check_parameters(case, "Adam")
    if is_editing:
        n, n_pairs = len(state.gaussians.means), rendered.output.n_pairs
        n_bytes = sum(field.nbytes for field in state.gaussians)
        to_be_kept = make_room(scene.train_views, memory.bytes_to_double(n, n_bytes, n_pairs))
        state.max_rows = memory.rows_that_fit(n, n_bytes, n_pairs, memory.free_bytes() - to_be_kept)
    output = rendered.output._replace(image=rendered.channel("rgb"))
    iteration = Iteration(
        scene,
        view,
        output,
        visible_ids,
        gradient.means2d,
        backend,
        around.conventions,
        recipe.renderer,
        recipe.representation,
        case.step,
        recipe.iterations,
        recipe.cooling,
        notes.append,
    )
    fired: list[FiredEvent] = []
    for event in due:
        record = _act(event, state, iteration)
        if not isinstance(event, During):
            guard.check_parameters(case._replace(model=state.model), f"event {record.action}")
            fired.append(record)
    state.step = case.step
    is_open = recipe.cooling is not None and state.pace.last_step is None
    last = None if is_open else last_step(state, recipe)
    return StepReport(case.step, loss.value, view, output, state, last, tuple(fired), tuple(notes))


def _act(event: Event, state: TrainState, iteration: Iteration) -> FiredEvent:
    n_before, start = n_rows(state.gaussians), time.perf_counter()
    note = event.action(state, iteration)
    return FiredEvent(action_name(event), n_before, n_rows(state.gaussians), time.perf_counter() - start, note)


def _half_size_event(report: StepReport, recipe: Recipe) -> FiredEvent:
    """Return the first iteration's record of whether views are halved: no event, but small views are not halved."""
    n = n_rows(report.state.gaussians)
    return FiredEvent(HALF_SIZE, n, n, 0.0, f"until iteration {recipe.half_size_until}")


def _step(
    state: TrainState, rates: Mapping[str, float], around: _Surroundings, differentiated: _Differentiated
) -> None:
    """Move all parameters by one step of Adam."""
    _, _, loss, gradient, visible_ids, _ = differentiated
    backend = around.backend
    v_gaussians = _with_direct(gradient.gaussians, loss.v_gaussians)
    widths = {"sh_rest": 3 * n_coefficients(state.stats[DEGREES])} if DEGREES in state.stats else NOTHING
    state.adam = adam_step(
        state.gaussians, v_gaussians, state.adam, rates, around.recipe.adam, visible_ids, backend, widths=widths
    )
    if state.shared:
        v_shared = {name: np.zeros_like(array) for name, array in state.shared.items()}
        v_shared = _with_direct({**v_shared, **gradient.shared}, loss.v_shared)
        state.shared_adam = adam_step(
            state.shared, v_shared, state.shared_adam, rates, SHARED_RULE, visible_ids, backend
        )


def _rates(state: TrainState, recipe: Recipe, step: int, extent: float) -> dict[str, float]:
    """Return the learning rates of an iteration."""
    rates = recipe.rates.at(step, extent)
    if recipe.cooling is None or state.pace.cooling_from is None:
        return rates
    factor, factor_per_extent = recipe.cooling.factors(step, state.pace)
    per_extent = recipe.rates.per_extent
    return {name: rate * (factor_per_extent if name in per_extent else factor) for name, rate in rates.items()}


def _due(recipe: Recipe, step: int) -> list[Event]:
    """Return the events of an iteration, in their order."""
    return [event for event in recipe.events if event.is_due(step)]


def _with_direct(gradient: Any, direct: Mapping[str, Floats]) -> Any:
    """Add the direct derivatives of loss terms with respect to parameters to those via the image."""
    sums = {name: fields_of(gradient)[name] + v for name, v in direct.items()}
    return {**gradient, **sums} if isinstance(gradient, Mapping) else gradient._replace(**sums)


def _next_view(state: TrainState, n_views: int, cooling: Cooling | None) -> int:
    """Draw a view without replacement; when all views that may be trained on have been seen, shuffle them again."""
    if not state.view_order:
        state.view_order = state.rng.permutation(trained_ids(n_views, cooling, state.pace)).tolist()
    return state.view_order.pop()


def _following_view(state: TrainState, scene: Scene) -> View | None:
    """Return the view of the next iteration; None at the end of a round, where it has not been drawn yet."""
    return scene.train_views[state.view_order[-1]] if state.view_order else None


def _n_halvings(state: TrainState, recipe: Recipe, scene: Scene) -> int:
    """Return how often views are halved now; those so small that no structure would be left are not."""
    if state.step < recipe.half_size_until and smallest_side(scene) >= 2 * recipe.min_half_size:
        return 1
    return state.pace.n_halvings


def _halved(scene: Scene, times: int) -> Scene:
    """Return the scene with its training views at half the width and height, at a quarter, and so on."""
    views = scene.train_views
    for _ in range(times):
        views = tuple(map(half_size, views))
    return scene._replace(train_views=views)


def save_state(path: str | Path, state: TrainState, recipe: Recipe, *, previous: str | Path | None = None) -> None:
    """Write a checkpoint from which :func:`load_state` continues bit by bit.

    Parameters
    ----------
    path : str or Path
    state : TrainState
        Whole.
    recipe : Recipe
        By which it is trained.
    previous : str or Path, optional
        The checkpoint that was at ``path`` moves here.
    """
    assert state.is_whole, "half an iteration must not be saved"
    groups = {
        **{"gaussians": state.gaussians, "first": state.adam.first, "second": state.adam.second},
        **{"shared": state.shared, "shared_first": state.shared_adam.first, "shared_second": state.shared_adam.second},
    }
    arrays = {f"{group}.{name}": array for group, fields in groups.items() for name, array in fields_of(fields).items()}
    arrays |= {f"stats.{name}": field for name, field in state.stats.items()}
    metadata = {
        "step": state.step,
        "adam_step": state.adam.step,
        "shared_adam_step": state.shared_adam.step,
        "view_order": state.view_order,
        "rng": state.rng.bit_generator.state,
        "recipe": describe(recipe),
    }
    if recipe.cooling is not None:
        metadata["pace"] = to_metadata(state.pace)
    save_checkpoint(path, arrays, metadata, previous=previous)


def load_state(path: str | Path, recipe: Recipe) -> TrainState:
    """Read what :func:`save_state` wrote.

    Raises
    ------
    InputError
        The file is missing or damaged, or was written under another recipe.
    """
    arrays, metadata = load_checkpoint(path)
    counters = read_counters(path, metadata)
    if metadata.get("recipe") != json.loads(json.dumps(describe(recipe))):
        name, length = written_by(metadata)
        raise InputError(
            f"{path} was written by recipe {name} of {length} iterations with other settings than"
            f" {recipe.name} of {recipe.iterations} iterations: continue with the recipe of the run"
        )
    pace = Pace() if recipe.cooling is None else read_pace(path, metadata.get("pace"))
    bundles = read_bundles(path, arrays, recipe.representation.population)
    without_rate = [name for name in bundles.shared if name not in as_decided(recipe, pace).rates.of]
    if without_rate:
        raise InputError(f"{path}: holds {', '.join(without_rate)}, which recipe {recipe.name} does not train")
    return TrainState(
        bundles.gaussians,
        AdamState(bundles.first, bundles.second, counters.adam_step),
        counters.step,
        counters.view_order,
        read_generator(path, metadata.get("rng")),
        bundles.stats,
        bundles.shared,
        AdamState(bundles.shared_first, bundles.shared_second, counters.shared_adam_step),
        pace=pace,
    )
