"""One iteration of a training: one photograph, one gradient step, and the events of the recipe that are due.

The order is: render, loss, gradients, Adam, then the events. 3DGS runs its density control *before* Adam, and because
it replaces the parameter tensors, that iteration's step is silently lost (likewise in Mini-Splatting; gsplat steps
first, as here). Here no step is lost, not even the last.

While a recipe trains on smaller views, these are the scene's views for everything in an iteration. If an event has made
a culling table (Mini-Splatting2), it says which Gaussians are rendered in a view; if one has given each Gaussian a
degree of its harmonics, neither colours nor Adam compute with the degrees above it.
"""

import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref import memory
from minisplat_ref.io.stored_views import ReadingAhead, make_room
from minisplat_ref.rendering import RenderGradient, RenderSettings, Request
from minisplat_ref.strategy.ops import n_rows
from minisplat_ref.training.adam import AdamRule, adam_step, fields_of
from minisplat_ref.training.case import Case
from minisplat_ref.training.guard import Guard, Wrong
from minisplat_ref.training.interruption import Interruptions
from minisplat_ref.training.losses import Loss, LossTerm, Rendered, total_loss
from minisplat_ref.training.pace import Cooling, trained_ids
from minisplat_ref.training.rates import active_sh_degree, n_coefficients
from minisplat_ref.training.resident import Differentiated as OnDevice
from minisplat_ref.training.resident import Residence
from minisplat_ref.training.schedule import DatedEvent, During, Recipe, action_name
from minisplat_ref.training.state import DEGREES, FiredEvent, Iteration, StepReport, TrainState
from minisplat_ref.types import NOTHING, Floats, Ints, Model, Scene, View

SHARED_RULE = AdamRule(is_visible_only=False, has_bias_correction=True)  # shared parameters have no visible rows


class Surroundings(NamedTuple):
    """What an iteration depends on besides the state."""

    recipe: Recipe
    """With the calibrations on that the training has switched on."""
    scene: Scene
    """Its training views as they are trained on."""
    n_halvings: int
    """How often these were halved."""
    render_settings: RenderSettings
    guard: Guard
    ahead: ReadingAhead
    residence: Residence | None = None
    """Where the arrays are while the backend keeps them on a device."""


def iterate(state: TrainState, around: Surroundings, interruptions: Interruptions) -> StepReport:
    """Do one iteration; an error before the step leaves the state as if the iteration had not begun."""
    view_order, draws = list(state.view_order), state.rng.bit_generator.state
    try:
        differentiated = _differentiate(state, around)
        interruptions.defer()
    except BaseException:
        state.view_order, state.rng.bit_generator.state = view_order, draws
        raise
    state.is_whole = False
    report = _change(state, around, differentiated)
    state.is_whole = True
    return report


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
    on_device: OnDevice | None = None
    """The same on a device; then the fields above have no gradient and no rows."""


def _differentiate(state: TrainState, around: Surroundings) -> _Differentiated:
    """Choose a view at random, render it and differentiate its loss; only the state's random draws change."""
    recipe, scene, step = around.recipe, around.scene, state.step + 1
    renderer = around.render_settings.renderer
    view_id = _next_view(state, len(scene.train_views), recipe.cooling)
    view = around.ahead.load(scene.train_views[view_id], _following_view(state, scene))
    terms = [term for term in recipe.losses if term.is_due(step)]
    background = state.rng.random(3) if recipe.has_random_background else scene.background
    wants = [term.wants for term in terms] + [event.wants for event in _due(recipe, step) if isinstance(event, During)]
    request = around.render_settings.request(frozenset().union(*wants))._replace(
        background=background.astype(np.float32),
        sh_degree=state.stats.get(DEGREES, active_sh_degree(step, recipe.sh_milestones)),
        is_visible=state.stats["is_visible"][:, view_id] if "is_visible" in state.stats else None,
    )
    if around.residence is not None and around.residence.stays_here(state, request, recipe, terms):
        return _differentiate_on_device(state, around, around.residence, (view, request, terms[0]))
    case = Case(step, state.model, view, scene, request, recipe)
    output, tape = renderer.render(case.model, view, request)
    rendered = Rendered(output, renderer.channels(request.wants), view, scene, case.model, step, request)
    loss = total_loss(terms, rendered)
    gradient = renderer.render_vjp(tape, loss.v_image, loss.v_alpha)
    assert output.visible_ids is not None, "a renderer says which rows a view sees"
    wrong = around.guard.wrong_in(case, loss, gradient)
    return _Differentiated(case, rendered, loss, gradient, output.visible_ids, wrong)


def _differentiate_on_device(
    state: TrainState, around: Surroundings, residence: Residence, wanted: tuple[View, Request, LossTerm]
) -> _Differentiated:
    """Do the same with arrays that stay on the device."""
    view, request, term = wanted
    found = residence.differentiate(state, view, request, term)
    case = Case(state.step + 1, Model(residence.gaussians), view, around.scene, request, around.recipe)
    wrong = residence.wrong_in(found, state, case, around.guard)
    rendered = Rendered(found.output, {"rgb": slice(0, 3)}, view, around.scene, case.model, case.step, request)
    loss = Loss(found.loss, found.v_image, None, NOTHING, NOTHING)
    nothing: Any = np.empty(0)
    gradient = RenderGradient(found.gradient, nothing, nothing, nothing, nothing)
    return _Differentiated(case, rendered, loss, gradient, np.empty(0, np.int64), wrong, found)


def _change(state: TrainState, around: Surroundings, differentiated: _Differentiated) -> StepReport:
    """Take the step, and run the events that are due."""
    case, rendered, loss, *_ = differentiated
    recipe, scene, guard, wrong = around.recipe, around.scene, around.guard, differentiated.wrong
    notes = [] if around.residence is None else around.residence.take_notes()
    due = _due(recipe, case.step)
    if wrong is None:
        _step(state, _rates(state, recipe, case.step, scene.extent), around, differentiated)
    else:
        notes.append(f"iteration {case.step}, view {case.view.name}, {wrong}; step left out")
        due = [event for event in due if not isinstance(event, During)]  # which would collect it
    may_edit = any(isinstance(event, DatedEvent) for event in due)
    if may_edit or guard.is_due(case.step):
        _check_parameters(case, state, around, differentiated)
    if may_edit:
        state.max_rows = _rows_that_fit(state, scene, rendered.output.n_pairs)
    iteration = _iteration_done(around, differentiated, due)._replace(say=notes.append)
    fired: list[FiredEvent] = []
    for event in due:
        record = _act(event, state, iteration)
        if isinstance(event, DatedEvent):
            guard.check_parameters(case._replace(model=state.model), f"event {record.action}")
            fired.append(record)
    state.step = case.step
    return StepReport(case.step, loss.value, case.view, iteration.output, state, fired=tuple(fired), notes=tuple(notes))


def _rows_that_fit(state: TrainState, scene: Scene, n_pairs: int) -> float:
    """Return how many rows memory has room for, after photographs that can be read again have left it if need be."""
    n, n_bytes = n_rows(state.layout), sum(field.nbytes for field in state.layout)
    to_be_kept = make_room(scene.train_views, memory.bytes_to_double(n, n_bytes, n_pairs))
    return memory.rows_that_fit(n, n_bytes, n_pairs, memory.free_bytes() - to_be_kept)


def _check_parameters(case: Case, state: TrainState, around: Surroundings, differentiated: _Differentiated) -> None:
    """Check the parameters after the step; those on a device are copied back only if one of them is wrong."""
    if differentiated.on_device is None:
        around.guard.check_parameters(case, "Adam")
    elif around.residence is not None and around.residence.has_wrong():
        around.guard.check_parameters(case._replace(model=state.model), "Adam")


def _iteration_done(around: Surroundings, differentiated: _Differentiated, due: Sequence[object]) -> Iteration:
    """Return what the actions are told about the iteration; from a device, only if one of them is due."""
    case, rendered, gradient = differentiated.case, differentiated.rendered, differentiated.gradient
    visible_ids, v_means2d, output = differentiated.visible_ids, gradient.means2d, rendered.output
    if differentiated.on_device is None or around.residence is None:
        output = output._replace(image=rendered.channel("rgb"))
    elif due:
        visible_ids, v_means2d = around.residence.what_events_need(differentiated.on_device)
    return Iteration(
        around.scene,
        case.view,
        output,
        visible_ids,
        v_means2d,
        around.render_settings,
        around.recipe.representation,
        case.step,
        around.recipe.iterations,
        around.recipe.cooling,
        around.n_halvings,
    )


def _act(event: During | DatedEvent, state: TrainState, iteration: Iteration) -> FiredEvent:
    n_before, start = n_rows(state.layout), time.perf_counter()
    note = event.action(state, iteration)
    return FiredEvent(action_name(event), n_before, n_rows(state.layout), time.perf_counter() - start, note)


def _step(state: TrainState, rates: Mapping[str, float], around: Surroundings, differentiated: _Differentiated) -> None:
    """Move all parameters by one step of Adam."""
    loss, gradient, visible_ids = differentiated.loss, differentiated.gradient, differentiated.visible_ids
    if differentiated.on_device is not None and around.residence is not None:
        around.residence.step(state, rates, around.recipe.adam, differentiated.on_device)
        return
    backend = around.render_settings.backend
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


def _due(recipe: Recipe, step: int) -> list[During | DatedEvent]:
    """Return the events that act in an iteration, in their order."""
    return [event for event in recipe.events if isinstance(event, During | DatedEvent) and event.is_due(step)]


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
