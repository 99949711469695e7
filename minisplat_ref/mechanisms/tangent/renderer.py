"""A renderer of footprints on tangent planes, in which each pixel has its own order, and its gradient."""

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import EXACT_ORDER, Conventions
from minisplat_ref.cpu.compositing import hits as kernel_hits
from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms import orders
from minisplat_ref.mechanisms.tangent.kernels import response_for
from minisplat_ref.mechanisms.tangent.planes import (
    FootprintGradient,
    TangentFootprints,
    hit,
    hit_vjp,
    project,
    project_vjp,
)
from minisplat_ref.reference.hits import Response
from minisplat_ref.rendering import RenderGradient, Request, activate, add_light_behind, choose_degree, parameters_vjp
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.rendering.box_lists import list_boxes
from minisplat_ref.rendering.splatting import append_depths
from minisplat_ref.types import (
    Camera,
    Floats,
    Ints,
    Model,
    Primitives,
    RenderOutput,
    TileBins,
    View,
)

BUFFER_MAX = 1024  # hits; for more, use None
OF_STATS = frozenset({"stats", "surface", "dominant_depth"})
"""The outputs that need blend statistics."""

RESPONSE = Response(lambda footprints: footprints.boxes, hit, hit_vjp, ("normals", "conics", "opacities"))
"""The response of the reference."""


class Prepared(NamedTuple):
    """A view of Gaussians after projection and shading."""

    gaussians: Any
    sh_degree: int | Ints  # active
    primitives: Primitives
    view_camera: Camera
    footprints: TangentFootprints
    channels: Floats  # [N, D] colours, then the depth on request
    background: Floats  # [D]
    has_depth: bool
    conventions: Conventions
    backend: Backend
    buffer_size: int

    def listed(self) -> TileBins:
        """Return the tiles' lists, nearest means first."""
        f = self.footprints
        return list_boxes(f.distances, f.radii, f.boxes, f.camera, self.conventions, self.backend)

    def blended(self, bins: TileBins, wants: frozenset[str] = frozenset()) -> RenderOutput:
        """Return the image, rendered by kernels or by the reference, and the requested statistics."""
        inputs = self.footprints, self.channels, self.background, bins, self.conventions
        blend = (
            partial(kernel_hits.composite_hits, response_for(self.channels.dtype, self.buffer_size))
            if self.backend.is_compiled
            else partial(orders.composite_hits, orders.Sorted(RESPONSE, self.buffer_size))
        )
        return blend(*inputs, with_stats=bool(wants & OF_STATS), with_median_depth="median_depth" in wants)

    def removal_changes(self, bins: TileBins, output: RenderOutput) -> Floats:
        """Return the squared change of the colours [N] without each Gaussian."""
        assert not self.has_depth, "a channel of depths has another unit"
        inputs = self.footprints, self.channels, bins, self.conventions, output
        if self.backend.is_compiled:
            response = response_for(self.channels.dtype, self.buffer_size)
            return kernel_hits.removal_changes_of_hits(response, *inputs)
        return orders.removal_changes_of_hits(orders.Sorted(RESPONSE, self.buffer_size), *inputs)


class Tape(NamedTuple):
    """The values that :func:`render_planes` keeps for :func:`render_planes_vjp`."""

    prepared: Prepared
    bins: TileBins
    output: RenderOutput


def prepare(model: Model, camera: Camera, request: Request, buffer_size: int | None) -> Prepared:
    """Project and shade the Gaussians of a model.

    Raises
    ------
    InputError
        The size of the buffer is out of range, or the conventions require compensated opacities.
    """
    g, backend = model.gaussians, request.backend
    size = check_buffer_size(buffer_size)
    dtype = g.means.dtype
    sh_degree = choose_degree(g.sh_rest, request.sh_degree)
    background = np.zeros(3, dtype) if request.background is None else np.asarray(request.background, dtype)
    primitives = activate(g, request.is_visible)
    footprints = project(primitives, camera, request.conventions)
    channels = backend.sh_colors(g.means, g.sh_dc, g.sh_rest, camera, sh_degree, footprints.radii)
    has_depth = "depth" in request.wants
    if has_depth:
        channels, background = append_depths(channels, background, footprints.depths)
    return Prepared(
        g,
        sh_degree,
        primitives,
        camera,
        footprints,
        channels,
        background,
        has_depth,
        request.conventions,
        backend,
        size,
    )


def check_buffer_size(buffer_size: int | None) -> int:
    """Return the number of hits that a pixel sorts in its buffer; None for all.

    Raises
    ------
    InputError
        It is not an integer from 1 to ``BUFFER_MAX``.
    """
    if buffer_size is None:
        return EXACT_ORDER
    if buffer_size != int(buffer_size) or not 1 <= buffer_size <= BUFFER_MAX:
        raise InputError(
            f"buffer_size is {buffer_size}: give 1 to {BUFFER_MAX} hits, 1 for the order of the list, or none for the"
            " exact order"
        )
    return int(buffer_size)


def render_planes(
    model: Model, view: View, request: Request, *, buffer_size: int | None = None
) -> tuple[RenderOutput, Tape]:
    """Render a view; return the image and a tape.

    Statistics of blending and of removal are those of the pixels' own order; a median depth is where on the ray the
    Gaussian is densest, and so is a point of ``surface``, that of the dominant Gaussian.

    Parameters
    ----------
    model : Model
        A population that has the six fields of :class:`Gaussians`.
    view : View
        Its camera is used.
    request : Request
        What is wanted, and by which backend.
    buffer_size : int, optional
        Hits that a pixel sorts in its buffer; all by default.
    """
    prepared = prepare(model, view.camera, request, buffer_size)
    bins = prepared.listed()
    blended = prepared.blended(bins, request.wants)
    visible_ids = np.flatnonzero(prepared.footprints.radii[:, 0] > 0)
    extras = _extras(prepared, bins, blended, request)
    output = blended._replace(visible_ids=visible_ids, n_pairs=len(bins.gaussian_ids), extras=extras)
    return output, Tape(prepared, bins, blended)


def _extras(p: Prepared, bins: TileBins, output: RenderOutput, request: Request) -> dict[str, Any]:
    """Return the outputs that the request names besides channels and statistics."""
    extras: dict[str, Any] = {}
    if output.stats is not None:
        dominant_ids = output.stats.dominant_ids
        if "surface" in request.wants:
            means, quats, scales, _ = p.primitives
            extras["surface"] = p.backend.surface_points(means, quats, scales, p.footprints.camera, dominant_ids)
        if "dominant_depth" in request.wants:
            extras["dominant_depth"] = np.append(p.footprints.depths, 0)[dominant_ids].astype(p.channels.dtype)
    if "removal_changes" in request.wants:
        extras["removal_changes"] = p.removal_changes(bins, add_light_behind(output, request))
    return extras


def render_planes_vjp(tape: Tape, v_image: Floats, v_alpha: Floats | None = None) -> RenderGradient:
    """Gradient of :func:`render_planes`, by the chain rule.

    The means and the pose are used twice, by the projection and by the viewing direction, so two gradients are summed.
    """
    p, bins, output = tape
    g, footprints, camera = p.gaussians, p.footprints, p.view_camera
    v_output = v_image, np.zeros_like(output.alpha) if v_alpha is None else v_alpha
    inputs = footprints, p.channels, p.background, bins, p.conventions, output, v_output
    if p.backend.is_compiled:
        v = kernel_hits.composite_hits_vjp(response_for(p.channels.dtype, p.buffer_size), *inputs)
    else:
        v = orders.composite_hits_vjp(orders.Sorted(RESPONSE, p.buffer_size), *inputs)
    v_colors, v_background, v_depths = v.colors, v.background, np.zeros(len(v.colors))
    if p.has_depth:
        v_colors, v_depths = np.ascontiguousarray(v.colors[:, :-1]), v.colors[:, -1].astype(np.float64)
        v_background = v.background[:-1]
    v_normals, v_conics, v_opacities = v.primitives
    v_footprints = FootprintGradient(v_normals, v_conics, v_opacities, v_depths)
    v_primitives, v_means2d = project_vjp(p.primitives, camera, p.conventions, footprints, v_footprints)
    v_sh = p.backend.sh_colors_vjp(g.means, g.sh_dc, g.sh_rest, camera, p.sh_degree, footprints.radii, v_colors)
    return RenderGradient(
        gaussians=parameters_vjp(g, p.primitives, v_primitives, v_sh),
        background=v_background,
        cam_from_world_R=v_primitives.cam_from_world_R + v_sh.cam_from_world_R,
        cam_from_world_t=v_primitives.cam_from_world_t + v_sh.cam_from_world_t,
        means2d=v_means2d,
    )
