"""The response of the hull of one, two or three points in a pixel, in NumPy (MP-GS, 2507.11321), and its depth there.

An ellipse, a Gaussian line and a Gaussian triangle are one formula. Their vertices p_1 .. p_m share the covariance
``Q^-1 = L L^T``, and in whitened pixels ``y = L^-1 p`` opacity falls with the distance to the vertices' convex hull::

    alpha = o exp(-dist(y, conv{y_1 .. y_m})^2 / 2),   y = L^-1 x of the pixel's centre x

For m = 1 that is 3DGS. Of a line the hull is a segment, and alpha is constant across it and round at both ends; inside
a triangle alpha is o. The paper constructs the same from ellipses around the vertices, their common tangents and
quadrilaterals between these; a test follows that construction.

Only squares of distances are needed, ``|L^-1 d|^2 = d^T Q d``. The nearest point of the hull is a mean of its vertices
with weights w; the distance is the least over all weights, so that it does not change, to first order, with the best
ones (the envelope theorem). Its gradient is that of an ellipse around the nearest point, distributed by the weights::

    d = sum_k w_k p_k - x,   alpha = o exp(-d^T Q d / 2),   v_p_k = w_k v_d

Vertices are given from the hull's centre, which moves them all.

With the plane of a primitive (:mod:`.projection`) a pixel has a depth, too; p is the projected mean::

    1 / z = w max(r, 1/8),   r = 1 + s . (x - p)

The bound keeps depths positive: at most eight times that of the mean, which only a primitive reaches that is about as
long as it is far away.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from minisplat_ref.mechanisms.payload.footprints import Footprints, boxes_of
from minisplat_ref.mechanisms.surfels.response import Layout, depth_shading
from minisplat_ref.reference.hits import CONIC, Hit, Response, conic_matrices
from minisplat_ref.types import Bools, Floats, Ints

EDGES = ((0, 1), (1, 2), (2, 0))
INSIDE = -1  # in Nearest.edges
FLAT = 1e-5  # twice a triangle's area over its longest edge squared: below, it is its edges
RATIO_MIN = 0.125  # of inverse depths, a pixel's over the mean's; exact in float32


@dataclass(frozen=True)
class HullFootprints(Footprints):
    """Hulls as a camera sees them; the projection is that of their centres, and its conics belong to all vertices."""

    vertices: Floats
    """[N, 3, 2] p_k from the centre, px; zeros where a hull has no such vertex, and for an ellipse."""
    n_vertices: Ints
    """[N] 1, 2 or 3."""


FIELDS = (*CONIC.fields, "vertices")


class Nearest(NamedTuple):
    """The points of G hulls that are nearest to P pixels."""

    weights: Floats  # [G, P, 3] w of the vertices; zeros inside a triangle, where no vertex matters
    offsets: Floats  # [G, P, 2] d, nearest point minus pixel, px
    edges: Ints  # [G, P] the edge on which the point lies, or INSIDE


def nearest(vertices: Floats, n_vertices: Ints, Q: Floats, centers: Floats) -> Nearest:
    """Return the nearest points in the metric of Q.

    The point o + f u of an edge u is nearest for ``f = clip(-o . Q u / u . Q u, 0, 1)``, with o from the pixel to the
    edge's start. An edge of no length is its start.

    Parameters
    ----------
    vertices : ndarray of shape (G, 3, 2)
        p_k, px.
    n_vertices : ndarray of shape (G,)
        m: of a line only the first edge counts, which of an ellipse has no length.
    Q : ndarray of shape (G, 2, 2)
        px^-2.
    centers : ndarray of shape (P, 2)
        x, px.
    """
    from_pixels = vertices[:, :, None] - centers.astype(vertices.dtype)  # [G, 3, P, 2]
    shape = from_pixels[:, 0].shape
    weights, offsets = np.zeros((*shape[:2], 3), vertices.dtype), np.zeros(shape, vertices.dtype)
    edges, least = np.zeros(shape[:2], int), np.full(shape[:2], np.inf)
    for edge, (i, j) in enumerate(EDGES):
        o, u = from_pixels[:, i], vertices[:, j] - vertices[:, i]
        Qu = np.einsum("gij,gj->gi", Q, u)
        squared_length = np.sum(u * Qu, axis=1)[:, None]  # [G, 1]
        has_length = squared_length > 0
        f = np.clip(-np.einsum("gpi,gi->gp", o, Qu) / np.where(has_length, squared_length, 1), 0, 1)
        f = np.where(has_length, f, 0)
        d = o + f[:, :, None] * u[:, None]
        squared = np.einsum("gpi,gij,gpj->gp", d, Q, d)
        is_nearer = (squared < least) & ((edge == 0) | (n_vertices == 3))[:, None]
        of_edge = np.zeros_like(weights)
        of_edge[:, :, i], of_edge[:, :, j] = 1 - f, f
        weights = np.where(is_nearer[:, :, None], of_edge, weights)
        offsets = np.where(is_nearer[:, :, None], d, offsets)
        edges, least = np.where(is_nearer, edge, edges), np.where(is_nearer, squared, least)
    inside = _are_inside(vertices, from_pixels) & (n_vertices == 3)[:, None]
    outside = np.logical_not(inside)[:, :, None]
    return Nearest(weights * outside, offsets * outside, np.where(inside, INSIDE, edges))


def _are_inside(vertices: Floats, from_pixels: Floats) -> Bools:
    """Return whether the edges of triangles go round the pixels in one direction, [G, P].

    Of a flat triangle the signs would be those of rounding errors, on its line as far away as one likes.
    """
    edges = np.stack([vertices[:, j] - vertices[:, i] for i, j in EDGES], axis=1)  # [G, 3, 2]
    area = _cross(edges[:, 0], -edges[:, 2])  # twice
    is_flat = np.abs(area) <= FLAT * np.max(np.sum(edges**2, axis=2), axis=1)
    from_inside = np.where(is_flat, 0, np.sign(area))[:, None, None] * _cross(edges[:, :, None], -from_pixels)
    inside: Bools = np.logical_and.reduce(from_inside > 0, axis=1)
    return inside


def _cross(a: Floats, b: Floats) -> Floats:
    """Return ``a_0 b_1 - a_1 b_0`` of the last axis."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


class Place(NamedTuple):
    """The positions of pixels relative to hulls."""

    nearest: Nearest
    falloffs: Floats  # [G, P] exp(-sigma)


def hit_hull(footprints: HullFootprints, ids: Ints, centers: Floats) -> Hit:
    """Evaluate hulls at pixels; see :func:`minisplat_ref.reference.hits.conic_hit`."""
    projection, Q = footprints.projection, conic_matrices(footprints.conics[ids])
    vertices = footprints.means2d[ids, None] + footprints.vertices[ids]
    found = nearest(vertices, footprints.n_vertices[ids], Q, centers)
    sigmas = np.einsum("gpi,gij,gpj->gp", found.offsets, Q, found.offsets) / 2
    falloffs = np.exp(-np.maximum(sigmas, 0))
    # A negative square is a rounding error.
    unclamped = np.where(sigmas >= 0, projection.opacities[ids, None] * falloffs, 0)
    depths = np.broadcast_to(projection.depths[ids, None], unclamped.shape)
    return Hit(unclamped, depths, Place(found, falloffs))


def hit_hull_vjp(
    footprints: HullFootprints, ids: Ints, hit: Hit, v_mean: Floats, v_shape: Floats, v_place: None
) -> tuple[Floats, ...]:
    """Gradient of :func:`hit_hull` with respect to ``FIELDS``, summed over the pixels.

    With ``alpha = o E``, ``E = exp(-sigma)``, ``sigma = d^T Q d / 2``::

        v_o = E v_alpha,  v_sigma = -o E v_alpha
        v_d = v_sigma Q d,  v_p_k = w_k v_d, and the centre's is v_d, as d is 0 inside a triangle
        v_a = v_sigma dx^2 / 2,  v_b = v_sigma dx dy,  v_c = v_sigma dy^2 / 2
    """
    (weights, d, _), falloffs = hit.place
    unclamped = footprints.opacities[ids, None] * falloffs  # [G, P] o E
    Q = conic_matrices(footprints.conics[ids])
    v_d = np.einsum("gp,gij,gpj->gpi", -unclamped * v_mean, Q, d)
    v_Q = np.einsum("gp,gpi,gpj->gij", -unclamped * v_shape / 2, d, d)
    v_conics = np.column_stack([v_Q[:, 0, 0], 2 * v_Q[:, 0, 1], v_Q[:, 1, 1]])
    v_vertices = np.einsum("gpk,gpi->gki", weights, v_d)
    return v_d.sum(axis=1), v_conics, np.sum(falloffs * v_shape, axis=1), v_vertices


RESPONSE = Response(boxes_of, hit_hull, hit_hull_vjp, FIELDS)


@dataclass(frozen=True)
class SurfaceFootprints(HullFootprints):
    """Hulls as a camera sees them, with their planes."""

    planes: Floats
    """[N, 3] w and s."""
    normals: Floats
    """[N, 3] unit, camera frame, towards the camera."""
    pivot: float
    """q_0, an inverse depth of the view; see :class:`minisplat_ref.mechanisms.surfels.response.Layout`."""


SURFACE_FIELDS = (*FIELDS, "planes")


class SurfacePlace(NamedTuple):
    """The positions of pixels on surfaces."""

    hull: Hit
    offsets: Floats  # [G, P, 2] p - x, px
    ratios: Floats  # [G, P] max(r, 1/8)
    is_bounded: Bools  # [G, P] r < 1/8
    depths: Floats  # [G, P] z
    pivot: float  # q_0


def hit_surface(footprints: SurfaceFootprints, ids: Ints, centers: Floats) -> Hit:
    """Evaluate surfaces at pixels; see :func:`minisplat_ref.reference.hits.conic_hit`."""
    hull, planes = hit_hull(footprints, ids, centers), footprints.planes[ids]
    offsets = footprints.means2d[ids, None] - centers.astype(footprints.means2d.dtype)
    r = 1 - np.einsum("gi,gpi->gp", planes[:, 1:], offsets)
    ratios = np.maximum(r, RATIO_MIN)
    depths = 1 / (planes[:, :1] * ratios)
    place = SurfacePlace(hull, offsets, ratios, r < RATIO_MIN, depths, footprints.pivot)
    return Hit(hull.unclamped, depths, place)


def hit_surface_vjp(
    footprints: SurfaceFootprints, ids: Ints, found: Hit, v_mean: Floats, v_shape: Floats, v_depths: Floats
) -> tuple[Floats, ...]:
    """Gradient of :func:`hit_surface` with respect to ``SURFACE_FIELDS``, summed over the pixels.

    With ``q = 1 / z = w r``, besides the gradient of alpha::

        v_q = -z^2 v_z,   v_w = r v_q,   v_r = w v_q where r is not bounded,   v_s = v_r (x - p),   v_p = -v_r s
    """
    place: SurfacePlace = found.place
    v_p, v_conics, v_opacities, v_vertices = hit_hull_vjp(footprints, ids, place.hull, v_mean, v_shape, None)
    w, s = footprints.planes[ids, :1], footprints.planes[ids, 1:]
    v_q = -place.depths * place.depths * v_depths
    v_r = np.where(place.is_bounded, 0, w * v_q)
    v_s = -np.einsum("gp,gpi->gi", v_r, place.offsets)
    v_planes = np.column_stack([np.sum(place.ratios * v_q, axis=1), v_s])
    return v_p - s * v_r.sum(axis=1, keepdims=True), v_conics, v_opacities, v_vertices, v_planes


def surface_response(layout: Layout) -> Response:
    """Return the response of surfaces with the channels of a layout."""
    return Response(boxes_of, hit_surface, hit_surface_vjp, SURFACE_FIELDS, depth_shading(layout))
