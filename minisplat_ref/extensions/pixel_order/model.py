"""Gaussians on tangent planes in the order of each pixel: the representation, the recipe, and the gradient check.

The renderer is that of :mod:`minisplat_ref.mechanisms.tangent`.
"""

from functools import partial

import numpy as np

from minisplat_ref.mechanisms.tangent.gradient_checks import renderer_stage
from minisplat_ref.mechanisms.tangent.renderer import render_planes, render_planes_vjp
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering import SPLATTING, Renderer
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.representation import Representation

ORDERED = Representation(
    "gaussians on tangent planes, in the order of each pixel",
    renderer=Renderer("pixel-order", partial(render_planes, buffer_size=None), render_planes_vjp, SPLATTING.channels),
)

PIXEL_ORDER = GS_ACCEL._replace(name="pixel-order")
"""The recipe ``pixel-order``: 3DGS on tangent planes; ``--set buffer_size=8`` sorts in a buffer instead of exactly."""

BUFFER = 4  # hits


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer in both orders as stages."""
    renderer = ORDERED.renderer._replace(render=partial(render_planes, buffer_size=BUFFER))
    buffered = ORDERED._replace(name=f"{ORDERED.name}, buffer of {BUFFER}", renderer=renderer)
    return (
        renderer_stage(backend, setting, ORDERED, None, rng),
        renderer_stage(backend, setting, buffered, BUFFER, rng),
    )
