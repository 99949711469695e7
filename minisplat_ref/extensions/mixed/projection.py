"""From hulls in the world to footprints and planes in the image, in NumPy, with the gradient (MP-GS, 2507.11321).

A hull's vertices lie in the plane of its first two axes around its mean, all with the covariance ``R S S^T R^T``::

    x_k = mu + a_k R[:, 0] + b_k R[:, 1],   (a, b)_1 = -(a, b)_2 - (a, b)_3
    p_k = pinhole(R_c x_k + t),   B = A Sigma A^T + eps I,  A = J R_c

One covariance needs one Jacobian: J is that at the mean, whose depth is also the one by which tiles are sorted. The
paper counts from the first vertex instead of the mean: the same numbers of parameters for the same hulls, but here
nothing depends on which vertex is the first. A hull is culled if one of its vertices is nearer than the near plane.
An ellipse is projected as 3DGS does, by the backend.

The paper trains with the losses of 2D Gaussian Splatting, which need a depth at each pixel and a normal. There a ray
meets a disc. Here a primitive has an ellipse in the image and, if its deviations are similar, no disc, so the plane is
that of the best linear prediction of depth from image position over the primitive. With the covariance K of
its points in the world and h the prediction's slope::

    K = R (diag(s^2) + kappa sum_k (a, b)_k (a, b)_k^T) R^T,   kappa = 1/6 of a line, 1/12 of a triangle
    c = cov(image, z) = A K e,   B = A K A^T + eps I,   h = B^-1 c,   e the camera's axis, R_c^T (0, 0, 1)
    1 / z(x) = (1 + s . (x - p)) / z_p,   s = -h / z_p
    n = -m / |m|,   m = (f_x s_x, f_y s_y, 1 - sum_k s_k f_k u_k),   u = (x, y) / z of the mean

kappa is the variance of a uniform segment or triangle, and p the projected mean. On a plane 1/z is linear in the image,
so a flat primitive that is large against a pixel has the depth of its own plane exactly. Seen from its edge, or smaller
than the low-pass eps, its plane turns towards the camera instead of running to infinity, for which 2D Gaussian
Splatting takes the depth of the centre. A large ball faces the camera. To first order, a depth is no more of the
primitive's deviations of depth away from the mean's than its pixel is of deviations in the image.
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
    pinhole_jacobians_vjp,
    pinhole_vjp,
    pose,
    slope_limits,
    with_principal_point,
)
from minisplat_ref.types import Camera, Floats, Ints, Primitives, Projection

N_VERTICES = 3  # at most
KAPPA = np.array([0.0, 0.0, 1 / 6, 1 / 12])  # by the number of vertices


def place_vertices(vertices: Floats, n_vertices: Ints) -> Floats:
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


def place_vertices_vjp(n_vertices: Ints, v_in_plane: Floats) -> Floats:
    """Gradient of :func:`place_vertices` with respect to the vertices [N, 4]: ``v_(a,b)_k = v_k - v_1``."""
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
        placed = np.einsum("nij,nkj->nki", G[:, :, :2], place_vertices(self.vertices, self.n_vertices))
        return x, x[:, None] + placed, G


def project_hulls(hulls: Hulls, projection: Projection, camera: Camera, conventions: Conventions) -> HullFootprints:
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
    """Gradient of :func:`project_hulls` through its ``vertices``; the projection's is that of ellipses.

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
    v_G[:, :, :2] = np.einsum("nki,nkj->nij", v_y, place_vertices(seen.vertices, seen.n_vertices))
    means, quats, _, _ = seen.primitives
    found = VertexGradient(
        vertices=np.zeros_like(hulls.vertices),
        means=np.zeros_like(hulls.primitives.means),
        quats=np.zeros_like(hulls.primitives.quats),
        cam_from_world_R=np.einsum("nij,nkj->ik", v_G, rotation_matrices(quats)) + v_x.T @ means,
        cam_from_world_t=v_x.sum(axis=0),
    )
    found.vertices[rows] = place_vertices_vjp(seen.n_vertices, np.einsum("nij,nki->nkj", G[:, :, :2], v_y))
    found.means[rows], found.quats[rows] = v_x @ R_c, rotation_matrices_vjp(quats, R_c.T @ v_G)
    return found


class Planes(NamedTuple):
    """The planes of N primitives."""

    planes: Floats
    """[N, 3] ``1 / z_p``, per world unit, and s, per pixel."""
    normals: Floats
    """[N, 3] n: unit, camera frame, towards the camera."""


class PlaneGradient(NamedTuple):
    """Gradient of the loss with respect to hulls, as far as it passes through their planes."""

    vertices: Floats  # [N, 4]
    means: Floats  # [N, 3]
    quats: Floats  # [N, 4]
    scales: Floats  # [N, 3] activated
    cam_from_world_R: Floats  # [3, 3]
    cam_from_world_t: Floats  # [3]


class _Steps(NamedTuple):
    """Terms that forward and backward pass share."""

    x: Floats  # [N, 3] means, camera frame
    J: Floats  # [N, 2, 3]
    A: Floats  # [N, 2, 3]
    R: Floats  # [N, 3, 3]
    RD: Floats  # [N, 3, 3] R D with the covariance D in the primitive's own frame
    K: Floats  # [N, 3, 3]
    AK: Floats  # [N, 2, 3]
    inverse: Floats  # [N, 2, 2] of B
    h: Floats  # [N, 2] world units per pixel
    focal: Floats  # [2] px
    m: Floats  # [N, 3]


def _steps(hulls: Hulls, camera: Camera, conventions: Conventions) -> _Steps:
    means, quats, scales, _ = hulls.primitives
    R_c, t = pose(camera, means.dtype)
    x, R = means @ R_c.T + t, rotation_matrices(quats)
    J = pinhole_jacobians(x, camera, *slope_limits(camera, conventions, means.dtype))
    ab = place_vertices(hulls.vertices, hulls.n_vertices)  # [N, 3, 2]
    D = np.eye(3) * (scales * scales)[:, None]
    D[:, :2, :2] += KAPPA[hulls.n_vertices, None, None] * np.einsum("nki,nkj->nij", ab, ab)
    RD, A = R @ D, J @ R_c
    K = RD @ np.swapaxes(R, 1, 2)
    AK = A @ K
    B = AK @ np.swapaxes(A, 1, 2) + conventions.eps2d * np.eye(2)
    inverse = adjugates(B) / determinants(B)[:, None, None]
    h = np.einsum("nij,nj->ni", inverse, AK @ R_c[2])
    focal, s = np.array([camera.fx, camera.fy]), -h / x[:, 2:]
    m = np.column_stack([focal * s, 1 - np.sum(focal * s * x[:, :2], axis=1) / x[:, 2]])
    return _Steps(x, J, A, R, RD, K, AK, inverse, h, focal, m)


def _seen(hulls: Hulls, rows: np.ndarray) -> Hulls:
    """Return some hulls in float64."""
    part = hulls.of(rows)
    wide = Primitives(*(field.astype(np.float64) for field in part.primitives))
    return Hulls(wide, part.vertices.astype(np.float64), part.n_vertices)


def fit_planes(hulls: Hulls, rows: np.ndarray, camera: Camera, conventions: Conventions) -> Planes:
    """Return the planes of the hulls ``rows`` [V], in float64; zeros of all others."""
    found = _steps(_seen(hulls, rows), with_principal_point(camera, conventions), conventions)
    z, n = found.x[:, 2:], len(hulls.n_vertices)
    planes, normals = np.zeros((n, 3)), np.zeros((n, 3))
    planes[rows] = np.column_stack([1 / z, -found.h / z])
    normals[rows] = -found.m / np.linalg.norm(found.m, axis=1, keepdims=True)
    return Planes(planes, normals)


def planes_vjp(
    hulls: Hulls, rows: np.ndarray, camera: Camera, conventions: Conventions, v_planes: Planes
) -> PlaneGradient:
    """Gradient of :func:`fit_planes`.

    With the derivatives v_w of ``1 / z_p``, v_s and v_n, and ``y = R_c mu + t``::

        v_m = -(v_n - n (n . v_n)) / |m|,   v_s_k += f_k (v_m_k - u_k v_m_z),   v_u_k = -s_k f_k v_m_z
        v_y = J's share, + v_u / z on x and y, + (h . v_s - v_w) / z^2 - v_u . u / z on z,   v_h = -v_s / z
        v_c = B^-1 v_h,   v_B = -v_c h^T,   v_A = (v_B + v_B^T) A K + v_c (K e)^T
        v_K = A^T v_B A + A^T v_c e^T,   v_e = K A^T v_c,   v_J = v_A R_c^T
        v_R = (v_K + v_K^T) R D,   v_D = R^T v_K R,   v_s_i = 2 s_i v_D_ii
        v_(a,b)_k = kappa (v_D + v_D^T)[:2, :2] (a, b)_k
        v_R_c = sum J^T v_A + v_y mu^T, and v_e on its third row
    """
    seen, eye = _seen(hulls, rows), with_principal_point(camera, conventions)
    x, J, A, R, RD, K, AK, inverse, h, focal, m = _steps(seen, eye, conventions)
    means, quats, scales, _ = seen.primitives
    R_c, _ = pose(eye, means.dtype)
    z, u = x[:, 2:], x[:, :2] / x[:, 2:]
    v_w, v_s = v_planes.planes[rows, :1].astype(np.float64), v_planes.planes[rows, 1:].astype(np.float64)
    v_n, length = v_planes.normals[rows].astype(np.float64), np.linalg.norm(m, axis=1, keepdims=True)
    n = -m / length
    v_m = -(v_n - n * np.sum(n * v_n, axis=1, keepdims=True)) / length
    v_s = v_s + focal * (v_m[:, :2] - u * v_m[:, 2:])
    v_u = focal * h / z * v_m[:, 2:]
    v_c = np.einsum("nij,nj->ni", inverse, -v_s / z)
    v_B = -v_c[:, :, None] * h[:, None]
    v_A = (v_B + np.swapaxes(v_B, 1, 2)) @ AK + v_c[:, :, None] * (K @ R_c[2])[:, None]
    A_v_c = np.einsum("nij,ni->nj", A, v_c)
    v_K = np.swapaxes(A, 1, 2) @ v_B @ A + A_v_c[:, :, None] * R_c[2]
    v_x = pinhole_jacobians_vjp(x, eye, *slope_limits(eye, conventions, means.dtype), v_A @ R_c.T)
    v_x[:, :2] += v_u / z
    v_x[:, 2] += np.sum(h * v_s / z**2 - v_u * u / z, axis=1) - v_w[:, 0] / z[:, 0] ** 2
    v_R = (v_K + np.swapaxes(v_K, 1, 2)) @ RD
    v_D = np.swapaxes(R, 1, 2) @ v_K @ R
    of_plane = KAPPA[seen.n_vertices, None, None] * (v_D + np.swapaxes(v_D, 1, 2))[:, :2, :2]
    v_ab = np.einsum("nij,nkj->nki", of_plane, place_vertices(seen.vertices, seen.n_vertices))
    v_R_c = np.einsum("nki,nkj->ij", J, v_A) + v_x.T @ means
    v_R_c[2] += np.sum(np.einsum("nij,nj->ni", K, A_v_c), axis=0)
    found = PlaneGradient(
        vertices=np.zeros_like(hulls.vertices),
        means=np.zeros_like(hulls.primitives.means),
        quats=np.zeros_like(hulls.primitives.quats),
        scales=np.zeros_like(hulls.primitives.scales),
        cam_from_world_R=v_R_c,
        cam_from_world_t=v_x.sum(axis=0),
    )
    found.vertices[rows] = place_vertices_vjp(seen.n_vertices, v_ab)
    found.means[rows], found.quats[rows] = v_x @ R_c, rotation_matrices_vjp(quats, v_R)
    found.scales[rows] = 2 * scales * np.diagonal(v_D, axis1=1, axis2=2)
    return found
