"""Rendering: from parameters to an image and back.

================== ==========================================================================
:mod:`.stages`     the contract of the stages: what each takes and returns
:mod:`.backends`   one function per stage: NumPy, compiled kernels, a GPU
:mod:`.splatting`  one view of activated Gaussians, stage by stage
:mod:`.renderer`   activations, :func:`render` and :func:`render_vjp`, and what a renderer is
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
    as_model,
    choose_degree,
    lit_from_behind,
    parameters_vjp,
    render,
    render_vjp,
)

__all__ = [
    "SPLATTING",
    "RenderGradient",
    "RenderSettings",
    "RenderTape",
    "Renderer",
    "Request",
    "activate",
    "activate_vjp",
    "as_model",
    "choose_degree",
    "lit_from_behind",
    "parameters_vjp",
    "render",
    "render_vjp",
]
