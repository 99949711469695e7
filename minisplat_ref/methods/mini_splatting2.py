"""Mini-Splatting2 (Fang and Wang 2024): dense after 3000 iterations, then simplified, so most iterations train few."""

import math
from collections.abc import Callable
from functools import partial

from minisplat_ref.methods.gaussian_splatting import (
    DENSIFY_LEAST_GAP,
    GS,
    clone_and_split,
    collect_gradients,
    prune_faint,
)
from minisplat_ref.methods.mini_splatting import (
    BACKDROP_EXTENTS,
    BLUR_AREA,
    BLURRED_AREA_MIN,
    DEPTH_TOLERANCE,
    LARGE,
    SHORT_RUN_EXPONENT,
    VISIBILITY_MASS,
    collect_blur,
    cull,
    measure_importance,
    prune_tail,
    reinitialise_from_depth,
    simplify,
    store_sh,
)
from minisplat_ref.strategy import aggressive_clone as cloning
from minisplat_ref.strategy import clone_split, depth_reinit, importance, visibility
from minisplat_ref.strategy import simplify as simplification
from minisplat_ref.strategy.importance import ImportanceStats, indoor, mass_mask
from minisplat_ref.strategy.ops import keep, n_rows, take
from minisplat_ref.training.adam import AdamRule
from minisplat_ref.training.schedule import BLEND_STATS, At, During, Every, SmallerViews
from minisplat_ref.training.smaller_views import halve_large_views
from minisplat_ref.training.state import Iteration, TrainState, apply_edit, n_pixels
from minisplat_ref.types import Bools

HALF_SIDE_MIN = 100  # pixels; a photograph smaller than this has lost most of its details
COLLECTED = ("gradient_sum", "view_count", "is_blurred")


def aggressive_clone(
    state: TrainState,
    iteration: Iteration,
    *,
    critical: Callable[[ImportanceStats], Bools],
    factor: int,
    tail_mass: float,
    min_views: int,
    visibility_mass: float = VISIBILITY_MASS,
    max_per_pixel: float = math.inf,
) -> None:
    """Drop Gaussians that hardly any view sees, clone the critical ones, and cull views from now on.

    Parameters
    ----------
    state, iteration
        As for every action.
    critical : callable
        Which Gaussians [N] are critical, given the views' statistics.
    factor : int
        Copies that a critical Gaussian becomes.
    tail_mass : float
        Only the most important Gaussians that carry this fraction of the importance stay.
    min_views : int
        Those that are visible in fewer views are dropped.
    visibility_mass : float
        Fraction of a view's blend weight that its visible Gaussians carry.
    max_per_pixel : float
        Nothing is cloned while there are this many Gaussians or more for each pixel of the training views.
    """
    stats = measure_importance(state, iteration, visibility_mass)
    stays = mass_mask(indoor(stats), tail_mass) & ~visibility.find_seen_by_few(stats.is_visible, min_views)  # [N]
    apply_edit(state, keep(state.gaussians, stays))
    stats = take(stats, stays)
    cull(state, stats)
    if n_rows(state.gaussians) < max_per_pixel * n_pixels(iteration.scene):
        apply_edit(state, cloning.clone(state.gaussians, critical(stats), factor=factor))
    for name in COLLECTED:
        state.stats.pop(name, None)


def stop_culling(state: TrainState, iteration: Iteration) -> None:
    """Train each view with all Gaussians again."""
    for name in ("is_visible", "gradient_factor"):
        state.stats.pop(name, None)


KEEP_FRACTION = 0.6  # of the Gaussians that dominate a pixel
PER_PIXEL_MAX = 0.1
_VIEWS_MIN = 2  # seen by only one view, a Gaussian is as likely a floater as a surface
_cloning = partial(
    aggressive_clone,
    critical=cloning.critical_by_mass,
    factor=2,
    tail_mass=0.999,
    min_views=_VIEWS_MIN,
    visibility_mass=VISIBILITY_MASS,
    max_per_pixel=PER_PIXEL_MAX,
)
_densify = partial(
    clone_and_split,
    threshold=2e-4,
    size_fraction=0.01,
    draw_children=clone_split.random_children,
    max_per_pixel=PER_PIXEL_MAX,
)
_reinitialise = partial(
    reinitialise_from_depth,
    points_of=depth_reinit.midpoint_points,
    points_per_gaussian=1.0,
    drawn_mass=0.99,
    min_alpha=0.0,
    depth_tolerance=DEPTH_TOLERANCE,
    backdrop_extents=BACKDROP_EXTENTS,
    largest_size=LARGE,
)
_densifying = partial(Every, 100, start=500, stop=3_000, skip=2_000, min_gap=DENSIFY_LEAST_GAP)
_collecting = partial(During, stop=3_000, reads_parameters=False)

_DENSIFICATION = (
    SmallerViews(partial(halve_large_views, min_side=HALF_SIDE_MIN, max_halvings=1), until=3_000),
    _collecting(collect_gradients),
    _collecting(partial(collect_blur, area_fraction=BLUR_AREA, min_area=BLURRED_AREA_MIN), wants=BLEND_STATS),
    _densifying(_densify),
    _densifying(partial(prune_faint, min_opacity=0.005)),
    At(2_000, _reinitialise),
    Every(250, _cloning, start=499, stop=3_000, skip=2_000),
)

MINI_SPLATTING2 = GS._replace(
    name="mini-splatting2",
    iterations=18_000,
    learning_rates=GS.learning_rates.change(opacity_logits=2.5e-2),
    adam=AdamRule(is_visible_only=True, has_bias_correction=True),
    sh_degree=0,
    sh_milestones=(4_000, 5_000, 6_000),
    events=(
        *_DENSIFICATION,
        At(
            3_000,
            partial(
                simplify,
                metric=importance.indoor,
                choose=simplification.by_sampling,
                keep_fraction=KEEP_FRACTION,
                budget=None,
                min_views=_VIEWS_MIN,
                is_intersecting=True,
                visibility_mass=VISIBILITY_MASS,
            ),
        ),
        At(3_000, partial(store_sh, sh_degree=3)),
        At(
            8_000,
            partial(prune_tail, metric=importance.indoor, mass=0.99, min_views=_VIEWS_MIN, is_intersecting=True),
        ),
        At(13_000, stop_culling),
    ),
    min_views=3,
    short_run_exponent=SHORT_RUN_EXPONENT,
)
"""``mini-splatting2``: few Gaussians, fast."""

_prune_unimportant = partial(
    prune_tail,
    metric=importance.indoor,
    mass=0.99,
    min_views=_VIEWS_MIN,
    is_intersecting=False,
    visibility_mass=VISIBILITY_MASS,
)
MINI_SPLATTING2_D = MINI_SPLATTING2._replace(
    name="mini-splatting2-d",
    events=(
        *_DENSIFICATION,
        At(3_000, _prune_unimportant),
        At(3_000, partial(store_sh, sh_degree=3)),
        At(8_000, _prune_unimportant),
        At(13_000, stop_culling),
    ),
)
"""``mini-splatting2-d``: dense within minutes, for quality."""
