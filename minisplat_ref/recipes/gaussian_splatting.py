"""3DGS: Kerbl et al. 2023 as released, and the same with the authors' later optimiser settings."""

from functools import partial

from minisplat_ref import events
from minisplat_ref.optim.adam import AdamRule
from minisplat_ref.optim.schedules import LearningRates, LogLinear
from minisplat_ref.recipes.schedule import At, During, Every, Recipe

# Densification needs the mean gradient over about all views, and time to settle: each event multiplies the Gaussians
# by up to two, so that events compressed to every few iterations let their number explode. What an opacity reset fades
# needs some hundred iterations to come back.
DENSIFY_LEAST_PERIOD = 100
_densifying = partial(Every, 100, stop=15_000, least_period=DENSIFY_LEAST_PERIOD)

GS = Recipe(
    name="3dgs",
    iterations=30_000,
    learning_rates=LearningRates(
        means=LogLinear(1.6e-4, 1.6e-6, 30_000),
        quats=1e-3,
        log_scales=5e-3,
        opacity_logits=5e-2,
        sh_dc=2.5e-3,
        sh_rest=2.5e-3 / 20,
    ),
    adam=AdamRule(is_visible_only=False, has_bias_correction=True),
    sh_degree=3,
    sh_milestones=(1_000, 2_000, 3_000),
    dssim_weight=0.2,
    has_random_background=False,
    events=(
        During(events.collect_gradients, stop=15_000),
        _densifying(partial(events.clone_and_split, threshold=2e-4, size_fraction=0.01), start=500),
        _densifying(partial(events.prune_faint, least_opacity=0.005), start=500),
        _densifying(partial(events.prune_large, size_fraction=0.1), start=3_000),
        Every(3_000, partial(events.reset_opacity, ceiling=0.01), stop=15_000, least_period=300),
        At(500, partial(events.reset_opacity_on_white, ceiling=0.01)),
    ),
)
"""``3dgs``."""

GS_ACCEL = GS._replace(
    name="3dgs-accel",
    learning_rates=GS.learning_rates._replace(opacity_logits=2.5e-2),
    adam=AdamRule(is_visible_only=True, has_bias_correction=False),
)
"""``3dgs-accel``."""
