"""The representation that is rendered through lenses, and its recipe."""

from minisplat_ref.extensions.lens.renderer import render, render_vjp
from minisplat_ref.mechanisms.cameras.models import are_inside
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.rendering import SPLATTING, Renderer
from minisplat_ref.training.representation import Representation

THROUGH_LENS = Representation(
    "gaussians along the rays of a lens",
    renderer=Renderer("lens", render, render_vjp, SPLATTING.channels),
    takes_optics=True,
    is_inside=are_inside,
)

LENS = GS_ACCEL._replace(name="lens")
"""The recipe ``lens``: 3DGS on photographs as they were taken."""
