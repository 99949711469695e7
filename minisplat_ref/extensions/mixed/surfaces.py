"""The response of a hull with a plane in a pixel: the alpha of :mod:`.response`, and a depth for every pixel.

With the plane of :mod:`.planes`, p the projected mean and x the pixel's centre::

    1 / z = w max(r, 1/8),   r = 1 + s . (x - p)

The bound keeps depths positive: at most eight times that of the mean, which only a primitive reaches that is about as
long as it is far away.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from minisplat_ref.extensions.mixed import response
from minisplat_ref.extensions.mixed.response import HullFootprints
from minisplat_ref.mechanisms.payload.footprints import boxes_of
from minisplat_ref.mechanisms.surfels.response import Layout, depth_shading
from minisplat_ref.reference.hits import Hit, Response
from minisplat_ref.types import Bools, Floats, Ints

RATIO_MIN = 0.125  # of inverse depths, a pixel's over the mean's; exact in float32


@dataclass(frozen=True)
class SurfaceFootprints(HullFootprints):
    """Hulls as a camera sees them, with their planes."""

    planes: Floats
    """[N, 3] w and s."""
    normals: Floats
    """[N, 3] unit, camera frame, towards the camera."""
    pivot: float
    """q_0, an inverse depth of the view; see :class:`minisplat_ref.mechanisms.surfels.response.Layout`."""


FIELDS = (*response.FIELDS, "planes")


class SurfacePlace(NamedTuple):
    """The positions of pixels on surfaces."""

    hull: Hit
    offsets: Floats  # [G, P, 2] p - x, px
    ratios: Floats  # [G, P] max(r, 1/8)
    is_bounded: Bools  # [G, P] r < 1/8
    depths: Floats  # [G, P] z
    pivot: float  # q_0


def hit(footprints: SurfaceFootprints, ids: Ints, centers: Floats) -> Hit:
    """Evaluate surfaces at pixels; see :func:`minisplat_ref.reference.hits.conic_hit`."""
    hull, planes = response.hit(footprints, ids, centers), footprints.planes[ids]
    offsets = footprints.means2d[ids, None] - centers.astype(footprints.means2d.dtype)
    r = 1 - np.einsum("gi,gpi->gp", planes[:, 1:], offsets)
    ratios = np.maximum(r, RATIO_MIN)
    depths = 1 / (planes[:, :1] * ratios)
    place = SurfacePlace(hull, offsets, ratios, r < RATIO_MIN, depths, footprints.pivot)
    return Hit(hull.unclamped, depths, place)


def hit_vjp(
    footprints: SurfaceFootprints, ids: Ints, found: Hit, v_mean: Floats, v_shape: Floats, v_depths: Floats
) -> tuple[Floats, ...]:
    """Gradient of :func:`hit` with respect to ``FIELDS``, summed over the pixels.

    With ``q = 1 / z = w r``, besides the gradient of alpha::

        v_q = -z^2 v_z,   v_w = r v_q,   v_r = w v_q where r is not bounded,   v_s = v_r (x - p),   v_p = -v_r s
    """
    place: SurfacePlace = found.place
    v_p, v_conics, v_opacities, v_vertices = response.hit_vjp(footprints, ids, place.hull, v_mean, v_shape, None)
    w, s = footprints.planes[ids, :1], footprints.planes[ids, 1:]
    v_q = -place.depths * place.depths * v_depths
    v_r = np.where(place.is_bounded, 0, w * v_q)
    v_s = -np.einsum("gp,gpi->gi", v_r, place.offsets)
    v_planes = np.column_stack([np.sum(place.ratios * v_q, axis=1), v_s])
    return v_p - s * v_r.sum(axis=1, keepdims=True), v_conics, v_opacities, v_vertices, v_planes


def surface_response(layout: Layout) -> Response:
    """Return the response of surfaces with the channels of a layout."""
    return Response(boxes_of, hit, hit_vjp, FIELDS, depth_shading(layout))
