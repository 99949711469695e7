"""The plane on which a primitive shows its surface, in NumPy, with the gradient: its depth at every pixel, its normal.

The paper trains with the losses of 2D Gaussian Splatting, which need a depth at each pixel and a normal. There a ray
meets a disc. Here a primitive has an ellipse in the image and, if its deviations are similar, no disc, so the plane is
that of the best linear prediction of depth from image position over the primitive. With the covariance K of
its points in the world and h the prediction's slope::

    K = R (diag(s^2) + kappa sum_k (a, b)_k (a, b)_k^T) R^T,   kappa = 1/6 of a line, 1/12 of a triangle
    c = cov(image, z) = A K e,   B = A K A^T + eps I,   h = B^-1 c,   A = J R_c,   e the camera's axis, R_c^T (0, 0, 1)
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
from minisplat_ref.extensions.mixed.projection import Hulls, in_plane, in_plane_vjp
from minisplat_ref.reference.antialiasing import adjugates, determinants
from minisplat_ref.reference.covariance import rotation_matrices, rotation_matrices_vjp
from minisplat_ref.reference.pinhole import (
    pinhole_jacobians,
    pinhole_jacobians_vjp,
    pose,
    slope_limits,
    with_principal_point,
)
from minisplat_ref.types import Camera, Floats, Primitives

KAPPA = np.array([0.0, 0.0, 1 / 6, 1 / 12])  # by the number of vertices


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
    ab = in_plane(hulls.vertices, hulls.n_vertices)  # [N, 3, 2]
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


def planes_of(hulls: Hulls, rows: np.ndarray, camera: Camera, conventions: Conventions) -> Planes:
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
    """Gradient of :func:`planes_of`.

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
    v_ab = np.einsum("nij,nkj->nki", of_plane, in_plane(seen.vertices, seen.n_vertices))
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
    found.vertices[rows] = in_plane_vjp(seen.n_vertices, v_ab)
    found.means[rows], found.quats[rows] = v_x @ R_c, rotation_matrices_vjp(quats, v_R)
    found.scales[rows] = 2 * scales * np.diagonal(v_D, axis1=1, axis2=2)
    return found
