"""The response of a Gaussian with cuts, in NumPy: curves in its plane are mapped to the image as its footprint is.

Control points are c_j along the first two axes of R, in units of the first two standard deviations. The affine map that
makes the Gaussian an ellipse in the image, with ``x = R_c mu + t`` and J of :mod:`minisplat_ref.reference.pinhole`,
applies to them, and the mask multiplies alpha::

    M = J(x) R_c R diag(s),   P_j = c_j1 M_1 + c_j2 M_2,   alpha = o exp(-d^T Q d / 2) mask(d)
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.extensions.cuts.curve import Cut, evaluate_cuts, evaluate_cuts_vjp
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
from minisplat_ref.types import Camera, Floats, Ints, Primitives


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
    return np.einsum("nik,njk->nji", M, _by_points(curves))


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
    v_M = np.einsum("nji,njk->nik", v_points, _by_points(curves))  # [N, 2, 2]
    v_J = np.einsum("nik,nlk,nk->nil", v_M, G, scales[:, :2])
    v_GS = np.einsum("nil,nik->nlk", J, v_M)  # [N, 3, 2]
    v_G, v_scales = np.zeros_like(R), np.zeros_like(scales)
    v_G[:, :, :2] = v_GS * scales[:, None, :2]
    v_scales[:, :2] = np.sum(G * v_GS, axis=1)
    seen = with_principal_point(camera, conventions)
    v_x = pinhole_jacobians_vjp(x, seen, *slope_limits(seen, conventions, means.dtype), v_J)
    return PointsGradient(
        curves=np.einsum("nik,nji->njk", M, v_points).reshape(curves.shape),
        means=v_x @ R_c,
        quats=rotation_matrices_vjp(quats, R_c.T @ v_G),
        scales=v_scales,
        cam_from_world_R=np.einsum("nij,nkj->ik", v_G, R) + v_x.T @ means,
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


@dataclass(frozen=True)
class CutFootprints(Footprints):
    """The footprints of Gaussians with cuts."""

    points: Floats
    """[N, 4 M, 2] control points of M curves, px from the centre."""
    widths: Floats
    """[N] w of the mask, px."""


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
