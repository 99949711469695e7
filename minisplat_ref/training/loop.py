"""The training loop: iterations until the recipe ends.

What happens in one of them is in :mod:`minisplat_ref.training.iteration`, or, on a GPU, in its twin
:mod:`minisplat_ref.training.on_device`: which of the two pages is chosen once, by the backend.
"""

from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

from minisplat_ref.constants import GSPLAT_MAIN, Conventions
from minisplat_ref.io.stored_views import ReadingAhead
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.rendering.backends import CPU, Backend
from minisplat_ref.training import iteration
from minisplat_ref.training.guard import Guard
from minisplat_ref.training.initial_state import check_fits, initial_state
from minisplat_ref.training.interruption import Interruptions
from minisplat_ref.training.iteration import Training
from minisplat_ref.training.on_device import on_device
from minisplat_ref.training.pace import COOLED, Decision
from minisplat_ref.training.recipe_settings import apply_decisions
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.training.smaller_views import ViewSizes
from minisplat_ref.training.state import StepReport, TrainState, begin_cooling
from minisplat_ref.types import Scene, number_views


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
        Start or continue from this state, which is changed in place and returned; default ``initial_state(scene,
        recipe, seed)``.
    on_step : callable, optional
        Called with a :class:`StepReport` after every iteration.
    backend : Backend
    conventions : Conventions
    guard : Guard
        The interval between checks of numbers, and what happens when one is not finite.

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

    After any of these ``state.is_whole`` is True if the state lies between two iterations and can be saved.
    """
    state = initial_state(scene, recipe, seed) if state is None else state
    scene = scene._replace(train_views=number_views(scene.train_views))
    check_fits(state, scene, apply_decisions(recipe, state.pace))
    sizes, switched_on = ViewSizes(recipe, scene), None
    chosen: Any = nullcontext(iteration) if backend.residence is None else on_device(backend, state)
    with ReadingAhead() as ahead, Interruptions() as interruptions, chosen as engine:
        while state.step < last_step(state, recipe):
            _cool_in_time(state, recipe)
            if state.pace.switched_on != switched_on:
                switched_on, decided = state.pace.switched_on, apply_decisions(recipe, state.pace)
                settings = RenderSettings(scene.background, conventions, backend, decided.renderer)
            n_halvings = sizes.count_halvings(state.step + 1, state.pace)
            halved = sizes.halve(n_halvings)
            training = Training(decided, halved, n_halvings, settings, guard, ahead, interruptions, engine.fetch)
            report = engine.iterate(state, training)
            is_open = recipe.cooling is not None and state.pace.last_step is None
            report = report._replace(
                last_step=None if is_open else last_step(state, recipe),
                n_halvings=sizes.count_halvings(state.step + 1, state.pace),
                fired=(*sizes.record_start(state.step, report.n_gaussians), *report.fired),
            )
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
