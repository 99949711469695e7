"""Mini-Splatting2 (Fang and Wang 2024): dense in 3000 iterations, then simplified, so that most train few Gaussians."""

from functools import partial

from minisplat_ref import events
from minisplat_ref.optim.adam import AdamRule
from minisplat_ref.recipes.gaussian_splatting import DENSIFY_LEAST_PERIOD, GS
from minisplat_ref.recipes.mini_splatting import (
    BACKDROP_EXTENTS,
    BLUR_AREA,
    DEPTH_TOLERANCE,
    KEEP_FRACTION,
    REINITIALISE_LEAST_STEP,
    SHORT_RUN_EXPONENT,
)
from minisplat_ref.recipes.schedule import At, During, Every
from minisplat_ref.strategy import aggressive_clone, blur_split, depth_reinit, importance, simplify

MOST_PER_PIXEL = 0.025  # densification pauses above it; cloning may go beyond once, to twice as many
CLONE_LEAST_PERIOD = 50  # copies start in one place and need some steps to part
_LEAST_VIEWS = 2  # what only one view sees is as likely a floater as a surface
_cloning = partial(
    events.aggressive_clone,
    critical=aggressive_clone.critical_by_mass,
    factor=2,
    tail_mass=0.999,
    least_views=_LEAST_VIEWS,
    most_per_pixel=MOST_PER_PIXEL,
)
_densify = partial(
    events.clone_and_split,
    threshold=2e-4,
    size_fraction=0.01,
    draw_children=blur_split.principal_axis_children,
    most_per_pixel=MOST_PER_PIXEL,
)
_reinitialise = partial(
    events.reinitialise_from_depth,
    points_of=depth_reinit.midpoint_points,
    points_per_gaussian=1.0,
    least_alpha=0.0,
    depth_tolerance=DEPTH_TOLERANCE,
    backdrop_extents=BACKDROP_EXTENTS,
)
_densifying = partial(Every, 100, start=500, stop=3_000, skip=2_000, least_period=DENSIFY_LEAST_PERIOD)

_DENSIFICATION = (
    During(events.collect_gradients, stop=3_000),
    During(partial(events.collect_blur, area_fraction=BLUR_AREA), stop=3_000, needs_blend_stats=True),
    _densifying(_densify),
    _densifying(partial(events.prune_faint, least_opacity=0.005)),
    At(2_000, partial(events.prune_tail, metric=importance.indoor, mass=0.99)),
    At(2_000, _reinitialise, least_step=REINITIALISE_LEAST_STEP),
    Every(250, _cloning, start=499, stop=3_000, skip=2_000, least_period=CLONE_LEAST_PERIOD),
)

MINI_SPLATTING2 = GS._replace(
    name="mini-splatting2",
    iterations=18_000,
    learning_rates=GS.learning_rates._replace(opacity_logits=2.5e-2),
    adam=AdamRule(is_visible_only=True, has_bias_correction=True),
    sh_degree=0,
    sh_milestones=(4_000, 5_000, 6_000),
    events=(
        *_DENSIFICATION,
        At(
            3_000,
            partial(
                events.simplify,
                metric=importance.indoor,
                choose=simplify.by_sampling,
                keep_fraction=KEEP_FRACTION,
                budget=None,
                least_views=_LEAST_VIEWS,
            ),
        ),
        At(3_000, partial(events.store_sh, sh_degree=3)),
        At(
            8_000,
            partial(events.prune_tail, metric=importance.indoor, mass=0.99, least_views=_LEAST_VIEWS),
        ),
        At(13_000, events.stop_culling),
    ),
    half_size_until=3_000,
    least_views=3,
    short_run_exponent=SHORT_RUN_EXPONENT,
)
"""``mini-splatting2``: few Gaussians, fast."""

_prune_unimportant = partial(
    events.prune_tail, metric=importance.indoor, mass=0.99, least_views=_LEAST_VIEWS, is_intersecting=False
)
MINI_SPLATTING2_D = MINI_SPLATTING2._replace(
    name="mini-splatting2-d",
    events=(
        *_DENSIFICATION,
        At(3_000, _prune_unimportant),
        At(3_000, partial(events.store_sh, sh_degree=3)),
        At(8_000, _prune_unimportant),
        At(13_000, events.stop_culling),
    ),
)
"""``mini-splatting2-d``: dense within minutes, for quality."""
