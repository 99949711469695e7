"""Mini-Splatting (Fang and Wang 2024): densify by blur split and depth, then keep few Gaussians, chosen by importance.

As released, without opacity resets. The released code counts in Gaussians for photographs of a megapixel; here a scene
is measured in the pixels of its training views, of which 3.5 million points are about one in seventy.
"""

from functools import partial

from minisplat_ref import events
from minisplat_ref.optim.schedules import LogLinear, Rewind
from minisplat_ref.recipes.gaussian_splatting import DENSIFY_LEAST_PERIOD, GS
from minisplat_ref.recipes.schedule import At, During, Every
from minisplat_ref.strategy import blur_split, depth_reinit, importance, simplify

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
    events.clone_and_split,
    threshold=2e-4,
    size_fraction=0.01,
    draw_children=blur_split.principal_axis_children,
    most_per_pixel=MOST_PER_PIXEL,
)
_reinitialise = partial(
    events.reinitialise_from_depth,
    points_of=depth_reinit.midpoint_points,
    points_per_pixel=POINTS_PER_PIXEL,
    least_alpha=0.0,
    depth_tolerance=DEPTH_TOLERANCE,
    backdrop_extents=BACKDROP_EXTENTS,
)
_DENSIFICATION = (
    During(events.collect_gradients, stop=15_000),
    During(partial(events.collect_blur, area_fraction=BLUR_AREA), stop=15_000, needs_blend_stats=True),
    _densifying(_densify, start=500),
    _densifying(partial(events.prune_faint, least_opacity=0.005), start=500),
    _densifying(partial(events.prune_large, size_fraction=0.1), start=3_000),
    Every(5_000, _reinitialise, stop=15_000, least_step=REINITIALISE_LEAST_STEP),
)
_AFTER_SIMPLIFICATION = (
    At(15_000, partial(events.store_sh, sh_degree=3)),
    At(15_000, partial(events.restart_from_means, sh_degree=3), least_step=RESTART_LEAST_STEP),
)

MINI_SPLATTING = GS._replace(
    name="mini-splatting",
    learning_rates=GS.learning_rates._replace(means=LogLinear(1.6e-4, 1.6e-6, 30_000, Rewind(at=15_000, to=5_000))),
    sh_degree=0,
    sh_milestones=(16_000, 17_000, 18_000),
    events=(
        *_DENSIFICATION,
        At(
            15_000,
            partial(
                events.simplify,
                metric=importance.indoor,
                choose=simplify.by_sampling,
                keep_fraction=KEEP_FRACTION,
                budget=None,
            ),
        ),
        *_AFTER_SIMPLIFICATION,
        At(20_000, partial(events.prune_tail, metric=importance.indoor, mass=0.99)),
        At(20_000, events.restart_adam),
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
