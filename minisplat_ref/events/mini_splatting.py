"""Mini-Splatting as actions: blur split, depth reinitialisation, simplification.

The mathematics is in :mod:`minisplat_ref.strategy`: ``blur_split``, ``depth_reinit``, ``importance``, ``simplify``.
"""

from collections.abc import Callable

import numpy as np

from minisplat_ref.events.importance import Metric, candidates, cull, is_culling, measure_importance
from minisplat_ref.events.state import Iteration, TrainState, apply_edit, n_pixels, start_anew
from minisplat_ref.optim.adam import zero_moments
from minisplat_ref.strategy import blur_split
from minisplat_ref.strategy import simplify as simplification
from minisplat_ref.strategy.depth_reinit import PixelPoints, reinitial_points
from minisplat_ref.strategy.initialization import from_points
from minisplat_ref.strategy.ops import Edit, keep, n_rows


def collect_blur(state: TrainState, iteration: Iteration, *, area_fraction: float) -> None:
    """Mark in ``stats["is_blurred"]`` what dominates more than ``area_fraction`` of the view's pixels."""
    stats, camera = iteration.output.stats, iteration.view.camera
    assert stats is not None, "listed in the recipe without needs_blend_stats"
    is_blurred = blur_split.is_blurred(stats.dominant_count, camera.width, camera.height, area_fraction=area_fraction)
    marked = state.stats.get("is_blurred")
    state.stats["is_blurred"] = is_blurred if marked is None else marked | is_blurred


def reinitialise_from_depth(
    state: TrainState,
    iteration: Iteration,
    *,
    points_of: Callable[..., PixelPoints],
    least_alpha: float,
    depth_tolerance: float | None,
    backdrop_extents: float | None,
    points_per_pixel: float = 0.0,
    points_per_gaussian: float = 0.0,
) -> None:
    """Begin again with points that the views' depths give, without view-dependent colour.

    Their number is ``points_per_pixel`` of the training views' pixels and ``points_per_gaussian`` of the population.
    Points that no other view confirms to ``depth_tolerance`` move out to ``backdrop_extents`` times the scene's extent.
    """
    n_points = round(points_per_pixel * n_pixels(iteration.scene) + points_per_gaussian * n_rows(state.gaussians))
    points, colors = reinitial_points(
        state.gaussians,
        iteration.scene.train_views,
        n_points,
        points_of=points_of,
        least_alpha=least_alpha,
        depth_tolerance=depth_tolerance,
        backdrop_distance=None if backdrop_extents is None else backdrop_extents * iteration.scene.extent,
        rng=state.rng,
        conventions=iteration.conventions,
        backend=iteration.backend,
    )
    start_anew(state, from_points(points, colors, sh_degree=0))


def simplify(
    state: TrainState,
    iteration: Iteration,
    *,
    metric: Metric,
    choose: Callable[..., Edit],
    keep_fraction: float,
    budget: int | None = None,
    least_views: int = 0,
) -> None:
    """Keep ``budget`` Gaussians, or ``keep_fraction`` of those that dominate some pixel of a training view.

    Parameters
    ----------
    state, iteration
        As for every action.
    metric : callable
        What importance is.
    choose : callable
        ``choose(gaussians, importance, n, rng)`` returns the edit that leaves n.
    keep_fraction : float
        Of the candidates, when there is no budget.
    budget : int, optional
        Number of Gaussians to keep.
    least_views : int
        Those that belong to the visible part of fewer views are no candidates.
    """
    stats = measure_importance(state, iteration)
    if is_culling(state):
        cull(state, stats)
    importance = candidates(stats, metric, least_views, is_intersecting=True)
    n_candidates = int(np.count_nonzero(importance))
    n = round(keep_fraction * n_candidates) if budget is None else budget
    apply_edit(state, choose(state.gaussians, importance, n, state.rng))


def prune_tail(
    state: TrainState,
    iteration: Iteration,
    *,
    metric: Metric,
    mass: float,
    least_views: int = 0,
    is_intersecting: bool = True,
) -> None:
    """Keep the most important Gaussians that together carry ``mass`` of the importance.

    With ``is_intersecting`` only those count that dominate some pixel of a training view.
    """
    stats = measure_importance(state, iteration)
    if is_culling(state):
        cull(state, stats)
    importance = candidates(stats, metric, least_views, is_intersecting=is_intersecting)
    apply_edit(state, keep(state.gaussians, simplification.carrying_mass(importance, mass)))


def restart_from_means(state: TrainState, iteration: Iteration, *, sh_degree: int) -> None:
    """Begin again with the Gaussians' own centres and colours; all else, the moments too, is as at the start."""
    start_anew(state, simplification.reinitialised(state.gaussians, sh_degree))


def store_sh(state: TrainState, iteration: Iteration, *, sh_degree: int) -> None:
    """Make room for view-dependent colour, zero at first; the moments begin anew."""
    n = n_rows(state.gaussians)
    sh_rest = np.zeros((n, (sh_degree + 1) ** 2 - 1, 3), state.gaussians.sh_rest.dtype)
    state.gaussians = state.gaussians._replace(sh_rest=sh_rest)
    restart_adam(state, iteration)


def restart_adam(state: TrainState, iteration: Iteration) -> None:
    """Forget all moments."""
    state.adam = zero_moments(state.gaussians)
