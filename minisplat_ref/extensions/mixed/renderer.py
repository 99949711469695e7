"""Rendering of ellipses, lines and triangles: their colours alone, or with depths, normals and spreads.

Colours alone are those of :mod:`.response`, and with one vertex each 3DGS renders them. With further channels the
colours are the same, and depths and normals come from the planes of :mod:`.planes`, by :mod:`.surfaces`. The channels
are those of surfels, so that the losses of :mod:`minisplat_ref.mechanisms.surfels.losses` and meshes take them as they
are: ``depth``, ``sum w z`` with the depths at the pixels; ``normal``, ``sum w n``; ``spread``, ``sum w q`` and
``sum w q^2`` of inverse depths. Left out is the channel ``median``: the median depth has no gradient here.
"""

import functools
from typing import Any

import numpy as np

from minisplat_ref.extensions.mixed.kernels import response_for, surface_response_for
from minisplat_ref.extensions.mixed.planes import Planes, planes_of, planes_vjp
from minisplat_ref.extensions.mixed.population import MixedGaussians, counts
from minisplat_ref.extensions.mixed.projection import Hulls, footprints_of, footprints_vjp
from minisplat_ref.extensions.mixed.response import RESPONSE, HullFootprints
from minisplat_ref.extensions.mixed.surfaces import SurfaceFootprints, surface_response
from minisplat_ref.mechanisms.payload.renderer import (
    Carried,
    Payload,
    PayloadGradient,
    Projected,
    render_payload,
    render_payload_vjp,
)
from minisplat_ref.mechanisms.surfels import renderer as discs
from minisplat_ref.mechanisms.surfels.projection import choose_pivot
from minisplat_ref.mechanisms.surfels.response import Layout
from minisplat_ref.rendering import Renderer, Request
from minisplat_ref.types import Floats, Model, Projection, RenderOutput, View

BOUNDLESS = np.array([1e-12, 0.0, 1e-12])  # px^-2: a million pixels
PLURAL = "lines and triangles"
DEPTHS = frozenset({"depth", "normal", "spread", "median_depth"})
"""The channels that only surfaces have."""


def channels(wants: frozenset[str]) -> dict[str, slice]:
    """Return the image's channels by name."""
    return discs.channels(wants - {"median"})


def _is_plain(g: MixedGaussians) -> bool:
    return bool(np.all(counts(g) == 1))


def _hulls(projected: Projected) -> Hulls:
    g: MixedGaussians = projected.gaussians
    return Hulls(projected.primitives, g.vertices, counts(g))


def _footprints(projected: Projected) -> HullFootprints:
    return footprints_of(_hulls(projected), projected.projection, projected.camera, projected.conventions)


def _footprints_vjp(projected: Projected, v: tuple[Floats, ...]) -> PayloadGradient:
    """Gradient of :func:`_footprints` for that with respect to the vertices in the image."""
    (v_vertices,) = v
    found = footprints_vjp(_hulls(projected), projected.camera, projected.conventions, v_vertices)
    fields = {"vertices": found.vertices, "n_vertices": np.zeros_like(projected.gaussians.n_vertices)}
    v_scales = np.zeros_like(projected.primitives.scales)
    return PayloadGradient(fields, found.means, found.quats, v_scales, found.cam_from_world_R, found.cam_from_world_t)


def _list_boxes(footprints: HullFootprints) -> Projection:
    """Return the projection with ellipses that reach all tiles under the boxes of lines and triangles."""
    projection = footprints.projection
    conics = np.where((footprints.n_vertices > 1)[:, None], BOUNDLESS, projection.conics)
    return projection._replace(conics=conics)


def _surfaces(projected: Projected) -> SurfaceFootprints:
    seen, camera, dtype = _footprints(projected), projected.camera, projected.gaussians.means.dtype
    rows = np.flatnonzero(seen.projection.radii[:, 0] > 0)
    found = planes_of(_hulls(projected), rows, camera, projected.conventions)
    pivot = choose_pivot(seen.projection.depths[rows])
    planes, normals = found.planes.astype(dtype), found.normals.astype(dtype)
    return SurfaceFootprints(seen.projection, seen.vertices, seen.n_vertices, planes, normals, pivot)


def _surfaces_vjp(projected: Projected, v: tuple[Floats, ...]) -> PayloadGradient:
    """Gradient of :func:`_surfaces` for that with respect to vertices in the image, planes and normals."""
    v_vertices, v_planes, v_normals = v
    flat = _footprints_vjp(projected, (v_vertices,))
    rows = np.flatnonzero(v_planes.any(axis=1) | v_normals.any(axis=1))  # only visible hulls have derivatives
    through = planes_vjp(_hulls(projected), rows, projected.camera, projected.conventions, Planes(v_planes, v_normals))
    return PayloadGradient(
        {**flat.fields, "vertices": flat.fields["vertices"] + through.vertices},
        flat.means + through.means,
        flat.quats + through.quats,
        flat.scales + through.scales,
        flat.cam_from_world_R + through.cam_from_world_R,
        flat.cam_from_world_t + through.cam_from_world_t,
    )


def _carry(footprints: SurfaceFootprints, wants: frozenset[str]) -> Floats:
    """Return zeros, to which depths and inverse depths are added, and normals."""
    slices = channels(wants)
    carried = np.zeros((len(footprints.n_vertices), max(part.stop for part in slices.values())))
    if "normal" in slices:
        carried[:, slices["normal"]] = footprints.normals
    return carried[:, 3:]


def _carry_vjp(
    footprints: SurfaceFootprints, wants: frozenset[str], v_carried: Floats
) -> tuple[Floats, tuple[Floats, ...]]:
    """Gradient of :func:`_carry` with respect to the normals; that with respect to depths is the response's."""
    slices, v_normals = channels(wants), np.zeros_like(footprints.normals)
    if "normal" in slices:
        v_normals = v_carried[:, slices["normal"].start - 3 : slices["normal"].stop - 3]
    return np.zeros_like(footprints.projection.depths), (v_normals,)


FLAT_COLORS = Payload(
    PLURAL,
    RESPONSE,
    response_for,
    _is_plain,
    _footprints,
    _footprints_vjp,
    listed=_list_boxes,
    carried=Carried(channels),
)


@functools.cache
def with_surfaces(layout: Layout) -> Payload:
    """Return the payload for a layout's channels of depths; 3DGS has no such depths, so nothing is plain."""
    return FLAT_COLORS._replace(
        response=surface_response(layout),
        response_for=functools.partial(surface_response_for, layout),
        is_plain=lambda g: False,
        footprints=_surfaces,
        footprints_vjp=_surfaces_vjp,
        carried=Carried(channels, _carry, _carry_vjp),
    )


def render(model: Model, view: View, request: Request) -> tuple[RenderOutput, Any]:
    """Render a view; see :mod:`minisplat_ref.mechanisms.payload.renderer`.

    Raises
    ------
    InputError
        Something is wanted that this renderer does not collect.
    """
    slices, payload = channels(request.wants), FLAT_COLORS
    if request.wants & DEPTHS:
        payload = with_surfaces(
            Layout(*(slices[name].start if name in slices else None for name in ("depth", "spread")))
        )
    return render_payload(payload, model, view, request)


MIXED_RENDERER = Renderer("mixed", render, render_payload_vjp, channels)
