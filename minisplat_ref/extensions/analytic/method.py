"""The renderer with integrals over pixels, and the recipe that trains with it."""

from dataclasses import replace
from functools import partial
from typing import Any

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.compositing import hits as kernel_hits
from minisplat_ref.extensions.analytic.kernels import response_for
from minisplat_ref.extensions.analytic.reference import RESPONSE
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.reference.compositing import composite_hits, composite_hits_vjp
from minisplat_ref.reference.removal import removal_changes_of_hits
from minisplat_ref.rendering import SPLATTING, Renderer, Request
from minisplat_ref.rendering.backends import REFERENCE, Backend
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import CompositeGradient, Floats, Model, Projection, RenderOutput, TileBins, View


def composite(
    projection: Projection,
    colors: Floats,
    background: Floats,
    bins: TileBins,
    conventions: Conventions,
    **wanted: bool,
) -> RenderOutput:
    """Blend integrals with the plain kernels; arguments and result are those of ``reference.compositing.composite``."""
    response = response_for(colors.dtype)
    return kernel_hits.composite_hits(response, projection, colors, background, bins, conventions, **wanted)


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
    """Gradient of :func:`composite`."""
    v = kernel_hits.composite_hits_vjp(
        response_for(colors.dtype), projection, colors, background, bins, conventions, output, (v_image, v_alpha)
    )
    v_means2d, v_conics, v_opacities = v.primitives
    return CompositeGradient(v_means2d, v_conics, v_opacities, v.colors, v.background)


def reference_composite_vjp(
    projection: Projection,
    colors: Floats,
    background: Floats,
    bins: TileBins,
    conventions: Conventions,
    output: RenderOutput,
    v_image: Floats,
    v_alpha: Floats,
) -> CompositeGradient:
    """Gradient of compositing by the reference with integrals."""
    v = composite_hits_vjp(RESPONSE, projection, colors, background, bins, conventions, output, (v_image, v_alpha))
    v_means2d, v_conics, v_opacities = v.primitives
    return CompositeGradient(v_means2d, v_conics, v_opacities, v.colors, v.background)


def removal_changes(
    projection: Projection, colors: Floats, bins: TileBins, conventions: Conventions, output: RenderOutput
) -> Floats:
    """Return the squared change of the image without each Gaussian; see ``reference.removal.removal_changes``."""
    response = response_for(colors.dtype)
    return kernel_hits.removal_changes_of_hits(response, projection, colors, bins, conventions, output)


def with_pixel_integrals(backend: Backend) -> Backend:
    """Return the backend with integrals over pixels instead of samples at their centres.

    Lists of tiles are the reference's, because those of the kernels omit footprints that reach no pixel's centre.
    """
    name = f"{backend.name} with integrals"
    if backend.is_compiled:
        return replace(
            backend,
            name=name,
            bin_gaussians=REFERENCE.bin_gaussians,
            composite=composite,
            composite_vjp=composite_vjp,
            removal_changes=removal_changes,
        )
    return replace(
        backend,
        name=name,
        composite=partial(composite_hits, RESPONSE),
        composite_vjp=reference_composite_vjp,
        removal_changes=partial(removal_changes_of_hits, RESPONSE),
    )


def render(model: Model, view: View, request: Request) -> tuple[RenderOutput, Any]:
    """Render the view as 3DGS does, but with integrals and without a low-pass; the tape keeps the backend."""
    conventions = request.conventions._replace(eps2d=0.0, is_antialiased=False)
    backend = with_pixel_integrals(request.backend)
    return SPLATTING.render(model, view, request._replace(backend=backend, conventions=conventions))


INTEGRATED = Representation(
    "gaussians integrated over pixels",
    renderer=Renderer("analytic", render, SPLATTING.render_vjp, SPLATTING.channels),
)

ANALYTIC = GS_ACCEL._replace(name="analytic")
"""The recipe ``analytic``: 3DGS whose alphas are means over pixels."""
