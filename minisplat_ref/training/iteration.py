"""One iteration of a training: one photograph, one gradient step, and the events of the recipe that are due.

The order is: render, loss, gradients, Adam, then the events. 3DGS runs its density control *before* Adam, and because
it replaces the parameter tensors, that iteration's step is silently lost (likewise in Mini-Splatting; gsplat steps
first, as here). Here no step is lost, not even the last.

While a recipe trains on smaller views, these are the scene's views for everything in an iteration. If an event has made
a culling table (Mini-Splatting2), it says which Gaussians are rendered in a view; if one has given each Gaussian a
degree of its harmonics, neither colours nor Adam compute with the degrees above it.

The twin of this page for arrays that stay on a GPU is :mod:`minisplat_ref.training.on_device`.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref import memory
from minisplat_ref.io.stored_views import ReadingAhead, make_room
from minisplat_ref.rendering import RenderGradient, RenderSettings
from minisplat_ref.strategy.ops import n_rows
from minisplat_ref.training.adam import AdamRule, adam_step, named_fields
from minisplat_ref.training.case import Case
from minisplat_ref.training.dropout import leave_out
from minisplat_ref.training.guard import Guard, Wrong
from minisplat_ref.training.interruption import Interruptions
from minisplat_ref.training.losses import Loss, Rendered, total_loss
from minisplat_ref.training.pace import trained_ids
from minisplat_ref.training.rates import active_sh_degree, n_coefficients
from minisplat_ref.training.schedule import DatedEvent, During, Recipe, action_name
from minisplat_ref.training.state import DEGREES, FiredEvent, Iteration, StepReport, TrainState
from minisplat_ref.types import NOTHING, Floats, Ints, RenderOutput, Scene

SHARED_RULE = AdamRule(is_visible_only=False, has_bias_correction=True)  # shared parameters have no visible rows


class Training(NamedTuple):
    """The inputs of an iteration besides the state."""

    recipe: Recipe
    """With the calibrations on that the training has switched on."""
    scene: Scene
    """With its training views at their present size."""
    n_halvings: int
    """Number of times that they were halved."""
    render_settings: RenderSettings
    guard: Guard
    ahead: ReadingAhead
    interruptions: Interruptions
    fetch: Callable[[TrainState], TrainState]
    """Copies arrays into the state where a GPU has newer ones: :func:`fetch`, or the method of its twin."""


def iterate(state: TrainState, training: Training) -> StepReport:
    """Do one iteration; an error before the step leaves the state as if the iteration had not begun."""
    guard = training.guard
    with restore_draws(state):
        case = draw_case(state, training)
        rendered, loss, gradient = differentiate(case, training)
        wrong = guard.check_step(case, loss, gradient)
        output = rendered.output._replace(image=rendered.channel("rgb"))
        assert output.visible_ids is not None, "a renderer says which rows a view sees"
        training.interruptions.defer()
    state.is_whole = False
    if wrong is None:
        take_step(state, case, loss, gradient, output.visible_ids)
    if guard.is_due(case.step) or training.recipe.may_edit(case.step):
        guard.check_parameters(case, "Adam")
    return run_events(state, training, Stepped(case, loss.value, output, output.visible_ids, gradient.means2d, wrong))


def fetch(state: TrainState) -> TrainState:
    """Return the state, whose arrays are in memory."""
    return state


@contextmanager
def restore_draws(state: TrainState) -> Iterator[None]:
    """Undo the random draws of an iteration that fails, the only change of the state before its step."""
    view_order, draws = list(state.view_order), state.rng.bit_generator.state
    try:
        yield
    except BaseException:
        state.view_order, state.rng.bit_generator.state = view_order, draws
        raise


def draw_case(state: TrainState, training: Training) -> Case:
    """Draw a view without replacement, shuffling them again after the last, and make the request that renders it."""
    recipe, scene, step = training.recipe, training.scene, state.step + 1
    if not state.view_order:
        ids = trained_ids(len(scene.train_views), recipe.cooling, state.pace)
        state.view_order = state.rng.permutation(ids).tolist()
    view_id = state.view_order.pop()
    following = scene.train_views[state.view_order[-1]] if state.view_order else None  # else it is not drawn yet
    view = training.ahead.load(scene.train_views[view_id], following)
    background = state.rng.random(3) if recipe.has_random_background else scene.background
    request = training.render_settings.request(recipe.wants(step))._replace(
        background=background.astype(np.float32),
        sh_degree=state.stats.get(DEGREES, active_sh_degree(step, recipe.sh_milestones)),
        is_visible=state.stats["is_visible"][:, view_id] if "is_visible" in state.stats else None,
    )
    if share := recipe.drop_share(step):
        request = leave_out(request, n_rows(state.gaussians), share, state.rng)
    return Case(step, state.model, view, scene, request, recipe)


def differentiate(case: Case, training: Training) -> tuple[Rendered, Loss, RenderGradient]:
    """Render the view, compare it with its photograph, and chain the gradient of the loss to the parameters."""
    renderer, view, request = training.render_settings.renderer, case.view, case.request
    output, tape = renderer.render(case.model, view, request)
    channels = renderer.channels(request.wants)
    rendered = Rendered(output, channels, view, case.scene, case.model, case.step, request)
    loss = total_loss(case.terms, rendered)
    return rendered, loss, renderer.render_vjp(tape, loss.v_image, loss.v_alpha)


def take_step(state: TrainState, case: Case, loss: Loss, gradient: RenderGradient, visible_ids: Ints) -> None:
    """Move all parameters by one step of Adam, along the gradient via the image and the direct one of loss terms."""
    recipe, backend = case.recipe, case.request.backend
    rates = recipe.rates_at(case.step, case.scene.extent, state.pace)
    widths = {"sh_rest": 3 * n_coefficients(state.stats[DEGREES])} if DEGREES in state.stats else NOTHING
    v_gaussians = _add(gradient.gaussians, loss.v_gaussians)
    state.adam = adam_step(
        state.gaussians, v_gaussians, state.adam, rates, recipe.adam, visible_ids, backend, widths=widths
    )
    if state.shared:
        v_shared = {name: np.zeros_like(array) for name, array in state.shared.items()}
        v_shared = _add({**v_shared, **gradient.shared}, loss.v_shared)
        state.shared_adam = adam_step(
            state.shared, v_shared, state.shared_adam, rates, SHARED_RULE, visible_ids, backend
        )


def _add(gradient: Any, direct: Mapping[str, Floats]) -> Any:
    sums = {name: named_fields(gradient)[name] + v for name, v in direct.items()}
    return {**gradient, **sums} if isinstance(gradient, Mapping) else gradient._replace(**sums)


class Stepped(NamedTuple):
    """An iteration whose step has been taken, or left out."""

    case: Case
    loss: float
    output: RenderOutput
    visible_ids: Ints
    """[V] rows that the view saw, ascending."""
    v_means2d: Floats
    wrong: Wrong | None
    """Why the step was left out, if it was."""


def due_events(case: Case, wrong: Wrong | None) -> list[During | DatedEvent]:
    """Return the events that act after the step, in their order; none collects the gradient of a step left out."""
    return [event for event in case.recipe.due_events(case.step) if wrong is None or isinstance(event, DatedEvent)]


def run_events(state: TrainState, training: Training, stepped: Stepped) -> StepReport:
    """Run the events that are due, and complete the iteration."""
    case, _, output, visible_ids, v_means2d, wrong = stepped
    recipe, fetch = training.recipe, partial(training.fetch, state)
    notes: list[str] = []
    fired: list[FiredEvent] = []
    if wrong is not None:
        notes.append(f"iteration {case.step}, view {case.view.name}, {wrong}; step left out")
    if recipe.may_edit(case.step):
        state.max_rows = _rows_that_fit(state, case.scene, output.n_pairs)
    iteration = Iteration(
        case.scene,
        case.view,
        output,
        visible_ids,
        v_means2d,
        training.render_settings,
        recipe.representation,
        case.step,
        recipe.iterations,
        recipe.cooling,
        partial(recipe.rates_at, case.step, case.scene.extent, state.pace),
        training.n_halvings,
        say=notes.append,
        fetch=fetch,
    )
    for event in due_events(case, wrong):
        n_before, start = n_rows(state.gaussians), time.perf_counter()
        note = event.action(state, iteration)
        if isinstance(event, DatedEvent):
            name, seconds = action_name(event), time.perf_counter() - start
            fired.append(FiredEvent(name, n_before, n_rows(state.gaussians), seconds, note))
            training.guard.check_parameters(case._replace(model=state.model), f"event {name}")
    state.step, state.is_whole = case.step, True
    n, n_bytes = n_rows(state.gaussians), sum(field.nbytes for field in state.gaussians)
    report = StepReport(case.step, stepped.loss, case.view, output, n, n_bytes, fetch)
    return report._replace(fired=tuple(fired), notes=tuple(notes))


def _rows_that_fit(state: TrainState, scene: Scene, n_pairs: int) -> float:
    """Return how many rows memory has room for, after photographs that can be read again have left it if need be."""
    n, n_bytes = n_rows(state.gaussians), sum(field.nbytes for field in state.gaussians)
    to_be_kept = make_room(scene.train_views, memory.bytes_to_double(n, n_bytes, n_pairs))
    return memory.rows_that_fit(n, n_bytes, n_pairs, memory.free_bytes() - to_be_kept)
