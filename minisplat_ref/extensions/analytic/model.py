"""The renderer with integrals over pixels, its gradient check, and the recipe that trains with it."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.compositing import hits as kernel_hits
from minisplat_ref.extensions.analytic.boxes import visible_boxes
from minisplat_ref.extensions.analytic.kernels import response_for
from minisplat_ref.extensions.analytic.response import RESPONSE
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.oracle.models import Drawn, hit_sides, model_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.compositing import composite_hits, composite_hits_vjp
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.reference.removal import removal_changes_of_hits
from minisplat_ref.rendering import SPLATTING, Renderer, Request
from minisplat_ref.rendering.backends import REFERENCE, Backend
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import CompositeGradient, Floats, Model, Projection, RenderOutput, TileBins, TileGrid, View


def with_pixel_integrals(backend: Backend, alpha_min: float) -> Backend:
    """Return the backend with integrals over pixels instead of samples at their centres.

    Kernels look only where a Gaussian may have an alpha of ``alpha_min``. Lists of tiles are the reference's, because
    those of the kernels omit footprints that reach no pixel's centre.
    """

    def choose(by_kernels: Callable[..., Any], by_reference: Callable[..., Any]) -> Callable[..., Any]:
        return _choose_response(by_kernels, alpha_min) if backend.is_compiled else partial(by_reference, RESPONSE)

    hits_vjp = choose(kernel_hits.composite_hits_vjp, composite_hits_vjp)

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
        v = hits_vjp(projection, colors, background, bins, conventions, output, (v_image, v_alpha))
        v_means2d, v_conics, v_opacities = v.primitives
        return CompositeGradient(v_means2d, v_conics, v_opacities, v.colors, v.background)

    return replace(
        backend,
        name=f"{backend.name} with integrals",
        bin_gaussians=REFERENCE.bin_gaussians if backend.is_compiled else backend.bin_gaussians,
        composite=choose(kernel_hits.composite_hits, composite_hits),
        composite_vjp=composite_vjp,
        removal_changes=choose(kernel_hits.removal_changes_of_hits, removal_changes_of_hits),
    )


def _choose_response(function: Callable[..., Any], alpha_min: float) -> Callable[..., Any]:
    """Return a function of projection, colours and more, which takes the kernels' response in their dtype."""

    def call(projection: Projection, colors: Floats, *others: Any, **wanted: Any) -> Any:
        seen = projection._replace(boxes=visible_boxes(projection, alpha_min))
        return function(response_for(colors.dtype), seen, colors, *others, **wanted)

    return call


def render_integrals(model: Model, view: View, request: Request) -> tuple[RenderOutput, Any]:
    """Render the view as 3DGS does, but with integrals and without a low-pass; the tape keeps the backend."""
    conventions = request.conventions._replace(eps2d=0.0, is_antialiased=False)
    backend = with_pixel_integrals(request.backend, conventions.alpha_min)
    return SPLATTING.render(model, view, request._replace(backend=backend, conventions=conventions))


INTEGRATED = Representation(
    "gaussians integrated over pixels",
    renderer=Renderer("analytic", render_integrals, SPLATTING.render_vjp, SPLATTING.channels),
)


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer as a stage whose points record which integrals are blended and which are clamped.

    The reference computes these records again, so that the check notices a step across a threshold; those of the
    core's stages are about values at pixel centres.
    """
    conventions = setting.conventions._replace(eps2d=0.0)
    camera = setting.camera
    grid = TileGrid(camera.width, camera.height, REFERENCE.tile_width, REFERENCE.tile_height)

    def sides(drawn: Drawn) -> list[np.ndarray]:
        g = drawn.model.gaussians
        opacities, scales = 1 / (1 + np.exp(-g.opacity_logits)), np.exp(g.log_scales)
        projection = REFERENCE.project(g.means, g.quats, scales, opacities, drawn.view.camera, conventions)
        bins = REFERENCE.bin_gaussians(projection, grid, conventions)
        return [bins.gaussian_ids, *hit_sides(tile_hits(projection, bins, conventions, RESPONSE))]

    return (model_stage(backend, setting, INTEGRATED, rng, sides_of=sides),)


ANALYTIC = GS_ACCEL._replace(name="analytic")
"""The recipe ``analytic``: 3DGS whose alphas are means over pixels."""
