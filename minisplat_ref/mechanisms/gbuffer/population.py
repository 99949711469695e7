"""Surfels with a material, their start, and their shared parameters: the environment, and the stage of training."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import SH_C0
from minisplat_ref.mechanisms.gbuffer.lighting import ENVIRONMENT
from minisplat_ref.mechanisms.gbuffer.tone import untone
from minisplat_ref.mechanisms.surfels.discs import as_surfels
from minisplat_ref.types import Floats, Gaussians, Scene

STAGE = "shading_stage"  # name of a shared parameter
PER_SURFEL, PER_PIXEL, WITH_OCCLUSION = 0, 1, 2  # values of the stage
ROWS = 32  # of the environment, in latitude; it has twice as many columns
METALLIC, ROUGHNESS = 0.1, 0.5  # at the start
ALBEDO_RANGE = 0.02, 0.98  # of the start: a logit has to be finite


class ReflectiveSurfels(NamedTuple):
    """Surfels that are shaded; the fields of :class:`Gaussians` and a material."""

    means: Floats
    """[N, 3] world frame."""
    quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    sh_dc: Floats
    """[N, 3] with ``sh_rest``: the light from around, linear RGB by the direction into which it is reflected."""
    sh_rest: Floats
    albedo_logits: Floats
    """[N, 3] linear RGB."""
    metallic_logits: Floats
    """[N]."""
    roughness_logits: Floats
    """[N]."""


def with_materials(gaussians: Gaussians, rng: np.random.Generator) -> ReflectiveSurfels:
    """Return surfels that show the colours of the Gaussians in the first environment, which is 1 everywhere."""
    surfels = as_surfels(gaussians, rng)
    colors = np.clip(0.5 + SH_C0 * surfels.sh_dc, *ALBEDO_RANGE)
    linear = untone(colors)
    n, dtype = len(colors), surfels.means.dtype
    return ReflectiveSurfels(
        **surfels._asdict(),
        albedo_logits=np.log(linear / (1 - linear)).astype(dtype),
        metallic_logits=np.full(n, np.log(METALLIC / (1 - METALLIC)), dtype),
        roughness_logits=np.full(n, np.log(ROUGHNESS / (1 - ROUGHNESS)), dtype),
    )


def first_light(scene: Scene, rng: np.random.Generator) -> Mapping[str, Floats]:
    """Return the shared parameters at the start: an environment of 1, and shading per surfel."""
    return {
        ENVIRONMENT: np.zeros((ROWS, 2 * ROWS, 3), np.float32),
        STAGE: np.full(1, PER_SURFEL, np.float32),
    }


def sigmoid(logits: Floats) -> Floats:
    """Return ``1 / (1 + exp(-x))``; its derivative is ``s (1 - s)``."""
    with np.errstate(over="ignore"):
        values: Floats = 1 / (1 + np.exp(-logits))
    return values
