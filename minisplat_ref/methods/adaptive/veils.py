"""Removal of veils by ``adaptive``: Gaussians where photographs and cameras show that there is nothing.

Where a photograph shows a sparse point, nothing opaque lies between the camera and the point. A Gaussian may be blended
there all the same, because it makes that photograph right where its depth does not matter; any other camera sees it as
fog. Its error is invisible in the training photographs, and its opacity gets no gradient that would remove it. So
:mod:`minisplat_ref.strategy.line_of_sight` computes which part of a Gaussian's contribution to the rays of sparse
points lies in front of these points, and Gaussians with a large part are removed. Those on no such ray are judged by
:mod:`minisplat_ref.strategy.camera_clearance` alone: beside a camera, nearer than what is known around it, there is
nothing, though no photograph looks there but from the far side. Where photographs have masks, those that are mostly
seen where no pixel counts go as well (:mod:`minisplat_ref.strategy.mask_weights`).
"""

from typing import Any

import numpy as np

from minisplat_ref.methods.adaptive.numbers import (
    CLEARANCE_SIGMAS,
    MASK_VIEWS_MAX,
    PERIOD,
    VEIL_RAYS_MAX,
    VEIL_VIEWS_MAX,
)
from minisplat_ref.rendering import activate
from minisplat_ref.strategy.camera_clearance import are_in_free_balls, find_free_balls
from minisplat_ref.strategy.line_of_sight import MARGIN, trace_sight_lines
from minisplat_ref.strategy.mask_weights import collect_mask_weights
from minisplat_ref.strategy.ops import keep, n_rows
from minisplat_ref.training.state import Iteration, TrainState, apply_edit
from minisplat_ref.types import Bools, Floats


def remove_veils(
    state: TrainState,
    iteration: Iteration,
    *,
    max_share_before: float,
    min_weight_before: float,
    clearance: float,
    min_share_counted: float,
    start: int,
) -> str | None:
    """Remove Gaussians that the sparse points of the training views, their cameras, or their masks contradict.

    Parameters
    ----------
    state, iteration
        As for every action.
    max_share_before : float
        A Gaussian stays if at most this share of its weight on the rays of sparse points is before the points.
    min_weight_before : float
        And it stays if its weight before points is less than this in total; one opaque pixel is 1.
    clearance : float
        Radius of the free balls around cameras, in units of the distance of the nearest sparse points; with 0 there are
        none.
    min_share_counted : float
        A Gaussian stays if at least this share of its weight is at pixels that count, where photographs have masks.
    start : int
        Nothing is removed until this iteration: Gaussians that cover much at first lie on several surfaces.
    """
    if iteration.step <= start:
        return None
    before, all_ = weigh_sight_lines(state, iteration)
    is_veil = (before > max_share_before * all_) & (before >= min_weight_before)
    balls = find_free_balls(iteration.scene.train_views, iteration.scene.points, clearance)
    is_beside = are_in_free_balls(activate(state.gaussians), balls, CLEARANCE_SIGMAS) & ~is_veil
    is_outside = are_outside_masks(state, iteration, min_share_counted, min_weight_before) & ~is_veil & ~is_beside
    is_removed = is_veil | is_beside | is_outside
    if is_removed.any():
        apply_edit(state, keep(state.gaussians, ~is_removed))
    n_veils, n_beside = np.count_nonzero(is_veil), np.count_nonzero(is_beside)
    message = f"{n_veils} stood before points that photographs show, {n_beside} beside cameras"
    return f"{message}, {np.count_nonzero(is_outside)} outside the masks" if is_outside.any() else message


def are_outside_masks(state: TrainState, iteration: Iteration, min_share_counted: float, min_weight: float) -> Bools:
    """Return [N], whether less than a share of a Gaussian's weight is at pixels that count; False without masks.

    Parameters
    ----------
    state, iteration
        As for every action. At most :data:`MASK_VIEWS_MAX` training views are looked at, different ones each time.
    min_share_counted : float
        The share.
    min_weight : float
        Weight, in pixels, below which a Gaussian is none of these.
    """
    none = np.zeros(n_rows(state.gaussians), bool)
    if min_share_counted == 0:
        return none
    views = _choose_evenly(iteration.scene.train_views, MASK_VIEWS_MAX, iteration.step // PERIOD)
    if all(view.mask is None for view in views):  # photographs that are not in memory are read for it: these few alone
        return none
    inside, all_ = collect_mask_weights(state.model, views, iteration.render_settings)
    return (inside < min_share_counted * all_) & (all_ >= min_weight)


def weigh_sight_lines(state: TrainState, iteration: Iteration) -> tuple[Floats, Floats]:
    """Return the weight of each Gaussian [N] on the rays of sparse points: before the points, and altogether.

    It examines at most :data:`VEIL_VIEWS_MAX` training views and :data:`VEIL_RAYS_MAX` rays of each, different ones
    each time.
    """
    scene, n, turn = iteration.scene, n_rows(state.gaussians), iteration.step // PERIOD
    views = [view for view in scene.train_views if view.point_ids is not None and len(view.point_ids)]
    before, all_ = np.zeros(n), np.zeros(n)
    for view in _choose_evenly(views, VEIL_VIEWS_MAX, turn):
        assert view.point_ids is not None
        some_points = view._replace(point_ids=_choose_evenly(view.point_ids, VEIL_RAYS_MAX, turn))
        lines = trace_sight_lines(state.model, some_points, scene.points, iteration.render_settings, MARGIN)
        all_ += np.bincount(lines.rows, lines.weights, minlength=n)
        before += np.bincount(lines.rows, lines.weights * lines.is_before, minlength=n)
    return before, all_


def _choose_evenly(items: Any, n_max: int, turn: int) -> Any:
    """Return at most ``n_max`` items, evenly spaced; each turn begins with another one."""
    stride = max(1, -(-len(items) // n_max))
    return items[turn % stride :: stride]
