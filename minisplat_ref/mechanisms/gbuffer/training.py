"""Training of shaded surfels: the stages of shading, and the propagation of normals (Ref-Gaussian)."""

from functools import partial

import numpy as np

from minisplat_ref.mechanisms.gbuffer.lighting import ENVIRONMENT
from minisplat_ref.mechanisms.gbuffer.population import PER_PIXEL, STAGE, WITH_OCCLUSION, sigmoid
from minisplat_ref.mechanisms.surfels.disagreement import normal_consistency
from minisplat_ref.training.losses import LossTerm
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.schedule import At, Every
from minisplat_ref.training.state import Iteration, TrainState

NORMALS = LossTerm("normal_consistency", normal_consistency, 0.05, frozenset({"normal", "depth"}), start=7_000)
DEFERRED_FROM, OCCLUDED_FROM = 18_000, 20_000  # of 30,000; the first as published


def shade_by(state: TrainState, iteration: Iteration, *, stage: int) -> str | None:
    """Begin a stage of shading: per pixel, or per pixel and with occlusion."""
    state.shared[STAGE][:] = stage
    return None


def spread_normals(
    state: TrainState, iteration: Iteration, *, growth: float, turn: float, metallic: float, roughness: float
) -> str | None:
    """Let surfels that mirror grow over their neighbours, and disturb those that do not, so that normals spread.

    A surfel of at least ``metallic`` and at most ``roughness`` becomes ``growth`` times as large. The quaternions of
    all others are disturbed by noise of standard deviation ``turn``, and their albedo moves as far towards the mean.
    """
    g = state.gaussians
    mirrors = (sigmoid(g.metallic_logits) >= metallic) & (sigmoid(g.roughness_logits) <= roughness)
    if not mirrors.any():
        return "nothing done: no surfel mirrors"
    g.log_scales[mirrors, :2] += np.log(growth)
    others = np.flatnonzero(~mirrors)
    unit = g.quats[others] / np.linalg.norm(g.quats[others], axis=1, keepdims=True)
    g.quats[others] = unit + turn * state.rng.standard_normal(unit.shape)
    g.albedo_logits[others] += turn * (g.albedo_logits.mean(axis=0) - g.albedo_logits[others])
    return None


SHADING_RATES = Rates(
    {"albedo_logits": 0.01, "metallic_logits": 0.01, "roughness_logits": 0.01, ENVIRONMENT: 0.01, STAGE: 0.0},
    frozenset(),
)
"""Of the materials and of the shared parameters."""

SHADING_EVENTS = (
    Every(
        1_000,
        partial(spread_normals, growth=1.5, turn=0.02, metallic=0.5, roughness=0.3),
        start=2_000,
        stop=DEFERRED_FROM,
    ),
    At(DEFERRED_FROM, partial(shade_by, stage=PER_PIXEL)),
    At(OCCLUDED_FROM, partial(shade_by, stage=WITH_OCCLUSION)),
)
"""The stages: surfel by surfel up to iteration 18,000, then pixel by pixel, in the end with occlusion."""
