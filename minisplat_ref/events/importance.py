"""What simplification and aggressive clone share: importance over all training views, and culling by it."""

from collections.abc import Callable

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.events.state import Iteration, TrainState
from minisplat_ref.strategy import visibility
from minisplat_ref.strategy.importance import ImportanceStats, collect_importance
from minisplat_ref.strategy.simplify import intersection_preserving
from minisplat_ref.types import Floats

Metric = Callable[[ImportanceStats], Floats]
"""Importance [N] of what all training views see: ``importance.indoor`` or ``importance.outdoor``."""


def measure_importance(state: TrainState, iteration: Iteration) -> ImportanceStats:
    """Render all training views for their blend statistics, without culling."""
    cameras = [view.camera for view in iteration.scene.train_views]
    return collect_importance(state.gaussians, cameras, conventions=iteration.conventions, backend=iteration.backend)


def candidates(stats: ImportanceStats, metric: Metric, least_views: int, *, is_intersecting: bool) -> Floats:
    """Return the importance [N], 0 for what may not be kept.

    Parameters
    ----------
    stats : ImportanceStats
    metric : Metric
    least_views : int
        Those that belong to the visible part of fewer views may not.
    is_intersecting : bool
        Those that dominate no pixel of any view may not.

    Raises
    ------
    InputError
        All importance is 0.
    """
    importance = metric(stats)
    if is_intersecting:
        importance = intersection_preserving(importance, stats.dominant_count)
    importance = np.where(visibility.seen_by_few(stats.is_visible, least_views), 0.0, importance)
    if not importance.any():
        raise InputError("no Gaussian matters to any training view: check that the cameras look at the scene's points")
    return importance


def cull(state: TrainState, stats: ImportanceStats) -> None:
    """From now on train each view with the Gaussians that carry most of its blend weight only."""
    state.stats["is_visible"] = stats.is_visible  # [N, V]
    factors = visibility.gradient_factors(stats.is_visible, stats.frustum_count)
    state.stats["gradient_factor"] = factors.astype(np.float32)


def is_culling(state: TrainState) -> bool:
    """Return whether views are culled at present."""
    return "is_visible" in state.stats
