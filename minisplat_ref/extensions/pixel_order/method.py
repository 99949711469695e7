"""The representation drawn on tangent planes in the order of each pixel, and the recipe that trains it."""

from functools import partial

from minisplat_ref.mechanisms.tangent.renderer import render_planes, render_planes_vjp
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.rendering import SPLATTING, Renderer
from minisplat_ref.training.representation import Representation

ORDERED = Representation(
    "gaussians on tangent planes, in the order of each pixel",
    renderer=Renderer("pixel-order", partial(render_planes, buffer_size=None), render_planes_vjp, SPLATTING.channels),
)

PIXEL_ORDER = GS_ACCEL._replace(name="pixel-order")
"""The recipe ``pixel-order``: 3DGS on tangent planes; ``--set buffer_size=8`` sorts in a buffer instead of exactly."""
