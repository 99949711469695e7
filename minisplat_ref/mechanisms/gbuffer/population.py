"""Surfels with a material, their start, and their shared parameters: the environment, and the stage of training."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import SH_C0
from minisplat_ref.io.srgb import decode_srgb
from minisplat_ref.mechanisms.gbuffer.lighting import ENVIRONMENT
from minisplat_ref.mechanisms.surfels.discs import as_surfels
from minisplat_ref.types import Floats, Gaussians, Scene

STAGE = "shading_stage"  # name of a shared parameter
PER_SURFEL, PER_PIXEL, WITH_OCCLUSION = 0, 1, 2  # values of the stage
ROWS = 32  # of the environment, in latitude; it has twice as many columns
METALLIC, ROUGHNESS = 0.01, 0.1  # at the start, as released
ALBEDO_RANGE = 0.02, 0.98  # of the start: a logit has to be finite
AROUND_DEGREE = 3  # of the harmonics of the light from around, at the start and in all of training


class ReflectiveSurfels(NamedTuple):
    """Surfels that are shaded; the fields of :class:`Gaussians`, a material, and the light from around."""

    means: Floats
    """[N, 3] world frame."""
    quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    sh_dc: Floats
    """[N, 3] with ``sh_rest``: what shading per pixel takes for the light that a surfel scatters, linear RGB."""
    sh_rest: Floats
    albedo_logits: Floats
    """[N, 3] linear RGB."""
    metallic_logits: Floats
    """[N]."""
    roughness_logits: Floats
    """[N]."""
    around_dc: Floats
    """[N, 3] with ``around_rest``: the light from around, linear RGB by the direction into which it is reflected."""
    around_rest: Floats
    """[N, 3 ((L + 1)^2 - 1)] the coefficients of its degrees 1 to L, the three channels of each side by side."""


def with_materials(gaussians: Gaussians, rng: np.random.Generator) -> ReflectiveSurfels:
    """Return surfels that show the colours of the Gaussians in the first environment, which is 1 everywhere.

    So do their own colours, which are linear. From around comes no light.
    """
    surfels = as_surfels(gaussians, rng)
    colors = np.clip(0.5 + SH_C0 * surfels.sh_dc, *ALBEDO_RANGE)
    linear = decode_srgb(colors)
    n, dtype = len(colors), surfels.means.dtype
    n_rest = 3 * ((AROUND_DEGREE + 1) ** 2 - 1)
    return ReflectiveSurfels(
        **surfels._replace(sh_dc=((linear - 0.5) / SH_C0).astype(dtype))._asdict(),
        albedo_logits=np.log(linear / (1 - linear)).astype(dtype),
        metallic_logits=np.full(n, logit(METALLIC), dtype),
        roughness_logits=np.full(n, logit(ROUGHNESS), dtype),
        around_dc=np.zeros((n, 3), dtype),
        around_rest=np.zeros((n, n_rest), dtype),
    )


def first_light(scene: Scene, rng: np.random.Generator) -> Mapping[str, Floats]:
    """Return the shared parameters at the start: an environment of 1, and shading per surfel."""
    return {
        ENVIRONMENT: np.zeros((ROWS, 2 * ROWS, 3), np.float32),
        STAGE: np.full(1, PER_SURFEL, np.float32),
    }


def logit(share: float) -> float:
    """Return ``ln(s / (1 - s))``."""
    return float(np.log(share / (1 - share)))


def sigmoid(logits: Floats) -> Floats:
    """Return ``1 / (1 + exp(-x))``; its derivative is ``s (1 - s)``."""
    with np.errstate(over="ignore"):
        values: Floats = 1 / (1 + np.exp(-logits))
    return values
