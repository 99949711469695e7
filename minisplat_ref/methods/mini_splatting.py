"""Mini-Splatting (Fang and Wang 2024): densify by blur split and depth, then keep few Gaussians, chosen by importance.

As released, without opacity resets. The released code counts in Gaussians for photographs of a megapixel; here a scene
is measured in the pixels of its training views, of which 3.5 million points are about one in seventy.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.methods.gaussian_splatting import (
    DENSIFY_LEAST_PERIOD,
    GS,
    clone_and_split,
    collect_gradients,
    prune_faint,
    prune_large,
)
from minisplat_ref.strategy import blur_split, depth_reinit, importance, visibility
from minisplat_ref.strategy import simplify as simplification
from minisplat_ref.strategy.depth_reinit import PixelPoints, reinitial_points
from minisplat_ref.strategy.importance import ImportanceStats, collect_importance
from minisplat_ref.strategy.initialization import from_points
from minisplat_ref.strategy.ops import Edit, keep, n_rows
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.rates import LogLinear, Rewind
from minisplat_ref.training.schedule import BLEND_STATS, At, During, Every
from minisplat_ref.training.state import Iteration, TrainState, apply_edit, n_pixels, start_anew
from minisplat_ref.types import Floats

Metric = Callable[[ImportanceStats], Floats]
"""Importance [N] of what all training views see: ``importance.indoor`` or ``importance.outdoor``."""


def measure_importance(state: TrainState, iteration: Iteration) -> ImportanceStats:
    """Render all training views for their blend statistics, without culling."""
    return collect_importance(
        state.model,
        iteration.scene.train_views,
        renderer=iteration.renderer,
        conventions=iteration.conventions,
        backend=iteration.backend,
    )


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
        importance = simplification.intersection_preserving(importance, stats.dominant_count)
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


def collect_blur(state: TrainState, iteration: Iteration, *, area_fraction: float) -> None:
    """Mark in ``stats["is_blurred"]`` what dominates more than ``area_fraction`` of the view's pixels."""
    stats, camera = iteration.output.stats, iteration.view.camera
    assert stats is not None, "listed in the recipe without BLEND_STATS"
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
        state.model,
        iteration.scene.train_views,
        n_points,
        points_of=points_of,
        least_alpha=least_alpha,
        depth_tolerance=depth_tolerance,
        backdrop_distance=None if backdrop_extents is None else backdrop_extents * iteration.scene.extent,
        rng=state.rng,
        renderer=iteration.renderer,
        conventions=iteration.conventions,
        backend=iteration.backend,
    )
    start_anew(state, iteration, from_points(points, colors, sh_degree=0))


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
    start_anew(state, iteration, simplification.reinitialised(state.gaussians, sh_degree))


def store_sh(state: TrainState, iteration: Iteration, *, sh_degree: int) -> None:
    """Make room for view-dependent colour, zero at first; the moments begin anew."""
    n = n_rows(state.gaussians)
    sh_rest = np.zeros((n, (sh_degree + 1) ** 2 - 1, 3), state.gaussians.sh_rest.dtype)
    state.gaussians = state.gaussians._replace(sh_rest=sh_rest)
    restart_adam(state, iteration)


def restart_adam(state: TrainState, iteration: Iteration) -> None:
    """Forget all moments."""
    state.adam = zero_moments(state.gaussians)


POINTS_PER_PIXEL = 0.014  # 3.5 million points for some 200 photographs of 1.2 megapixels
MOST_PER_PIXEL = 0.05  # densification pauses above it; released: 0.018, which is too few where pixels are few
# Of the Gaussians that dominate some pixel; released: 0.5, and 0.6 in Mini-Splatting2. Where pixels are few, so are
# they, and hardly any can be spared.
KEEP_FRACTION = 0.9
BLUR_AREA = 2e-4  # paper, equation 2: what dominates more of an image than this is too large

# To begin anew, from depth or from the centres alone, takes a scene that is known by then and time to learn it again:
# in runs of a few thousand iterations it costs more than it gives.
REINITIALISE_LEAST_STEP = 2_000
RESTART_LEAST_STEP = 3_000
# Sky and bare walls have no depth that photographs settle. The paper takes the points as they come, which leaves veils
# in the air; here what other views do not confirm goes far behind the scene.
DEPTH_TOLERANCE = 0.05
BACKDROP_EXTENTS = 30.0
SHORT_RUN_EXPONENT = 0.3  # simplified Gaussians are few and change much: compressed runs raise their rates

_densifying = partial(Every, 100, stop=15_000, skip=5_000, least_period=DENSIFY_LEAST_PERIOD)

_densify = partial(
    clone_and_split,
    threshold=2e-4,
    size_fraction=0.01,
    draw_children=blur_split.principal_axis_children,
    most_per_pixel=MOST_PER_PIXEL,
)
_reinitialise = partial(
    reinitialise_from_depth,
    points_of=depth_reinit.midpoint_points,
    points_per_pixel=POINTS_PER_PIXEL,
    least_alpha=0.0,
    depth_tolerance=DEPTH_TOLERANCE,
    backdrop_extents=BACKDROP_EXTENTS,
)
_DENSIFICATION = (
    During(collect_gradients, stop=15_000),
    During(partial(collect_blur, area_fraction=BLUR_AREA), stop=15_000, wants=BLEND_STATS),
    _densifying(_densify, start=500),
    _densifying(partial(prune_faint, least_opacity=0.005), start=500),
    _densifying(partial(prune_large, size_fraction=0.1), start=3_000),
    Every(5_000, _reinitialise, stop=15_000, least_step=REINITIALISE_LEAST_STEP),
)
_AFTER_SIMPLIFICATION = (
    At(15_000, partial(store_sh, sh_degree=3)),
    At(15_000, partial(restart_from_means, sh_degree=3), least_step=RESTART_LEAST_STEP),
)

MINI_SPLATTING = GS._replace(
    name="mini-splatting",
    learning_rates=GS.learning_rates.changed(means=LogLinear(1.6e-4, 1.6e-6, 30_000, Rewind(at=15_000, to=5_000))),
    sh_degree=0,
    sh_milestones=(16_000, 17_000, 18_000),
    events=(
        *_DENSIFICATION,
        At(
            15_000,
            partial(
                simplify,
                metric=importance.indoor,
                choose=simplification.by_sampling,
                keep_fraction=KEEP_FRACTION,
                budget=None,
            ),
        ),
        *_AFTER_SIMPLIFICATION,
        At(20_000, partial(prune_tail, metric=importance.indoor, mass=0.99)),
        At(20_000, restart_adam),
    ),
    least_views=3,
    short_run_exponent=SHORT_RUN_EXPONENT,
)
"""``mini-splatting``: few Gaussians."""

MINI_SPLATTING_D = MINI_SPLATTING._replace(
    name="mini-splatting-d",
    events=(*_DENSIFICATION, *_AFTER_SIMPLIFICATION),
)
"""``mini-splatting-d``: densification without simplification, for quality."""
