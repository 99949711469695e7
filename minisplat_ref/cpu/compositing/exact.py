"""Blending with libm's exponential in both precisions, the baseline for the polynomial."""

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.compositing import composite_vjp_with, composite_with
from minisplat_ref.cpu.compositing.exponential import exp_exact
from minisplat_ref.types import CompositeGradient, Floats, Projection, RenderOutput, TileBins


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
    return composite_with(exp_exact, projection, colors, background, bins, conventions, with_stats, with_median_depth)


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
    return composite_vjp_with(exp_exact, projection, colors, bins, conventions, output, v_image, v_alpha)
