"""Mini-Splatting (Fang and Wang 2024): densify by blur split and depth, then keep few Gaussians, chosen by importance.

As released, without opacity resets. Where the released code has constants for photographs of a megapixel, ours depend
on the scene: as many points are sampled as there were Gaussians, and a blurred Gaussian covers at least a few pixels.
``docs/FIDELITY.md`` lists each difference.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.methods.gaussian_splatting import (
    DENSIFY_LEAST_GAP,
    GS,
    clone_and_split,
    collect_gradients,
    prune_faint,
)
from minisplat_ref.strategy import blur_split, clone_split, depth_reinit, importance, visibility
from minisplat_ref.strategy import simplify as simplification
from minisplat_ref.strategy.depth_reinit import PixelPoints, reinitial_points
from minisplat_ref.strategy.importance import ImportanceStats, collect_importance
from minisplat_ref.strategy.initialization import gaussians_from_points
from minisplat_ref.strategy.ops import Edit, keep, n_rows
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.rates import LogLinear, Rewind
from minisplat_ref.training.schedule import BLEND_STATS, At, During, Every
from minisplat_ref.training.state import Iteration, TrainState, apply_edit, start_again
from minisplat_ref.types import Floats, Gaussians, Scene

ImportanceMetric = Callable[[ImportanceStats], Floats]
"""Maps the statistics of all training views to importance [N]: ``importance.indoor`` or ``importance.outdoor``."""

LARGE = 0.1  # of the scene's extent, or of the distance: no Gaussian should be larger
VISIBILITY_MASS = 0.99  # fraction of a view's blend weight that its visible Gaussians carry (Mini-Splatting2)


def measure_importance(
    state: TrainState, iteration: Iteration, visibility_mass: float = VISIBILITY_MASS
) -> ImportanceStats:
    """Render all training views for their blend statistics, without culling.

    ``visibility_mass`` is the fraction of a view's blend weight that its visible Gaussians carry.
    """
    return collect_importance(
        state.model, iteration.scene.train_views, iteration.render_settings, visibility_mass=visibility_mass
    )


def candidates(stats: ImportanceStats, metric: ImportanceMetric, min_views: int, *, is_intersecting: bool) -> Floats:
    """Return the importance [N], 0 for Gaussians that may not be kept.

    Parameters
    ----------
    stats : ImportanceStats
    metric : ImportanceMetric
    min_views : int
        Those that are visible in fewer views may not.
    is_intersecting : bool
        If True, those that dominate no pixel of any view may not.

    Raises
    ------
    InputError
        All importance is 0.
    """
    importance = metric(stats)
    if is_intersecting:
        importance = simplification.intersection_preserving(importance, stats.dominant_count)
    importance = np.where(visibility.find_seen_by_few(stats.is_visible, min_views), 0.0, importance)
    if not importance.any():
        raise InputError(
            "no Gaussian matters to any training view: check that the cameras look at the scene's points, and that"
            " masks are white where the scene counts"
        )
    return importance


def cull(state: TrainState, stats: ImportanceStats) -> None:
    """From now on train each view only with the Gaussians that carry most of its blend weight."""
    state.stats["is_visible"] = stats.is_visible  # [N, V]
    factors = visibility.gradient_factors(stats.is_visible, stats.frustum_count)
    state.stats["gradient_factor"] = factors.astype(np.float32)


def is_culling(state: TrainState) -> bool:
    """Return whether views are currently culled."""
    return "is_visible" in state.stats


def collect_blur(state: TrainState, iteration: Iteration, *, area_fraction: float, min_area: int = 0) -> None:
    """Mark in ``stats["is_blurred"]`` the Gaussians that dominate more than ``area_fraction`` of the view's pixels.

    A Gaussian that dominates at most ``min_area`` pixels is not blurred, however small the view.
    """
    stats, camera = iteration.output.stats, iteration.view.camera
    assert stats is not None, "listed in the recipe without BLEND_STATS"
    is_blurred = blur_split.is_blurred(
        stats.dominant_count, camera.width, camera.height, area_fraction=area_fraction, min_area=min_area
    )
    marked = state.stats.get("is_blurred")
    state.stats["is_blurred"] = is_blurred if marked is None else marked | is_blurred


def reinitialise_from_depth(
    state: TrainState,
    iteration: Iteration,
    *,
    points_of: Callable[..., PixelPoints],
    min_alpha: float,
    depth_tolerance: float | None,
    backdrop_extents: float | None,
    points_per_gaussian: float,
    largest_size: float,
    drawn_mass: float | None = None,
) -> None:
    """Start again from points that the views' depths give, without view-dependent colour.

    Their number is ``points_per_gaussian`` times that of the population. Points that other views see through, by more
    than ``depth_tolerance``, move out to ``backdrop_extents`` times the scene's extent. With ``drawn_mass``, only the
    Gaussians that carry this fraction of the importance are rendered for the depths (Mini-Splatting2); the number of
    points is that of the population before. No Gaussian begins larger than :func:`size_limits` with the fraction
    ``largest_size``.
    """
    n_points = round(points_per_gaussian * n_rows(state.gaussians))
    if drawn_mass is not None:
        prune_tail(state, iteration, metric=importance.indoor, mass=drawn_mass)
    points, colors = reinitial_points(
        state.model,
        iteration.scene.train_views,
        n_points,
        settings=iteration.render_settings,
        points_of=points_of,
        min_alpha=min_alpha,
        depth_tolerance=depth_tolerance,
        backdrop_distance=None if backdrop_extents is None else backdrop_extents * iteration.scene.extent,
        rng=state.rng,
    )
    gaussians = gaussians_from_points(points, colors, sh_degree=0)
    start_again(state, iteration, limit_sizes(gaussians, iteration.scene, largest_size))


def size_limits(means: Floats, scene: Scene, size_fraction: float) -> Floats:
    """Return the largest sizes [N], world units: a fraction of the scene's extent, or of the distance where larger.

    The distance is from the mean of the cameras. In 3DGS the limit is the same everywhere, so that distant things, such
    as the sky, could not be covered.
    """
    center = np.mean([view.camera.center for view in scene.train_views], axis=0)  # [3]
    return size_fraction * np.maximum(scene.extent, np.linalg.norm(means - center, axis=1))


def limit_sizes(gaussians: Gaussians, scene: Scene, size_fraction: float) -> Gaussians:
    """Return Gaussians that are no larger than :func:`size_limits`.

    A Gaussian that is started again is as large as the distance to its neighbours. Few points far behind the scene are
    as far from each other as from the cameras, and would veil the views.
    """
    limits = np.log(size_limits(gaussians.means, scene, size_fraction)).astype(gaussians.log_scales.dtype)
    return gaussians._replace(log_scales=np.minimum(gaussians.log_scales, limits[:, None]))


def prune_large_by_distance(state: TrainState, iteration: Iteration, *, size_fraction: float) -> None:
    """Remove Gaussians larger than :func:`size_limits`."""
    limits = size_limits(state.gaussians.means, iteration.scene, size_fraction)
    apply_edit(state, clone_split.prune_large(state.gaussians, size_limit=limits))


def simplify(
    state: TrainState,
    iteration: Iteration,
    *,
    metric: ImportanceMetric,
    choose: Callable[..., Edit],
    keep_fraction: float,
    budget: int | None = None,
    min_views: int = 0,
    is_intersecting: bool = True,
    visibility_mass: float = VISIBILITY_MASS,
) -> str | None:
    """Keep at most ``budget`` Gaussians, or ``keep_fraction`` of the candidates.

    Parameters
    ----------
    state, iteration
        As for every action.
    metric : callable
        Which importance is used.
    choose : callable
        ``choose(gaussians, importance, n, rng)`` returns the edit that leaves n.
    keep_fraction : float
        Fraction of the candidates to keep when there is no budget.
    budget : int, optional
        Number of Gaussians to keep; all candidates if there are fewer.
    min_views : int
        Those that are visible in fewer views are no candidates.
    is_intersecting : bool
        If True, nor are those that dominate no pixel of any training view.
    visibility_mass : float
        Fraction of a view's blend weight that its visible Gaussians carry.
    """
    stats = measure_importance(state, iteration, visibility_mass)
    if is_culling(state):
        cull(state, stats)
    importance = candidates(stats, metric, min_views, is_intersecting=is_intersecting)
    n_candidates = int(np.count_nonzero(importance))
    n = round(keep_fraction * n_candidates) if budget is None else min(budget, n_candidates)
    apply_edit(state, choose(state.gaussians, importance, n, state.rng))
    if budget is None or budget == n:
        return None
    note = f"keeps all {n:,} Gaussians that matter, fewer than the budget of {budget:,}"
    iteration.say(f"simplification {note}")
    return note


def prune_tail(
    state: TrainState,
    iteration: Iteration,
    *,
    metric: ImportanceMetric,
    mass: float,
    min_views: int = 0,
    is_intersecting: bool = True,
    visibility_mass: float = VISIBILITY_MASS,
) -> None:
    """Keep the most important Gaussians that together carry ``mass`` of the importance.

    With ``is_intersecting`` only those count that dominate a pixel of some training view; ``min_views`` and
    ``visibility_mass`` as for :func:`simplify`.
    """
    stats = measure_importance(state, iteration, visibility_mass)
    if is_culling(state):
        cull(state, stats)
    importance = candidates(stats, metric, min_views, is_intersecting=is_intersecting)
    apply_edit(state, keep(state.gaussians, simplification.select_mass(importance, mass)))


def restart_from_means(state: TrainState, iteration: Iteration, *, sh_degree: int, largest_size: float) -> None:
    """Start again from the Gaussians' centres and colours; everything else, including the moments, is reset.

    No Gaussian begins larger than :func:`size_limits` with the fraction ``largest_size``.
    """
    gaussians = simplification.reinitialise(state.gaussians, sh_degree)
    start_again(state, iteration, limit_sizes(gaussians, iteration.scene, largest_size))


def store_sh(state: TrainState, iteration: Iteration, *, sh_degree: int) -> None:
    """Add coefficients of view-dependent colour, zero at first; the moments are reset."""
    n = n_rows(state.gaussians)
    sh_rest = np.zeros((n, (sh_degree + 1) ** 2 - 1, 3), state.gaussians.sh_rest.dtype)
    state.gaussians = state.gaussians._replace(sh_rest=sh_rest)
    restart_adam(state, iteration)


def restart_adam(state: TrainState, iteration: Iteration) -> None:
    """Reset all moments."""
    state.adam = zero_moments(state.gaussians)


KEEP_FRACTION = 0.5  # of the Gaussians that dominate a pixel
BLUR_AREA = 2e-4  # paper, equation 2: a Gaussian that dominates a larger fraction of an image is too large
# Pixels. The low-pass filter makes the smallest Gaussian some 2 pixels wide: where the paper's fraction is only a few
# pixels, as in photographs of less than a megapixel, splitting would never end.
BLURRED_AREA_MIN = 64

# Photographs do not determine the depth of sky and bare walls. The paper takes the points as they are, which leaves
# veils in the air; here points that other views see through move far behind the scene.
DEPTH_TOLERANCE = 0.05
BACKDROP_EXTENTS = 30.0

SHORT_RUN_EXPONENT = 0.45  # reinitialised Gaussians have to be learned again: compressed runs raise their rates

_densifying = partial(Every, 100, stop=15_000, skip=5_000, min_gap=DENSIFY_LEAST_GAP)

_densify = partial(clone_and_split, threshold=2e-4, size_fraction=0.01, draw_children=clone_split.random_children)
_reinitialise = partial(
    reinitialise_from_depth,
    points_of=depth_reinit.midpoint_points,
    points_per_gaussian=1.0,
    min_alpha=0.0,
    depth_tolerance=DEPTH_TOLERANCE,
    backdrop_extents=BACKDROP_EXTENTS,
    largest_size=LARGE,
)
_collecting = partial(During, stop=15_000, reads_parameters=False)
_DENSIFICATION = (
    _collecting(collect_gradients),
    _collecting(partial(collect_blur, area_fraction=BLUR_AREA, min_area=BLURRED_AREA_MIN), wants=BLEND_STATS),
    _densifying(_densify, start=500),
    _densifying(partial(prune_faint, min_opacity=0.005), start=500),
    _densifying(partial(prune_large_by_distance, size_fraction=LARGE), start=3_000),
    Every(5_000, _reinitialise, stop=15_000),
)
_AFTER_SIMPLIFICATION = (
    At(15_000, partial(store_sh, sh_degree=3)),
    At(15_000, partial(restart_from_means, sh_degree=3, largest_size=LARGE)),
)

MINI_SPLATTING = GS._replace(
    name="mini-splatting",
    learning_rates=GS.learning_rates.change(means=LogLinear(1.6e-4, 1.6e-6, 30_000, Rewind(at=15_000, to=5_000))),
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
                is_intersecting=True,
            ),
        ),
        *_AFTER_SIMPLIFICATION,
        At(20_000, partial(prune_tail, metric=importance.indoor, mass=0.99, is_intersecting=True)),
        At(20_000, restart_adam),
    ),
    min_views=3,
    short_run_exponent=SHORT_RUN_EXPONENT,
)
"""``mini-splatting``: few Gaussians."""

MINI_SPLATTING_D = MINI_SPLATTING._replace(
    name="mini-splatting-d",
    events=(*_DENSIFICATION, *_AFTER_SIMPLIFICATION),
)
"""``mini-splatting-d``: densification without simplification, for quality."""
