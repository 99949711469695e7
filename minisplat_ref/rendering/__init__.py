"""Rendering: from parameters to an image and back.

================== ==========================================================================
:mod:`.stages`     the contract of the stages: what each takes and returns
:mod:`.backends`   one function per stage: NumPy, compiled kernels, a GPU
:mod:`.splatting`  one view of activated Gaussians, stage by stage
:mod:`.renderer`   activations, :func:`render` and :func:`render_vjp`, and what a renderer is
:mod:`.wrapping`   :func:`wrap`: a renderer that changes what another one renders
================== ==========================================================================
"""

from minisplat_ref.rendering.renderer import (
    SPLATTING,
    Renderer,
    RenderGradient,
    RenderSettings,
    RenderTape,
    Request,
    activate,
    activate_vjp,
    add_light_behind,
    as_model,
    choose_degree,
    parameters_vjp,
    render,
    render_vjp,
)
from minisplat_ref.rendering.wrapping import Inputs, wrap

__all__ = [
    "SPLATTING",
    "Inputs",
    "RenderGradient",
    "RenderSettings",
    "RenderTape",
    "Renderer",
    "Request",
    "activate",
    "activate_vjp",
    "add_light_behind",
    "as_model",
    "choose_degree",
    "parameters_vjp",
    "render",
    "render_vjp",
    "wrap",
]
