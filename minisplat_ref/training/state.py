"""The training state, the input of actions, and how rows are added and removed.

An action is a function ``action(state, iteration, **settings)`` that changes the :class:`TrainState` it is given; a
recipe names it, its settings and the iterations in which it acts. It returns None, or a note of a few words for the
record, for example why it has changed nothing. Only :func:`apply_edit` and :func:`start_again` add or remove rows.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.errors import InputError
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.strategy.ops import Edit, contiguous, inherit, inherit_fields
from minisplat_ref.training.adam import AdamState, zero_moments
from minisplat_ref.training.pace import Cooling, Decision, Pace
from minisplat_ref.training.representation import GAUSSIANS, Representation
from minisplat_ref.types import FILE_FRAME, NOTHING, Floats, Frame, Gaussians, Ints, Model, RenderOutput, Scene, View

DEGREES = "sh_degree"
"""Name of the statistic by which each Gaussian has a degree of the spherical harmonics for itself."""


@dataclass
class TrainState:
    """Everything that the next iteration depends on, besides the scene and the recipe."""

    gaussians: Any
    """The population: :class:`Gaussians` or an extension's; its arrays are updated in place."""
    adam: AdamState[Any]
    """Moments, in the rows of ``gaussians``."""
    step: int
    """Iterations done."""
    view_order: list[int]
    """Training views still to come before the list is shuffled again; the next one is last."""
    rng: np.random.Generator
    """The only source of randomness."""
    stats: dict[str, NDArray[Any]]
    """Arrays [N, ...] that actions collect per Gaussian; they follow the rows of ``gaussians``."""
    shared: dict[str, Floats] = field(default_factory=dict)
    """Parameters without rows, by name; their arrays are updated in place."""
    shared_adam: AdamState[Any] = field(default_factory=lambda: AdamState({}, {}, 0))
    """Moments of the shared parameters."""
    pace: Pace = field(default_factory=Pace)
    """Measurements and decisions of a recipe that decides its own length."""
    is_whole: bool = True
    """False while an iteration changes the state; if it stays so, the iteration failed halfway: do not save."""
    max_rows: float = math.inf
    """Rows that memory has room for, as far as is known."""
    frame: Frame = FILE_FRAME
    """That of the scene, in which the parameters are."""

    @property
    def model(self) -> Model:
        """Return the parameters, as the renderer takes them."""
        return Model(self.gaussians, self.shared)


def ignore_message(text: str) -> None:
    """Discard a message."""


class Iteration(NamedTuple):
    """The input of an action besides the state: the iteration just done, and its context.

    Rows are those that were rendered; a recipe lists the actions that use them before those that edit rows.
    """

    scene: Scene
    view: View
    """The training view that was rendered."""
    output: RenderOutput
    """Its rendering, with blend statistics if an action of this iteration wants them."""
    visible_ids: Ints
    """[V] rows that the view saw (radius above zero), ascending."""
    v_means2d: Floats
    """[N, 2] gradient of the loss with respect to the projected centres, per pixel; [N, 2 K] if rows are rendered as
    K."""
    render_settings: RenderSettings = RenderSettings()
    """Options of rendering the model."""
    representation: Representation = GAUSSIANS
    """Population and renderer."""
    step: int = 0
    """Its number, from 1."""
    iterations: int = 0
    """Upper limit of the training's length."""
    cooling: Cooling | None = None
    """The end of a training without a schedule."""
    rates: Callable[[], Mapping[str, float]] = lambda: NOTHING
    """Returns the learning rates of the iteration's step by the name of the parameter, per world unit where they are
    per unit of the extent."""
    n_halvings: int = 0
    """Number of times that the views were halved in width and height."""
    say: Callable[[str], None] = ignore_message
    """Tells the user something in one line, at once; a note for the record alone is returned instead."""
    fetch: Callable[[], Any] = lambda: None
    """Copies parameters and moments into the state, where a GPU has newer ones. Only actions whose event does not read
    parameters (``reads_parameters`` of :class:`minisplat_ref.training.schedule.During`) need it."""


class FiredEvent(NamedTuple):
    """The record of one event in an iteration; events of every iteration (``During``) are not recorded."""

    action: str
    """Name of the action, as in ``describe``."""
    n_before: int
    """Gaussians when it began."""
    n_after: int
    """Gaussians when it was done."""
    seconds: float
    """Time that it took."""
    note: str | None = None
    """The action's note, such as why it has changed nothing."""


class StepReport(NamedTuple):
    """The report that ``train`` passes to ``on_step`` after every iteration."""

    step: int
    """Iterations done, from 1."""
    loss: float
    """Training loss of ``view``, before this iteration's update."""
    view: View
    output: RenderOutput
    """The rendering that ``loss`` measures, float32, not clipped."""
    n_gaussians: int
    n_bytes: int
    """Of their parameters."""
    fetch: Callable[[], TrainState]
    """Copies parameters and moments into the state, where a GPU has newer ones, and returns it."""
    last_step: int | None = None
    """Iteration at which the training ends; None while a recipe that decides this has not done so."""
    n_halvings: int = 0
    """Number of times that the views of the next iteration are halved in width and height."""
    fired: tuple[FiredEvent, ...] = ()
    """Events that acted after the gradient step, in their order."""
    notes: tuple[str, ...] = ()
    """Messages to the user, one line each."""

    @property
    def state(self) -> TrainState:
        """Return the state after the iteration, fetched; it is safe to save."""
        return self.fetch()


def n_pixels(scene: Scene) -> int:
    """Return the number of pixels of all training views: the amount of data to learn from."""
    return sum(view.camera.width * view.camera.height for view in scene.train_views)


def begin_cooling(
    state: TrainState, cooling: Cooling, iterations: int, decision: Decision, length: int | None = None
) -> None:
    """Begin the cool-down: from the next iteration on, rates fall, and all training views are trained on.

    If the recipe prunes while the rates fall, views are held back until it has.

    Parameters
    ----------
    state : TrainState
    cooling : Cooling
        Of the recipe.
    iterations : int
        Iteration at which the training ends at the latest.
    decision : Decision
        The reason; its ``step`` is the last at constant rates.
    length : int, optional
        Iterations of the cool-down; by default ``cooling.part`` of those before it.
    """
    length = max(1, math.ceil(cooling.part * decision.step)) if length is None else length
    state.pace = state.pace.with_decision(decision)._replace(
        cooling_from=decision.step,
        last_step=min(decision.step + length, iterations),
        is_pruning=cooling.prune_passes > 0,
    )
    state.view_order = []


def apply_edit(state: TrainState, edit: Edit) -> None:
    """Replace the population; new rows get zero moments, and statistics follow the parents.

    Raises
    ------
    InputError
        So many rows do not fit into memory.
    """
    _check_room(state, len(edit.parent_ids))
    no_reset = np.zeros(len(edit.parent_ids), bool)
    state.gaussians = contiguous(edit.gaussians)  # Adam writes through views
    state.adam = state.adam._replace(
        first=inherit_fields(state.adam.first, edit.parent_ids, edit.is_new),
        second=inherit_fields(state.adam.second, edit.parent_ids, edit.is_new),
    )
    state.stats = {name: inherit(array, edit.parent_ids, no_reset) for name, array in state.stats.items()}


def start_again(state: TrainState, iteration: Iteration, gaussians: Gaussians) -> None:
    """Replace the population and forget its history: zero moments, no statistics, all views still to come.

    Fields that the representation has besides those of ``gaussians`` get their initial values. Shared parameters stay,
    and so does the precision of the population.

    Raises
    ------
    InputError
        So many rows do not fit into memory.
    """
    _check_room(state, len(gaussians.means))
    dtype = state.gaussians.means.dtype
    fresh = iteration.representation.extend(gaussians, state.rng)
    state.gaussians = contiguous(type(fresh)(*(field.astype(dtype, copy=False) for field in fresh)))
    state.adam = zero_moments(state.gaussians)
    state.stats = {}
    state.view_order = []


def _check_room(state: TrainState, n: int) -> None:
    if n > max(state.max_rows, len(state.gaussians.means)):
        raise InputError(
            f"there is no memory for {n:,} Gaussians, only for some {state.max_rows:,.0f}: train on smaller"
            " photographs (--downscale), or by a recipe that keeps to a --budget"
        )
