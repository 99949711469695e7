"""The population of textured Gaussians."""

from typing import NamedTuple

import numpy as np

from minisplat_ref.types import Floats, Gaussians

DEGREE = 3  # of textures, as in the paper


class TexturedGaussians(NamedTuple):
    """Gaussians with textures; the other fields are those of :class:`Gaussians`."""

    means: Floats
    quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    """[N] coefficient l of degree 0 of the opacity's logit."""
    sh_dc: Floats
    sh_rest: Floats
    color_textures: Floats
    """[N, 3 (K-1)] coefficients k_k of degree 1 and above over the ellipsoid, those of red first."""
    opacity_textures: Floats
    """[N, K-1] coefficients h_k of degree 1 and above of the logit."""


def with_textures(gaussians: Gaussians, degree: int) -> TexturedGaussians:
    """Return Gaussians with textures of zeros up to a degree; with degree 0 they have none, and are those of 3DGS."""
    n, dtype, k = len(gaussians.means), gaussians.means.dtype, (degree + 1) ** 2 - 1
    return TexturedGaussians(
        **{name: getattr(gaussians, name) for name in Gaussians._fields},
        color_textures=np.zeros((n, 3 * k), dtype),
        opacity_textures=np.zeros((n, k), dtype),
    )


def blank(gaussians: Gaussians, rng: np.random.Generator) -> TexturedGaussians:
    """Return Gaussians with textures of zeros, of degree ``DEGREE``."""
    return with_textures(gaussians, DEGREE)
