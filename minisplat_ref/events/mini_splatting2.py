"""Mini-Splatting2 as actions: aggressive clone and visibility culling.

The mathematics is in :mod:`minisplat_ref.strategy`: ``aggressive_clone``, ``visibility``, ``importance``.
"""

import math
from collections.abc import Callable

from minisplat_ref.events.importance import cull, measure_importance
from minisplat_ref.events.state import Iteration, TrainState, apply_edit, n_pixels
from minisplat_ref.strategy import aggressive_clone as cloning
from minisplat_ref.strategy import visibility
from minisplat_ref.strategy.importance import ImportanceStats, indoor, mass_mask
from minisplat_ref.strategy.ops import keep, n_rows, take
from minisplat_ref.types import Bools

COLLECTED = ("gradient_sum", "view_count", "is_blurred")


def aggressive_clone(
    state: TrainState,
    iteration: Iteration,
    *,
    critical: Callable[[ImportanceStats], Bools],
    factor: int,
    tail_mass: float,
    least_views: int,
    most_per_pixel: float = math.inf,
) -> None:
    """Clone the critical Gaussians, after dropping those that hardly any view sees, and cull views from now on.

    Parameters
    ----------
    state, iteration
        As for every action.
    critical : callable
        Which Gaussians [N] are critical, given the views' statistics.
    factor : int
        Copies that a critical Gaussian becomes.
    tail_mass : float
        Only the most important Gaussians that carry this part of the importance stay.
    least_views : int
        Those that belong to the visible part of fewer views go.
    most_per_pixel : float
        Nothing is cloned while there are this many Gaussians or more for each pixel of the training views.
    """
    stats = measure_importance(state, iteration)
    stays = mass_mask(indoor(stats), tail_mass) & ~visibility.seen_by_few(stats.is_visible, least_views)  # [N]
    apply_edit(state, keep(state.gaussians, stays))
    stats = take(stats, stays)
    cull(state, stats)
    if n_rows(state.gaussians) < most_per_pixel * n_pixels(iteration.scene):
        apply_edit(state, cloning.clone(state.gaussians, critical(stats), factor=factor))
    for name in COLLECTED:
        state.stats.pop(name, None)


def stop_culling(state: TrainState, iteration: Iteration) -> None:
    """Train each view with all Gaussians again."""
    for name in ("is_visible", "gradient_factor"):
        state.stats.pop(name, None)
