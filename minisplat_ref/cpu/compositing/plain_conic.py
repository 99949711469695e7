"""3DGS with the plain kernels: stages of a backend, with the response of a projected Gaussian.

As in ``compositing``, float32 data use the polynomial exponential and float64 data libm's.
"""

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.compositing.exponential import choose_exponential
from minisplat_ref.cpu.compositing.hits import composite_hits, composite_hits_vjp
from minisplat_ref.cpu.compositing.responses import KernelResponse, conic_response
from minisplat_ref.types import CompositeGradient, Floats, Projection, RenderOutput, TileBins


def _response(dtype: np.dtype) -> KernelResponse:
    return conic_response(choose_exponential(dtype))


def composite(
    projection: Projection,
    colors: Floats,
    background: Floats,
    bins: TileBins,
    conventions: Conventions,
    *,
    with_stats: bool = False,
    with_median_depth: bool = False,
) -> RenderOutput:
    """Blend every tile's Gaussians front to back; see ``reference.compositing.composite``."""
    return composite_hits(
        _response(colors.dtype),
        projection,
        colors,
        background,
        bins,
        conventions,
        with_stats=with_stats,
        with_median_depth=with_median_depth,
    )


def composite_vjp(
    projection: Projection,
    colors: Floats,
    background: Floats,
    bins: TileBins,
    conventions: Conventions,
    output: RenderOutput,
    v_image: Floats,
    v_alpha: Floats,
) -> CompositeGradient:
    """Chain the gradient of the image to its inputs; see ``reference.compositing.composite_vjp``."""
    v = composite_hits_vjp(
        _response(colors.dtype), projection, colors, background, bins, conventions, output, (v_image, v_alpha)
    )
    v_means2d, v_conics, v_opacities = v.primitives
    return CompositeGradient(v_means2d, v_conics, v_opacities, v.colors, v.background)
