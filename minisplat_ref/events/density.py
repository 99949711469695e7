"""Density control of 3DGS as actions; the mathematics is in :mod:`minisplat_ref.strategy.clone_split`."""

import math
from collections.abc import Callable

import numpy as np

from minisplat_ref.events.state import Iteration, TrainState, apply_edit, n_pixels
from minisplat_ref.strategy import clone_split
from minisplat_ref.strategy.ops import n_rows
from minisplat_ref.types import Gaussians


def collect_gradients(state: TrainState, iteration: Iteration) -> None:
    """Add the view's positional gradients to ``stats["gradient_sum"]`` and count it in ``stats["view_count"]``.

    While views are culled (Mini-Splatting2), ``stats["gradient_factor"]`` says which part of its views a Gaussian is
    still rendered in; gradients are lowered by it, so that their mean refers to all views, as the threshold does.
    """
    n = n_rows(state.gaussians)
    if "gradient_sum" not in state.stats:
        state.stats["gradient_sum"] = np.zeros(n, iteration.v_means2d.dtype)
        state.stats["view_count"] = np.zeros(n, np.int32)
    ids, camera = iteration.visible_ids, iteration.view.camera
    norms = clone_split.screen_gradient_norms(iteration.v_means2d[ids], camera.width, camera.height)
    if "gradient_factor" in state.stats:
        norms = norms * state.stats["gradient_factor"][ids]
    state.stats["gradient_sum"][ids] += norms
    state.stats["view_count"][ids] += 1


def clone_and_split(
    state: TrainState,
    iteration: Iteration,
    *,
    threshold: float,
    size_fraction: float,
    draw_children: Callable[..., Gaussians] = clone_split.random_children,
    most_per_pixel: float = math.inf,
) -> None:
    """Densify where the mean of the collected gradients reaches ``threshold``, and start collecting anew.

    Gaussians larger than ``size_fraction`` of the scene's extent are split, the others cloned; those that
    ``stats["is_blurred"]`` marks are split whatever their size and gradient (Mini-Splatting). Nothing is done while
    there are ``most_per_pixel`` Gaussians or more for each pixel of the training views.
    """
    means = state.stats.pop("gradient_sum") / np.maximum(state.stats.pop("view_count"), 1)
    is_blurred = state.stats.pop("is_blurred", None)
    if n_rows(state.gaussians) >= most_per_pixel * n_pixels(iteration.scene):
        return
    edit = clone_split.clone_and_split(
        state.gaussians,
        means,
        is_blurred=is_blurred,
        threshold=threshold,
        size_limit=size_fraction * iteration.scene.extent,
        draw_children=draw_children,
        rng=state.rng,
    )
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
