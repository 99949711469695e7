"""Mini-Splatting on tangent planes: the representation and the recipe."""

from functools import partial

from minisplat_ref.mechanisms.tangent.renderer import render, render_vjp
from minisplat_ref.methods.mini_splatting2 import MINI_SPLATTING2
from minisplat_ref.rendering import SPLATTING, Renderer
from minisplat_ref.training.representation import Representation

BUFFER = 16  # hits that a pixel sorts in its buffer

HEADSET = Representation(
    "gaussians on tangent planes, sorted in a buffer",
    renderer=Renderer("vr", partial(render, buffer_size=BUFFER), render_vjp, SPLATTING.channels),
)

VR = MINI_SPLATTING2._replace(name="vr")
"""The recipe ``vr``: Mini-Splatting2 on tangent planes; importance is that of 3DGS's footprints."""
