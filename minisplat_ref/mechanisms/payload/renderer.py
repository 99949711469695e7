"""Conics with a payload: Gaussians that are projected and listed as 3DGS does, with data that change their pixels.

The payload is a texture, a cut or vertices. An extension states in a :class:`Payload` what its footprints consist of
and what they do to a pixel. Activations, projection, colours, tile lists, the choice between kernels and reference, and
the gradient of all of them are the same, and are in this file.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.compositing import hits as kernel_hits
from minisplat_ref.cpu.compositing.responses import KernelResponse
from minisplat_ref.errors import InputError
from minisplat_ref.reference.compositing import composite_hits, composite_hits_vjp
from minisplat_ref.reference.hits import Response
from minisplat_ref.rendering import (
    SPLATTING,
    Renderer,
    RenderGradient,
    RenderTape,
    Request,
    activate,
    activate_vjp,
    choose_degree,
)
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.types import (
    Camera,
    Floats,
    Ints,
    Model,
    Primitives,
    Projection,
    ProjectionGradient,
    RenderOutput,
    TileBins,
    TileGrid,
    View,
)

MEASURES = frozenset({"stats", "median_depth"})  # what can be wanted besides channels


class Projected(NamedTuple):
    """Activated Gaussians, and their ellipses in the image of a camera."""

    gaussians: Any
    """A population that has the six fields of :class:`Gaussians`, and its own."""
    primitives: Primitives
    camera: Camera
    conventions: Conventions
    backend: Backend
    projection: Projection

    @property
    def rows(self) -> Ints:
        """[V] those that are not culled."""
        return np.flatnonzero(self.projection.radii[:, 0] > 0)

    def of(self, rows: Ints) -> Primitives:
        """Return some of the primitives."""
        return Primitives(*(field[rows] for field in self.primitives))


class PayloadGradient(NamedTuple):
    """Gradient of the loss through the payload of the footprints."""

    fields: Mapping[str, Floats]
    """With respect to fields of the population, by name; these replace the gradient of the ellipses."""
    means: Floats
    """[N, 3]; this and the following fields are added to the gradient of the ellipses."""
    quats: Floats
    """[N, 4]."""
    scales: Floats
    """[N, 3] with respect to the activated scales."""
    cam_from_world_R: Floats
    """[3, 3]."""
    cam_from_world_t: Floats
    """[3]."""


def stored_logits(gaussians: Any) -> Floats:
    """Return the logits [N] of opacity as they are stored."""
    logits: Floats = gaussians.opacity_logits
    return logits


def projection_alone(footprints: Any) -> Projection:
    """Return the projection of footprints that reach no further than their ellipses."""
    projection: Projection = footprints.projection
    return projection


def channels_alone(projected: Projected, channels: Floats) -> Floats:
    """Return the channels [N, D], for colours that are constant over a footprint."""
    return channels


def channels_alone_vjp(
    projected: Projected, v_coefficients: Floats, n_channels: int
) -> tuple[Floats, Mapping[str, Floats]]:
    """Gradient of :func:`channels_alone` with respect to channels, and to no field of the population."""
    return v_coefficients, {}


def carry_depths(footprints: Any, wants: frozenset[str]) -> Floats:
    """Return the depths of the means [N, 1] if they are wanted, else [N, 0]."""
    depths: Floats = footprints.projection.depths[:, None]
    return depths if "depth" in wants else depths[:, :0]


def carry_depths_vjp(footprints: Any, wants: frozenset[str], v_carried: Floats) -> tuple[Floats, tuple[Floats, ...]]:
    """Gradient of :func:`carry_depths` with respect to the depths [N], and to nothing else."""
    depths: Floats = footprints.projection.depths
    return np.ascontiguousarray(v_carried[:, 0]) if "depth" in wants else np.zeros_like(depths), ()


class Appearance(NamedTuple):
    """Functions from the fields of a population to opacities and colours; by default those of 3DGS."""

    opacity_logits: Callable[[Any], Floats] = stored_logits
    """Return the logits [N] of the opacities that are projected."""
    coefficients: Callable[[Projected, Floats], Floats] = channels_alone
    """Return what the response's shading takes, made of channels [N, D]: the colours, and a depth if asked for."""
    coefficients_vjp: Callable[[Projected, Floats, int], tuple[Floats, Mapping[str, Floats]]] = channels_alone_vjp
    """Return its gradient with respect to the D channels, and with respect to fields of the population."""


class Carried(NamedTuple):
    """The channels after RGB; by default the depth of the mean, where it is wanted."""

    channels: Callable[[frozenset[str]], dict[str, slice]] = SPLATTING.channels
    """Return all channels by name, as a renderer does."""
    carry: Callable[[Any, frozenset[str]], Floats] = carry_depths
    """Return those [N, K] that are the same in a whole footprint; 0 in those that the shading adds."""
    carry_vjp: Callable[[Any, frozenset[str], Floats], tuple[Floats, tuple[Floats, ...]]] = carry_depths_vjp
    """Return its gradient with respect to the projection's depths [N], and to fields of the footprints, which
    ``footprints_vjp`` gets after those of the response."""


class Payload(NamedTuple):
    """The functions in which an extension describes its Gaussians."""

    plural: str
    """Their name in messages."""
    response: Response
    """That of the reference. Its ``fields`` begin with those of a conic: means2d, conics and opacities."""
    response_for: Callable[[np.dtype], KernelResponse]
    """That of the kernels, for arrays of a dtype."""
    is_plain: Callable[[Any], bool]
    """Return whether a population has no payload, so that 3DGS renders it."""
    footprints: Callable[[Projected], Any]
    """Return what the responses take. Its field ``projection`` holds what is seen: the ellipses', or more or less."""
    footprints_vjp: Callable[[Projected, tuple[Floats, ...]], PayloadGradient]
    """Return the gradient of ``footprints`` for that of the response's fields after the conic's."""
    listed: Callable[[Any], Projection] = projection_alone
    """Return the projection by which tiles are listed: ellipses that hold all that is rendered, in their boxes."""
    appearance: Appearance = Appearance()
    carried: Carried = Carried()


class PayloadTape(NamedTuple):
    """The values that the renderer keeps for its gradient."""

    payload: Payload
    projected: Projected
    wants: frozenset[str]
    sh_degree: int | Ints  # active
    blended: tuple[Any, Floats, Floats, TileBins]  # footprints, coefficients, background, tile lists
    output: RenderOutput


def payload_renderer(name: str, payload: Payload) -> Renderer:
    """Return the renderer of Gaussians with a payload."""
    return Renderer(name, partial(render_payload, payload), render_payload_vjp, payload.carried.channels)


def render_payload(payload: Payload, model: Model, view: View, request: Request) -> tuple[RenderOutput, Any]:
    """Render the view; without a payload 3DGS renders it.

    Raises
    ------
    InputError
        Something is wanted that this renderer does not collect.
    """
    g = model.gaussians
    if payload.is_plain(g):
        return SPLATTING.render(model, view, request)
    backend, conventions, dtype, camera = request.backend, request.conventions, g.means.dtype, view.camera
    if missing := request.wants - payload.carried.channels(request.wants).keys() - MEASURES:
        raise InputError(
            f"{payload.plural} are drawn without {', '.join(sorted(missing))}: train a recipe that does without"
        )
    sh_degree = choose_degree(g.sh_rest, request.sh_degree)
    background = np.zeros(3, dtype) if request.background is None else np.asarray(request.background, dtype)

    primitives = activate(g._replace(opacity_logits=payload.appearance.opacity_logits(g)), request.is_visible)
    projection = backend.project(*primitives, camera, conventions)
    projected = Projected(g, primitives, camera, conventions, backend, projection)
    footprints = payload.footprints(projected)
    listed = payload.listed(footprints)
    rgb = backend.sh_colors(g.means, g.sh_dc, g.sh_rest, camera, sh_degree, listed.radii)  # [N, 3]
    carried = payload.carried.carry(footprints, request.wants)  # [N, K]
    channels = np.column_stack([rgb, carried.astype(dtype)])
    background = np.append(background, np.zeros(carried.shape[1], dtype))
    grid = TileGrid(camera.width, camera.height, backend.tile_width, backend.tile_height)
    bins = backend.bin_gaussians(listed, grid, conventions)
    blended = footprints, payload.appearance.coefficients(projected, channels), background, bins
    blend = (
        partial(kernel_hits.composite_hits, payload.response_for(dtype))
        if backend.is_compiled
        else partial(composite_hits, payload.response)
    )
    with_stats, with_median_depth = "stats" in request.wants, "median_depth" in request.wants
    output = blend(*blended, conventions, with_stats=with_stats, with_median_depth=with_median_depth)
    output = output._replace(visible_ids=np.flatnonzero(listed.radii[:, 0] > 0), n_pairs=len(bins.gaussian_ids))
    return output, PayloadTape(payload, projected, request.wants, sh_degree, blended, output)


def render_payload_vjp(
    tape: PayloadTape | RenderTape, v_image: Floats, v_alpha: Floats | None = None
) -> RenderGradient:
    """Gradient of :func:`render_payload`, the sum of those through the projection, the colours and the payload."""
    if isinstance(tape, RenderTape):
        return SPLATTING.render_vjp(tape, v_image, v_alpha)
    payload, projected = tape.payload, tape.projected
    g, primitives, camera, conventions, backend, _ = projected
    projection: Projection = tape.blended[0].projection
    v_alpha = np.zeros_like(tape.output.alpha) if v_alpha is None else v_alpha
    arguments = *tape.blended, conventions, tape.output, (v_image, v_alpha)
    if backend.is_compiled:
        v = kernel_hits.composite_hits_vjp(payload.response_for(g.means.dtype), *arguments)
    else:
        v = composite_hits_vjp(payload.response, *arguments)
    v_means2d, v_conics, v_opacities, *v_of_response = v.primitives
    v_channels, v_fields = payload.appearance.coefficients_vjp(projected, v.colors, v_image.shape[2])

    v_depths, v_of_carried = payload.carried.carry_vjp(tape.blended[0], tape.wants, v_channels[:, 3:])
    v_projection = ProjectionGradient(v_means2d, v_depths, v_conics, v_opacities)
    v_flat = backend.project_vjp(*primitives, camera, conventions, projection, v_projection)
    v_rgb = np.ascontiguousarray(v_channels[:, :3])
    v_sh = backend.sh_colors_vjp(g.means, g.sh_dc, g.sh_rest, camera, tape.sh_degree, projection.radii, v_rgb)
    v_more = payload.footprints_vjp(projected, (*v_of_response, *v_of_carried))
    logits, v_scales = payload.appearance.opacity_logits(g), v_flat.scales + v_more.scales
    v_log_scales, v_logits = activate_vjp(primitives, logits, v_scales, v_flat.opacities)
    of_3dgs = {
        "means": v_flat.means + v_sh.means + v_more.means,
        "quats": v_flat.quats + v_more.quats,
        "log_scales": v_log_scales,
        "opacity_logits": v_logits,
        "sh_dc": v_sh.sh_dc,
        "sh_rest": v_sh.sh_rest,
    }
    return RenderGradient(
        gaussians=g._replace(**{**of_3dgs, **v_fields, **v_more.fields}),
        background=v.background[:3],
        cam_from_world_R=v_flat.cam_from_world_R + v_sh.cam_from_world_R + v_more.cam_from_world_R,
        cam_from_world_t=v_flat.cam_from_world_t + v_sh.cam_from_world_t + v_more.cam_from_world_t,
        means2d=v_means2d,
    )
