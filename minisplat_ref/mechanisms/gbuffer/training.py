"""Training of shaded surfels by Ref-Gaussian's released settings: stages, propagation of normals, density control."""

from functools import partial

import numpy as np

from minisplat_ref.mechanisms.gbuffer.lighting import ENVIRONMENT
from minisplat_ref.mechanisms.gbuffer.population import (
    METALLIC,
    PER_PIXEL,
    ROUGHNESS,
    STAGE,
    WITH_OCCLUSION,
    logit,
    sigmoid,
)
from minisplat_ref.mechanisms.surfels.disagreement import normal_consistency
from minisplat_ref.mechanisms.surfels.discs import OPACITY_MIN
from minisplat_ref.methods.gaussian_splatting import (
    DENSIFY_LEAST_GAP,
    clone_and_split,
    collect_gradients,
    lower_opacities,
    prune_faint,
    prune_large,
    reset_opacity,
    reset_opacity_on_white,
)
from minisplat_ref.training.losses import LossTerm
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.schedule import At, During, Every
from minisplat_ref.training.state import Iteration, TrainState

NORMALS = LossTerm("normal_consistency", normal_consistency, 0.05, frozenset({"normal", "depth"}))
ITERATIONS = 50_000
DEFERRED_FROM, OCCLUDED_FROM, GROWS_UNTIL = 18_000, 20_000, 25_000


def shade_by(state: TrainState, iteration: Iteration, *, stage: int) -> str | None:
    """Begin a stage of shading: per pixel, or per pixel and with occlusion."""
    state.shared[STAGE][:] = stage
    return None


def restart_materials(state: TrainState, iteration: Iteration) -> None:
    """Give all surfels an albedo of one half and the first metallic share and roughness, and the light its start.

    What they learned while surfels were shaded one by one is that of wrong normals; shading per pixel begins afresh.
    """
    g = state.gaussians
    start = {"albedo_logits": 0.0, "metallic_logits": logit(METALLIC), "roughness_logits": logit(ROUGHNESS)}
    for name, value in start.items():
        getattr(g, name)[:] = value
    state.shared[ENVIRONMENT][:] = 0
    for moments, of_shared in (
        (state.adam.first, state.shared_adam.first),
        (state.adam.second, state.shared_adam.second),
    ):
        for name in start:
            getattr(moments, name)[:] = 0
        of_shared[ENVIRONMENT][:] = 0


def spread_normals(
    state: TrainState,
    iteration: Iteration,
    *,
    growth: float,
    metallic: float,
    roughness: float,
    opacity: float,
    disturbance: float,
) -> str | None:
    """Let surfels that mirror grow over their neighbours, so that their normals spread.

    All opacities become at least ``opacity``. A surfel of at least ``metallic`` and at most ``roughness`` becomes
    ``growth`` times as large. Once pixels are shaded, the own colours of those of at most ``metallic`` are disturbed,
    by up to ``disturbance`` in their first coefficient.
    """
    g = state.gaussians
    lower_opacities(state, np.maximum(g.opacity_logits, g.opacity_logits.dtype.type(logit(opacity))))
    g, share = state.gaussians, sigmoid(state.gaussians.metallic_logits)
    mirrors = (share >= metallic) & (sigmoid(g.roughness_logits) <= roughness)
    g.log_scales[mirrors, :2] += np.log(growth)
    if state.shared[STAGE][0] >= PER_PIXEL:
        others = share <= metallic
        g.sh_dc[others] += state.rng.uniform(-disturbance, disturbance, size=(int(others.sum()), 3))
    return None if mirrors.any() else "opacities raised: no surfel mirrors"


SHADING_RATES = Rates(
    {
        "albedo_logits": 0.0075,
        "metallic_logits": 0.005,
        "roughness_logits": 0.005,
        "around_dc": 0.0075,
        "around_rest": 0.0075 / 20,
        ENVIRONMENT: 0.01,
        STAGE: 0.0,
    },
    frozenset(),
)
"""Of the materials, the light from around, and the shared parameters."""

OWN_RATES = {"opacity_logits": 0.05, "sh_dc": 0.0075, "sh_rest": 0.0075 / 20}
"""Of what 3DGS has as well, at other rates."""

SH_MILESTONES = (6_000, 7_000, 8_000)

_densifying = partial(Every, 500, stop=GROWS_UNTIL, min_gap=DENSIFY_LEAST_GAP)

SHADING_EVENTS = (
    During(collect_gradients, stop=GROWS_UNTIL, reads_parameters=False),
    _densifying(partial(clone_and_split, threshold=2e-4, size_fraction=0.01), start=500, skip=DEFERRED_FROM),
    _densifying(partial(prune_faint, min_opacity=OPACITY_MIN), start=500, skip=DEFERRED_FROM),
    _densifying(partial(prune_large, size_fraction=0.1), start=3_000, skip=DEFERRED_FROM),
    Every(3_000, partial(reset_opacity, ceiling=0.01), stop=GROWS_UNTIL, min_gap=300, skip=DEFERRED_FROM),
    At(500, partial(reset_opacity_on_white, ceiling=0.01)),
    Every(
        1_000,
        partial(spread_normals, growth=1.5, metallic=0.02, roughness=0.01, opacity=0.9, disturbance=0.4),
        stop=GROWS_UNTIL,
        skip=3_000,
        min_gap=DENSIFY_LEAST_GAP,
    ),
    At(DEFERRED_FROM, restart_materials),
    At(DEFERRED_FROM, partial(shade_by, stage=PER_PIXEL)),
    At(OCCLUDED_FROM, partial(shade_by, stage=WITH_OCCLUSION)),
)
"""The density control, the propagation of normals, and the stages of shading."""
