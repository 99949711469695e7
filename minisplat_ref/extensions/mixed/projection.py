"""From hulls in the world to their footprints in the image, in NumPy, with the gradient (MP-GS, 2507.11321).

A hull's vertices lie in the plane of its first two axes around its mean, all with the covariance ``R S S^T R^T``::

    x_k = mu + a_k R[:, 0] + b_k R[:, 1],   (a, b)_1 = -(a, b)_2 - (a, b)_3
    p_k = pinhole(R_c x_k + t),   B = A Sigma A^T + eps I,  A = J R_c

One covariance needs one Jacobian: J is that at the mean, whose depth is also the one by which tiles are sorted. The
paper counts from the first vertex instead of the mean: the same numbers of parameters for the same hulls, but here
nothing depends on which vertex is the first. A hull is culled if one of its vertices is nearer than the near plane.
An ellipse is projected as 3DGS does, by the backend.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.extensions.mixed.response import HullFootprints
from minisplat_ref.reference.antialiasing import adjugates, compensations, determinants
from minisplat_ref.reference.covariance import covariances, rotation_matrices, rotation_matrices_vjp
from minisplat_ref.reference.extent import extents
from minisplat_ref.reference.pinhole import (
    pinhole,
    pinhole_jacobians,
    pinhole_vjp,
    pose,
    slope_limits,
    with_principal_point,
)
from minisplat_ref.types import Camera, Floats, Ints, Primitives, Projection

N_VERTICES = 3  # at most


def in_plane(vertices: Floats, n_vertices: Ints) -> Floats:
    """Return (a, b)_k of all vertices.

    Parameters
    ----------
    vertices : ndarray of shape (N, 4)
        (a, b)_2 and (a, b)_3, world units or deviations.
    n_vertices : ndarray of shape (N,)
        1, 2 or 3.

    Returns
    -------
    ndarray of shape (N, 3, 2)
        Their mean is 0; zeros where a hull has no such vertex, and for an ellipse.
    """
    further = vertices.reshape(-1, N_VERTICES - 1, 2) * _has_further(n_vertices)
    return np.concatenate([-further.sum(axis=1, keepdims=True), further], axis=1)


def in_plane_vjp(n_vertices: Ints, v_in_plane: Floats) -> Floats:
    """Gradient of :func:`in_plane` with respect to the vertices [N, 4]: ``v_(a,b)_k = v_k - v_1``."""
    v_further = (v_in_plane[:, 1:] - v_in_plane[:, :1]) * _has_further(n_vertices)
    return v_further.reshape(-1, 4)


def _has_further(n_vertices: Ints) -> Ints:
    """Return 1 where a hull has a second and a third vertex and 0 elsewhere, [N, 2, 1]; an int8 widens no float."""
    return (np.array([2, 3]) <= n_vertices[:, None]).astype(np.int8)[:, :, None]


class Hulls(NamedTuple):
    """Hulls in the world."""

    primitives: Primitives
    """Activated; the means are those of the vertices."""
    vertices: Floats
    """[N, 4] (a, b)_2 and (a, b)_3, world units."""
    n_vertices: Ints
    """[N] 1, 2 or 3."""

    def of(self, rows: Ints) -> "Hulls":
        """Return some of them."""
        return Hulls(Primitives(*(f[rows] for f in self.primitives)), self.vertices[rows], self.n_vertices[rows])

    def in_camera(self, camera: Camera) -> tuple[Floats, Floats, Floats]:
        """Return the means [N, 3] and the vertices [N, 3, 3] in the camera's frame, and ``R_c R`` [N, 3, 3]."""
        R_c, t = pose(camera, self.vertices.dtype)
        G = R_c @ rotation_matrices(self.primitives.quats)
        x = self.primitives.means @ R_c.T + t
        placed = np.einsum("nij,nkj->nki", G[:, :, :2], in_plane(self.vertices, self.n_vertices))
        return x, x[:, None] + placed, G


def footprints_of(hulls: Hulls, projection: Projection, camera: Camera, conventions: Conventions) -> HullFootprints:
    """Return the camera's view of the hulls.

    Parameters
    ----------
    hulls : Hulls
    projection : Projection
        Of the hulls as ellipses around their means. Those of lines and triangles are made again, in float64, because
        they can be in the image where their ellipses are not, and the other way round.
    camera, conventions
        As for the projection.
    """
    rows = np.flatnonzero(hulls.n_vertices > 1)
    vertices = np.zeros((len(hulls.n_vertices), N_VERTICES, 2), projection.means2d.dtype)
    of_rows, vertices[rows] = _project(hulls.of(rows), camera, conventions)
    merged = Projection._make(field.copy() for field in projection)
    for whole, part in zip(merged, of_rows, strict=True):
        whole[rows] = part
    return HullFootprints(merged, vertices, hulls.n_vertices)


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # non-finite rows are culled, not reported
def _project(hulls: Hulls, camera: Camera, conventions: Conventions) -> tuple[Projection, Floats]:
    """Return the projection of lines and triangles, and their vertices [N, 3, 2] from the centres, px; in float64."""
    wide = Primitives(*(field.astype(np.float64) for field in hulls.primitives))
    hulls, opacities = Hulls(wide, hulls.vertices.astype(np.float64), hulls.n_vertices), wide.opacities
    camera = with_principal_point(camera, conventions)
    x, x_vertices, _ = hulls.in_camera(camera)
    A = pinhole_jacobians(x, camera, *slope_limits(camera, conventions, x.dtype)) @ pose(camera, x.dtype)[0]
    C = A @ covariances(wide.quats, wide.scales) @ np.swapaxes(A, 1, 2)
    B = C + conventions.eps2d * np.eye(2)
    det = determinants(B)
    conics = (adjugates(B) / det[:, None, None])[:, [0, 0, 1], [0, 1, 1]]
    if conventions.is_antialiased:
        opacities = opacities * compensations(C, B)
    means2d, points = pinhole(x, camera), pinhole(x_vertices.reshape(-1, 3), camera).reshape(-1, N_VERTICES, 2)
    reached = [extents(points[:, k], B, opacities, camera, conventions) for k in range(N_VERTICES)]
    radii, each = reached[0][0], np.stack([box for _, box in reached])  # [3, N, 4]
    boxes = np.hstack([each[:, :, :2].min(axis=0), each[:, :, 2:].max(axis=0)])

    numbers = np.column_stack([det, means2d, points.reshape(-1, 2 * N_VERTICES), conics, opacities, radii, boxes])
    is_visible = (conventions.near_plane < x_vertices[:, :, 2].min(axis=1)) & (x[:, 2] < conventions.far_plane)
    is_visible &= (opacities >= conventions.alpha_min) & (det > 0) & np.isfinite(numbers).all(axis=1)
    is_visible &= (radii > 0).all(axis=1) & (boxes[:, :2] < boxes[:, 2:]).all(axis=1)
    row = is_visible[:, None]
    projection = Projection(
        means2d=np.where(row, means2d, 0),
        depths=np.where(is_visible, x[:, 2], 0),
        conics=np.where(row, conics, 0),
        opacities=np.where(is_visible, opacities, 0),
        radii=np.where(row, radii, 0).astype(np.int32),
        boxes=np.where(row, boxes, 0).astype(np.int32),
    )
    return projection, np.where(row[:, :, None], points - means2d[:, None], 0)


class VertexGradient(NamedTuple):
    """Gradient of the loss with respect to hulls, as far as it passes through the vertices in the image."""

    vertices: Floats  # [N, 4]
    means: Floats  # [N, 3]
    quats: Floats  # [N, 4]
    cam_from_world_R: Floats  # [3, 3]
    cam_from_world_t: Floats  # [3]


def footprints_vjp(hulls: Hulls, camera: Camera, conventions: Conventions, v_vertices: Floats) -> VertexGradient:
    """Gradient of :func:`footprints_of` through its ``vertices``; the projection's is that of ellipses.

    A hull that is not seen has derivatives ``v_vertices`` [N, 3, 2] of 0, and is left out.

    With ``y_k = R_c x_k + t``, ``x = R_c mu + t``, ``G = R_c R`` and the pinhole's Jacobians::

        v_y_k = pinhole_vjp(y_k, v_p_k),  v_x = sum_k v_y_k - pinhole_vjp(x, sum_k v_p_k)
        v_(a,b)_k = G[:, :2]^T v_y_k,  v_G[:, :2] = sum_k v_y_k (a, b)_k^T,  v_R = R_c^T v_G
        v_mu = R_c^T v_x,  v_t = sum v_x,  v_R_c = sum v_G R^T + v_x mu^T
    """
    rows = np.flatnonzero((hulls.n_vertices > 1) & v_vertices.any(axis=(1, 2)))
    seen, v_p, eye = hulls.of(rows), v_vertices[rows], with_principal_point(camera, conventions)
    R_c, _ = pose(camera, v_p.dtype)
    x, y, G = seen.in_camera(camera)
    v_y = pinhole_vjp(y.reshape(-1, 3), eye, v_p.reshape(-1, 2)).reshape(-1, N_VERTICES, 3)
    v_x = v_y.sum(axis=1) - pinhole_vjp(x, eye, v_p.sum(axis=1))
    v_G = np.zeros_like(G)
    v_G[:, :, :2] = np.einsum("nki,nkj->nij", v_y, in_plane(seen.vertices, seen.n_vertices))
    means, quats, _, _ = seen.primitives
    found = VertexGradient(
        vertices=np.zeros_like(hulls.vertices),
        means=np.zeros_like(hulls.primitives.means),
        quats=np.zeros_like(hulls.primitives.quats),
        cam_from_world_R=np.einsum("nij,nkj->ik", v_G, rotation_matrices(quats)) + v_x.T @ means,
        cam_from_world_t=v_x.sum(axis=0),
    )
    found.vertices[rows] = in_plane_vjp(seen.n_vertices, np.einsum("nij,nki->nkj", G[:, :, :2], v_y))
    found.means[rows], found.quats[rows] = v_x @ R_c, rotation_matrices_vjp(quats, R_c.T @ v_G)
    return found
