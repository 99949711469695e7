"""An image by rays through its pixels, and its gradient, for all renderers that trace Gaussians of any kind.

A renderer is made of a :class:`Traced`: the preparation of a population, and its tracer.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.rays.pixel_rays import (
    BlendedRays,
    ImageTracer,
    Rays,
    blend_stats,
    pixel_rays,
    pixel_rays_vjp,
)
from minisplat_ref.rendering import SPLATTING, Renderer, RenderGradient, Request, choose_degree
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.types import Bools, Camera, Floats, Ints, Model, RenderOutput, View

WANTS = frozenset({"depth", "stats"})


class Traced(NamedTuple):
    """A kind of Gaussians that is traced."""

    name: str
    """Of the extension."""
    prepare: Callable[[Any, Floats, Backend], Any]
    """``prepare(population, opacities, backend)``: the Gaussians as rays meet them, of opacities [N] in float64, 0
    where one is not rendered."""
    tracer_for: Callable[[Any, Camera, Conventions, Backend], ImageTracer]
    """``tracer_for(prepared, camera, conventions, backend)``: the tracer of a backend; lists are made here."""
    shapes_vjp: Callable[[Any, Any, Floats, Backend], tuple[Floats, Floats]]
    """``shapes_vjp(population, prepared, v_shapes, backend)``: the gradient with respect to quaternions [N, 4] and
    logarithms of scales [N, 3]."""


def make_ray_renderer(traced: Traced) -> Renderer:
    """Return the renderer that traces a ray through the centre of each pixel."""
    return Renderer(traced.name, partial(trace_view, traced), trace_view_vjp, SPLATTING.channels)


class _Tape(NamedTuple):
    model: Model
    camera: Camera
    request: Request
    sh_degree: int | Ints
    background: Floats
    traced: Traced
    opacities: Floats  # [N]
    prepared: Any
    tracer: ImageTracer
    rays: Rays  # [H W] row by row
    colors: Floats  # [N, 3]
    blended: BlendedRays


def trace_view(traced: Traced, model: Model, view: View, request: Request) -> tuple[RenderOutput, _Tape]:
    """Trace a ray through the centre of each pixel.

    Raises
    ------
    InputError
        More is wanted than ``depth`` and ``stats``, or a degree of harmonics that is not stored.
    """
    g, camera, wants = model.gaussians, view.camera, request.wants
    if wants - WANTS:
        names = ", ".join(sorted(wants - WANTS))
        raise InputError(f"{traced.name} does not give {names}: use a recipe that does not ask for it")
    dtype, conventions, backend = g.means.dtype, request.conventions, request.backend
    degree = choose_degree(g.sh_rest, request.sh_degree)
    background = np.zeros(3) if request.background is None else np.asarray(request.background, np.float64)
    opacities = _opacities(g.opacity_logits, request.is_visible)
    prepared = traced.prepare(g, opacities, backend)
    tracer, rays = traced.tracer_for(prepared, camera, conventions, backend), pixel_rays(camera, conventions)
    colors = backend.sh_colors(g.means, g.sh_dc, g.sh_rest, camera, degree, np.ones((len(g.means), 2), np.int32))
    blended = tracer.blend(colors, rays, background, conventions)
    size = camera.height, camera.width
    channels = np.column_stack([blended.image, blended.depths]) if "depth" in wants else blended.image
    stats = blend_stats(tracer.list_hits(rays, conventions), size, len(g.means)) if "stats" in wants else None
    output = RenderOutput(
        channels.astype(dtype).reshape(*size, -1),
        (1 - blended.transmittances).astype(dtype).reshape(size),
        median_depth=None,
        stats=stats,
        visible_ids=np.flatnonzero(blended.is_seen),
        n_pairs=int(blended.n_hits.sum()),
    )
    tape = _Tape(model, camera, request, degree, background, traced, opacities, prepared, tracer, rays, colors, blended)
    return output, tape


def trace_view_vjp(tape: _Tape, v_image: Floats, v_alpha: Floats | None) -> RenderGradient:
    """Gradient of :func:`trace_view`.

    Nothing is projected, so there is no gradient with respect to a projected centre. Density control gets the closest
    substitute: a centre that moves parallel to the image by ``z / f`` moves by a pixel in it, so

        v_means2d_k = z / f_k (R v_mu)_k
    """
    g, camera, blended = tape.model.gaussians, tape.camera, tape.blended
    n_rays, dtype = len(tape.rays.near), g.means.dtype
    v_pixels = v_image.reshape(n_rays, -1).astype(np.float64)
    v_depths = v_pixels[:, 3] if v_pixels.shape[1] > 3 else np.zeros(n_rays)
    v_T = np.zeros(n_rays) if v_alpha is None else -v_alpha.ravel().astype(np.float64)
    v = tape.tracer.blend_vjp(
        tape.colors, tape.rays, tape.background, tape.request.conventions, blended, (v_pixels[:, :3], v_depths, v_T)
    )
    v_quats, v_log_scales = tape.traced.shapes_vjp(g, tape.prepared, v.shapes, tape.request.backend)
    v_R, v_t = pixel_rays_vjp(camera, tape.request.conventions, v.origins, v.directions)
    o = tape.opacities
    v_sh = tape.request.backend.sh_colors_vjp(
        g.means, g.sh_dc, g.sh_rest, camera, tape.sh_degree, _seen_radii(blended.is_seen), v.colors.astype(dtype)
    )
    R, t = camera.cam_from_world_R, camera.cam_from_world_t
    # Sums, not products of matrices: the threads of those keep a core busy for a while after it.
    depths = np.where(blended.is_seen, np.einsum("ni,i->n", g.means, R[2]) + t[2], 0.0)  # [N]
    v_in_image = np.einsum("ni,ki->nk", v.means, R[:2]) * depths[:, None] / [camera.fx, camera.fy]
    of_fields = {
        "means": v.means + v_sh.means,
        "quats": v_quats,
        "log_scales": v_log_scales,
        "opacity_logits": o * (1 - o) * v.opacities,
        "sh_dc": v_sh.sh_dc,
        "sh_rest": v_sh.sh_rest,
    }
    further = {name: np.zeros_like(field) for name, field in g._asdict().items() if name not in of_fields}
    of_fields = {name: field.astype(dtype) for name, field in of_fields.items()}
    return RenderGradient(
        gaussians=g._replace(**of_fields, **further),
        background=v.background.astype(dtype),
        cam_from_world_R=(v_R + v_sh.cam_from_world_R).astype(dtype),
        cam_from_world_t=(v_t + v_sh.cam_from_world_t).astype(dtype),
        means2d=v_in_image.astype(dtype),
    )


def _opacities(logits: Floats, is_visible: Bools | None) -> Floats:
    """Return opacities [N] in float64, 0 where a Gaussian is not rendered."""
    with np.errstate(over="ignore"):
        opacities = 1 / (1 + np.exp(-logits.astype(np.float64)))
    return opacities if is_visible is None else np.where(is_visible, opacities, 0.0)


def _seen_radii(is_seen: Bools) -> Ints:
    """Return radii [N, 2] like those of a projection: 0 for Gaussians that the stage of colours should skip."""
    return np.repeat(is_seen.astype(np.int32)[:, None], 2, axis=1)
