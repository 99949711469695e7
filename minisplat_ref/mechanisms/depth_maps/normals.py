"""Normals of the surface that a depth map shows, by central differences, as 2D Gaussian Splatting and gsplat take them.

The pixels of the border lack a neighbour and have no normal. Left out: any test whether two neighbours belong to one
surface; a step between two surfaces gets a normal that neither has.
"""

import numpy as np

from minisplat_ref.reference.pinhole import pinhole_rays
from minisplat_ref.types import Camera, Floats

LENGTH_MIN = 1e-12  # of a cross product, as torch's normalize has it: below, the normal is shorter than one


def central_normals(depth: Floats, camera: Camera) -> Floats:
    """Return the normals of the surface through a depth map's points ``X = z r``, r = ((x - cx)/fx, (y - cy)/fy, 1).

    ::

        a = X_down - X_up,   b = X_right - X_left,   N = a x b,   n = N / max(|N|, 1e-12)

    Parameters
    ----------
    depth : ndarray of shape (H, W)
        Camera z, world units.
    camera : Camera
        Its intrinsics are used.

    Returns
    -------
    ndarray of shape (H, W, 3)
        Unit vectors of the camera frame towards the camera; 0 on the border, and where N is.
    """
    _, _, N, length = _cross_products(depth, camera)
    normals = np.zeros((*depth.shape, 3), depth.dtype)
    normals[1:-1, 1:-1] = N / length
    return normals


def central_normals_vjp(depth: Floats, camera: Camera, v_normals: Floats) -> Floats:
    """Gradient [H, W] of :func:`central_normals` with respect to the depth.

    ::

        v_N = (v_n - (n . v_n) n) / |N|
        v_a = b x v_N,  v_b = v_N x a
        v_X = sums of +-v_a and +-v_b over the normals that depend on a point,   v_z = r . v_X
    """
    a, b, N, length = _cross_products(depth, camera)
    v, n = v_normals[1:-1, 1:-1], N / length
    v_N = np.where(length > LENGTH_MIN, v - np.sum(n * v, axis=2, keepdims=True) * n, v) / length
    v_a, v_b = np.cross(b, v_N), np.cross(v_N, a)
    rays = _rays(depth, camera)
    v_X = np.zeros_like(rays)
    v_X[2:, 1:-1] += v_a
    v_X[:-2, 1:-1] -= v_a
    v_X[1:-1, 2:] += v_b
    v_X[1:-1, :-2] -= v_b
    return np.sum(rays * v_X, axis=2)


def _rays(depth: Floats, camera: Camera) -> Floats:
    height, width = depth.shape
    return pinhole_rays(np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5, camera).astype(depth.dtype)


def _cross_products(depth: Floats, camera: Camera) -> tuple[Floats, Floats, Floats, Floats]:
    """Return a, b and N [H - 2, W - 2, 3], and the length [H - 2, W - 2, 1] to divide N by."""
    X = depth[:, :, None] * _rays(depth, camera)
    a, b = X[2:, 1:-1] - X[:-2, 1:-1], X[1:-1, 2:] - X[1:-1, :-2]
    N = np.cross(a, b)
    return a, b, N, np.maximum(np.linalg.norm(N, axis=2, keepdims=True), LENGTH_MIN)
