"""The response of a Gaussian with cuts, in NumPy: Bezier curves in its plane, as polygons in the image.

The cubic B(t) of four control points P_j, in pixels from the Gaussian's centre, is approximated by ``N_EDGES`` edges
between ``V_i = B(i / N_EDGES)``. A pixel at d is visible if the segment from the centre to it crosses an even number of
edges of all M curves. So one curve cuts its shadow away, with a lamp at the centre, and where the shadows of two
overlap, the pixel is visible again. A shadow is bounded by the curve and by two rays, on which its ends B(0) and B(1)
move away from the centre. With the nearest point q of these M (N_EDGES + 2) pieces::

    o_i = sum_j a_ij P_j,  u_i = sum_j b_ij P_j       a piece runs from o_i along u_i: an edge once, a ray for ever
    f_i = clip((d - o_i) . u_i / u_i . u_i, 0, top_i),  q = o_i + f_i u_i of the piece where |d - q| is least
    distance = +-|d - q|                              positive where the pixel is visible
    mask = 1 / (1 + exp(-distance / w)); with the width w = 0, 1 where the pixel is visible and 0 elsewhere

Control points are stored as c_j along the first two axes of R, in units of the first two standard deviations. The
affine map that makes the Gaussian an ellipse in the image, with ``x = R_c mu + t`` and J of
:mod:`minisplat_ref.reference.pinhole`, applies to them, and the mask multiplies alpha (DisC-GS, 2405.15196)::

    M = J(x) R_c R diag(s),   P_j = c_j1 M_1 + c_j2 M_2,   alpha = o exp(-d^T Q d / 2) mask(d)
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.mechanisms.payload.footprints import Footprints, boxes_of
from minisplat_ref.reference.covariance import rotation_matrices, rotation_matrices_vjp
from minisplat_ref.reference.hits import CONIC, ConicPlace, Hit, Response
from minisplat_ref.reference.pinhole import (
    pinhole_jacobians,
    pinhole_jacobians_vjp,
    pose,
    slope_limits,
    with_principal_point,
)
from minisplat_ref.types import Bools, Camera, Floats, Ints, Primitives

N_EDGES = 8  # their weights are multiples of 1/512, which are exact in float32 and float64
N_POINTS = 4
LENGTH_MIN = 1e-12  # px^2: a shorter edge counts as a point


# --- curves ---


def bernstein(t: Floats) -> Floats:
    """Return the weights [..., 4] of the control points of a cubic at t."""
    t = np.asarray(t)[..., None]
    s = 1 - t
    return np.concatenate([s**3, 3 * s**2 * t, 3 * s * t**2, t**3], axis=-1)


VERTICES = bernstein(np.arange(N_EDGES + 1) / N_EDGES)  # [N_EDGES + 1, 4] weights of V_i
ENDS = np.eye(N_POINTS)[[0, -1]]  # [2, 4] of B(0) and B(1)
ORIGINS = np.concatenate([VERTICES[:-1], ENDS])  # [N_EDGES + 2, 4] a
DIRECTIONS = np.concatenate([np.diff(VERTICES, axis=0), ENDS])  # b
TOPS = np.concatenate([np.ones(N_EDGES), np.full(2, 1e9)])  # largest f
N_PIECES = len(TOPS)  # of a curve


def vertices_of(curves: Floats) -> Floats:
    """Return the vertices [..., N_EDGES + 1, 2] of curves [..., 4, 2], with the same rounding for both backends.

    It decides on which side a curve through the centre passes it.
    """
    w, P = VERTICES.astype(curves.dtype)[:, :, None], curves[..., None, :, :]  # [N_EDGES + 1, 4, 1], [..., 1, 4, 2]
    return np.asarray(w[:, 0] * P[..., 0, :] + w[:, 1] * P[..., 1, :] + w[:, 2] * P[..., 2, :] + w[:, 3] * P[..., 3, :])


def repeat_for_curves(weights: Floats, n: int) -> Floats:
    """Return weights [K, 4] of one curve's points as those [n K, 4 n] of n curves with four points each."""
    return np.kron(np.eye(n), weights)


class Cut(NamedTuple):
    """The positions of P pixels relative to the curves of G Gaussians."""

    is_visible: Bools  # [G, P]
    away: Floats  # [G, P, 2] d - q, px
    pieces: Ints  # [G, P] the nearest, curve by curve
    fractions: Floats  # [G, P] f of it
    masks: Floats  # [G, P]


def evaluate_cuts(points: Floats, widths: Floats, offsets: Floats) -> Cut:
    """Return the masks that curves make, and the nearest points on them.

    Parameters
    ----------
    points : ndarray of shape (G, 4 M, 2)
        Control points of M curves, one after the other, px from the centre.
    widths : ndarray of shape (G,)
        w, px.
    offsets : ndarray of shape (G, P, 2)
        d, the pixels' positions relative to the centre, px.
    """
    dtype, n = points.dtype, points.shape[1] // N_POINTS
    o, u = (
        np.einsum("ij,gjk->gik", repeat_for_curves(weights, n).astype(dtype), points)[:, None]
        for weights in (ORIGINS, DIRECTIONS)
    )
    d = offsets[:, :, None]  # [G, P, 1, 2]
    f = np.sum((d - o) * u, axis=3) / np.maximum(np.sum(u * u, axis=3), dtype.type(LENGTH_MIN))
    f = np.clip(f, 0, np.tile(TOPS, n).astype(dtype))  # [G, P, pieces]
    away = d - o - f[..., None] * u
    pieces = np.argmin(np.sum(away**2, axis=3), axis=2)[:, :, None]  # [G, P, 1] the first of equals
    nearest = np.take_along_axis(away, pieces[..., None], axis=2)[:, :, 0]
    is_visible = count_crossings(points, offsets) % 2 == 0
    distances = np.where(is_visible, 1, -1) * np.linalg.norm(nearest, axis=2)
    fractions = np.take_along_axis(f, pieces, axis=2)[:, :, 0]
    return Cut(is_visible, nearest, pieces[:, :, 0], fractions, _masks(distances, widths))


def _masks(distances: Floats, widths: Floats) -> Floats:
    """Return the masks [G, P] of signed distances [G, P] for widths [G], which may be 0."""
    is_soft = (widths > 0)[:, None]
    z = distances / np.where(is_soft, widths[:, None], 1)
    e = np.exp(-np.abs(z))
    soft = np.where(z > 0, 1, e) / (1 + e)
    return np.where(is_soft, soft, distances > 0).astype(distances.dtype)


def count_crossings(points: Floats, offsets: Floats) -> Ints:
    """Return the number [G, P] of edges of all curves that the segments from the centre to pixels cross.

    An edge is crossed if its ends lie on different sides of the line through centre and pixel, and centre and pixel on
    different sides of the edge. Zero counts as negative, so a line through a vertex crosses one of its two edges, or
    both or none.
    """
    curves = points.reshape(len(points), points.shape[1] // N_POINTS, N_POINTS, 2)  # [G, M, 4, 2]
    V = vertices_of(curves)[:, None]  # [G, 1, M, N_EDGES + 1, 2]
    d = offsets[:, :, None, None]
    is_left = _cross(d, V) > 0  # [G, P, M, N_EDGES + 1]
    o, u = V[:, :, :, :-1], np.diff(V, axis=3)
    is_beyond = (_cross(u, d - o) > 0) != (_cross(u, -o) > 0)
    return np.sum((is_left[..., 1:] != is_left[..., :-1]) & is_beyond, axis=(2, 3))


def evaluate_cuts_vjp(points: Floats, widths: Floats, found: Cut, v_masks: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`evaluate_cuts` with respect to control points [G, 4 M, 2] and offsets [G, P, 2].

    At the nearest point a displacement along its piece does not change the distance, so f counts as fixed. With the
    unit vector e along d - q, along which the distance grows where the pixel is visible::

        v_z = mask (1 - mask) v_mask / w,  v_d = +-v_z e,  v_P_j = -sum over pixels of (a_ij + f b_ij) v_d

    With the width 0 the mask is a step, and the gradient is 0.
    """
    is_soft = (widths > 0)[:, None]
    v_distances = found.masks * (1 - found.masks) * v_masks / np.where(is_soft, widths[:, None], 1)
    v_distances = np.where(is_soft & found.is_visible, v_distances, np.where(is_soft, -v_distances, 0))
    lengths = np.linalg.norm(found.away, axis=2)
    v_offsets = (v_distances / np.where(lengths > 0, lengths, 1))[:, :, None] * found.away
    n = points.shape[1] // N_POINTS
    origins, directions = (repeat_for_curves(weights, n)[found.pieces] for weights in (ORIGINS, DIRECTIONS))
    weights = origins + found.fractions[:, :, None] * directions  # [G, P, 4 M]
    return -np.einsum("gpj,gpk->gjk", weights.astype(points.dtype), v_offsets), v_offsets


def _cross(x: Floats, y: Floats) -> Floats:
    """Return ``x_0 y_1 - x_1 y_0`` of the last axis."""
    return x[..., 0] * y[..., 1] - x[..., 1] * y[..., 0]


# --- from the Gaussian's plane to the image ---


def image_points(curves: Floats, primitives: Primitives, camera: Camera, conventions: Conventions) -> Floats:
    """Return the control points [N, 4 M, 2] in pixels from the centres.

    Parameters
    ----------
    curves : ndarray of shape (N, 8 M)
        c_j of M curves, point by point.
    primitives : Primitives
        N Gaussians in front of the camera.
    camera, conventions
        As for the projection.
    """
    *_, M = _maps(primitives, camera, conventions)
    return np.asarray(_by_points(curves) @ np.swapaxes(M, 1, 2))


class PointsGradient(NamedTuple):
    """Gradient of the loss with respect to everything that :func:`image_points` depends on."""

    curves: Floats  # [N, 8 M]
    means: Floats  # [N, 3]
    quats: Floats  # [N, 4]
    scales: Floats  # [N, 3]
    cam_from_world_R: Floats  # [3, 3]
    cam_from_world_t: Floats  # [3]


def image_points_vjp(
    curves: Floats, primitives: Primitives, camera: Camera, conventions: Conventions, v_points: Floats
) -> PointsGradient:
    """Gradient of :func:`image_points`.

    With ``G = R_c R`` and the first two columns of ``M = J G diag(s)``::

        v_c_j = M^T v_P_j,  v_M = sum_j v_P_j c_j^T,  v_J = v_M (G s)^T
        v_G = J^T v_M s,  v_s_k = sum_i G_ik (J^T v_M)_ik,  v_R = R_c^T v_G
        v_x = that of J,  v_mu = R_c^T v_x,  v_t = sum v_x,  v_R_c = sum v_G R^T + v_x mu^T
    """
    means, quats, scales, _ = primitives
    x, R, J, M = _maps(primitives, camera, conventions)
    R_c, _ = pose(camera, means.dtype)
    G = (R_c @ R)[:, :, :2]
    v_M = np.swapaxes(v_points, 1, 2) @ _by_points(curves)  # [N, 2, 2]
    v_J = v_M @ np.swapaxes(G * scales[:, None, :2], 1, 2)
    v_GS = np.swapaxes(J, 1, 2) @ v_M  # [N, 3, 2]
    v_G, v_scales = np.zeros_like(R), np.zeros_like(scales)
    v_G[:, :, :2] = v_GS * scales[:, None, :2]
    v_scales[:, :2] = np.sum(G * v_GS, axis=1)
    seen = with_principal_point(camera, conventions)
    v_x = pinhole_jacobians_vjp(x, seen, *slope_limits(seen, conventions, means.dtype), v_J)
    return PointsGradient(
        curves=(v_points @ M).reshape(curves.shape),
        means=v_x @ R_c,
        quats=rotation_matrices_vjp(quats, R_c.T @ v_G),
        scales=v_scales,
        cam_from_world_R=np.sum(v_G @ np.swapaxes(R, 1, 2), axis=0) + v_x.T @ means,
        cam_from_world_t=v_x.sum(axis=0),
    )


def _by_points(curves: Floats) -> Floats:
    """Return [N, 8 M] numbers as points [N, 4 M, 2]."""
    return curves.reshape(len(curves), curves.shape[1] // 2, 2)


def _maps(primitives: Primitives, camera: Camera, conventions: Conventions) -> tuple[Floats, Floats, Floats, Floats]:
    """Return x [N, 3], R [N, 3, 3], J [N, 2, 3] and the first two columns of M [N, 2, 2]."""
    means, quats, scales, _ = primitives
    seen = with_principal_point(camera, conventions)
    R_c, t = pose(camera, means.dtype)
    x, R = means @ R_c.T + t, rotation_matrices(quats)
    J = pinhole_jacobians(x, seen, *slope_limits(seen, conventions, means.dtype))
    return x, R, J, (J @ R_c @ R)[:, :, :2] * scales[:, None, :2]


# --- the response ---


@dataclass(frozen=True)
class CutFootprints(Footprints):
    """The footprints of Gaussians with cuts."""

    points: Floats
    """[N, 4 M, 2] control points of M curves, px from the centre."""
    widths: Floats
    """[N] w of the mask, px."""
    alpha_min: float
    """Of the conventions: kernels do not evaluate cuts where alpha is smaller without them."""


FIELDS = (*CONIC.fields, "points")


class Place(NamedTuple):
    """The positions of pixels in Gaussians with cuts."""

    conic: ConicPlace
    uncut: Floats  # [G, P] alpha without the mask
    cut: Cut


def hit(footprints: CutFootprints, ids: Ints, centers: Floats) -> Hit:
    """Return the hits of footprints with their masks at pixels; see :func:`minisplat_ref.reference.hits.conic_hit`."""
    flat = CONIC.hit(footprints.projection, ids, centers)
    found = evaluate_cuts(footprints.points[ids], footprints.widths[ids], -flat.place.offsets)
    return Hit(flat.unclamped * found.masks, flat.depths, Place(flat.place, flat.unclamped, found))


def hit_vjp(
    footprints: CutFootprints, ids: Ints, hit: Hit, v_mean: Floats, v_shape: Floats, v_place: None
) -> tuple[Floats, ...]:
    """Gradient of :func:`hit` with respect to ``FIELDS``: that of the conic for ``mask v``, and that of the mask."""
    place: Place = hit.place
    flat = Hit(place.uncut, hit.depths, place.conic)
    masks = place.cut.masks
    v_means2d, v_conics, v_opacities = CONIC.hit_vjp(
        footprints.projection, ids, flat, v_mean * masks, v_shape * masks, None
    )
    v_points, v_offsets = evaluate_cuts_vjp(
        footprints.points[ids], footprints.widths[ids], place.cut, v_shape * place.uncut
    )
    return v_means2d - v_offsets.sum(axis=1), v_conics, v_opacities, v_points


RESPONSE = Response(boxes_of, hit, hit_vjp, FIELDS)
