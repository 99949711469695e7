"""What a recipe can do to the training state besides a gradient step.

An action is a function ``action(state, iteration, **settings)`` that changes the :class:`TrainState` it is given; a
recipe names it, its settings and the iterations at which it acts. The mathematics is in ``strategy/``; an action takes
the arguments from the state and puts the result back. :func:`apply_edit` is the one place where rows come and go.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.backends import Backend
from minisplat_ref.constants import Conventions
from minisplat_ref.optim.adam import AdamState
from minisplat_ref.strategy import clone_split
from minisplat_ref.strategy.ops import Edit, contiguous, inherit, inherit_fields, n_rows
from minisplat_ref.types import Floats, Gaussians, Ints, RenderOutput, Scene, View


@dataclass
class TrainState:
    """Everything that the next iteration depends on, besides the scene and the recipe."""

    gaussians: Gaussians
    """The parameters; their arrays are updated in place."""
    adam: AdamState[Gaussians]
    """Moments, row by row those of ``gaussians``."""
    step: int
    """Iterations done."""
    view_order: list[int]
    """Training views still to come before the list is shuffled anew; the next one stands last."""
    rng: np.random.Generator
    """The only source of randomness."""
    stats: dict[str, NDArray[Any]]
    """Arrays [N, ...] that actions collect per Gaussian; they follow the rows of ``gaussians``."""


class Iteration(NamedTuple):
    """What an action may look at: the iteration that has just been done, and its surroundings.

    Rows are those that were rendered; a recipe lists the actions that use them before those that edit rows.
    """

    scene: Scene
    view: View
    """The training view that was rendered."""
    output: RenderOutput
    """Its rendering; with blend statistics if an action of this iteration needs them."""
    visible_ids: Ints
    """[V] rows that the view saw (radius above zero), ascending."""
    v_means2d: Floats
    """[N, 2] gradient of the loss by the projected centres, per pixel."""
    backend: Backend
    conventions: Conventions


class StepReport(NamedTuple):
    """What ``train(on_step=...)`` is told after every iteration."""

    step: int
    """Iterations done, from 1."""
    loss: float
    """Training loss of ``view``, before this iteration's update."""
    view: View
    output: RenderOutput
    """The rendering that ``loss`` measures, float32, not clipped."""
    state: TrainState
    """The state after the iteration; it is safe to save."""


def apply_edit(state: TrainState, edit: Edit) -> None:
    """Replace the population; new rows get zero moments, statistics follow the parents."""
    no_reset = np.zeros(len(edit.parent_ids), bool)
    state.gaussians = contiguous(edit.gaussians)  # Adam writes through views
    state.adam = state.adam._replace(
        first=inherit_fields(state.adam.first, edit.parent_ids, edit.is_new),
        second=inherit_fields(state.adam.second, edit.parent_ids, edit.is_new),
    )
    state.stats = {name: inherit(field, edit.parent_ids, no_reset) for name, field in state.stats.items()}


def collect_gradients(state: TrainState, iteration: Iteration) -> None:
    """Add the view's positional gradients to ``stats["gradient_sum"]`` and count it in ``stats["view_count"]``."""
    n = n_rows(state.gaussians)
    if "gradient_sum" not in state.stats:
        state.stats["gradient_sum"] = np.zeros(n, iteration.v_means2d.dtype)
        state.stats["view_count"] = np.zeros(n, np.int32)
    ids, camera = iteration.visible_ids, iteration.view.camera
    norms = clone_split.screen_gradient_norms(iteration.v_means2d[ids], camera.width, camera.height)
    state.stats["gradient_sum"][ids] += norms
    state.stats["view_count"][ids] += 1


def clone_and_split(state: TrainState, iteration: Iteration, *, threshold: float, size_fraction: float) -> None:
    """Densify where the mean of the collected gradients reaches ``threshold``, and start collecting anew.

    Gaussians larger than ``size_fraction`` of the scene's extent are split, the others cloned.
    """
    means = state.stats["gradient_sum"] / np.maximum(state.stats["view_count"], 1)
    size_limit = size_fraction * iteration.scene.extent
    edit = clone_split.clone_and_split(
        state.gaussians, means, threshold=threshold, size_limit=size_limit, rng=state.rng
    )
    for name in ("gradient_sum", "view_count"):
        del state.stats[name]
    apply_edit(state, edit)


def prune_faint(state: TrainState, iteration: Iteration, *, least_opacity: float) -> None:
    """Remove Gaussians of opacity below ``least_opacity``."""
    apply_edit(state, clone_split.prune_faint(state.gaussians, least_opacity=least_opacity))


def prune_large(state: TrainState, iteration: Iteration, *, size_fraction: float) -> None:
    """Remove Gaussians larger than ``size_fraction`` of the scene's extent."""
    size_limit = size_fraction * iteration.scene.extent
    apply_edit(state, clone_split.prune_large(state.gaussians, size_limit=size_limit))


def reset_opacity(state: TrainState, iteration: Iteration, *, ceiling: float) -> None:
    """Lower all opacities to at most ``ceiling`` and forget their moments, which point back up."""
    logits = clone_split.capped_opacity_logits(state.gaussians.opacity_logits, ceiling=ceiling)
    state.gaussians = state.gaussians._replace(opacity_logits=logits)
    for moment in (state.adam.first, state.adam.second):
        moment.opacity_logits[:] = 0


def reset_opacity_on_white(state: TrainState, iteration: Iteration, *, ceiling: float) -> None:
    """As :func:`reset_opacity`, if the scene is in front of white, where early floaters hide best."""
    if np.all(iteration.scene.background == 1.0):
        reset_opacity(state, iteration, ceiling=ceiling)
