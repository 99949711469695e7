"""Stage 7, optional: normals of the surface that the depth map of a view shows.

The pixels of a depth map, lifted to points, form a surface whose normals are cross products of neighbouring
differences, as in 2D Gaussian Splatting (Huang et al. 2024). The last row and column of pixels lack a neighbour and
have no normal.
"""

import numpy as np

from minisplat_ref.reference.pinhole import pinhole_rays
from minisplat_ref.types import Bools, Camera, Floats


def depth_normals(depth: Floats, camera: Camera) -> Floats:
    """Return unit normals of the surface through a depth map's points ``X = z r``, r = ((x - cx)/fx, (y - cy)/fy, 1).

    A normal follows from the points of a pixel, of its right neighbour and of its lower neighbour::

        N = (X_down - X) x (X_right - X),   n = N / |N|

    Parameters
    ----------
    depth : ndarray of shape (H, W)
        Camera z, world units; 0 where there is no depth.
    camera : Camera
        Its intrinsics are used.

    Returns
    -------
    ndarray of shape (H - 1, W - 1, 3)
        Unit vectors of the camera frame that point towards the camera; 0 where one of the three pixels has no depth.
    """
    _, _, N, exists = _cross_products(depth, camera)
    return np.where(exists, N, 0) / np.where(exists, np.linalg.norm(N, axis=2, keepdims=True), 1)


def depth_normals_vjp(depth: Floats, camera: Camera, v_normals: Floats) -> Floats:
    """Gradient of :func:`depth_normals`.

    With ``a = X_down - X`` and ``b = X_right - X``::

        v_N = (v_n - (n . v_n) n) / |N|                        0 where there is no normal
        v_a = b x v_N,  v_b = v_N x a
        v_X = sums of v_a, v_b and -(v_a + v_b) over the normals that depend on a point
        v_z = r . v_X

    Parameters
    ----------
    depth, camera
        As for the forward function.
    v_normals : ndarray of shape (H - 1, W - 1, 3)
        Derivative with respect to the normals.

    Returns
    -------
    ndarray of shape (H, W)
        Derivative with respect to the depth.
    """
    a, b, N, exists = _cross_products(depth, camera)
    length = np.where(exists, np.linalg.norm(N, axis=2, keepdims=True), 1)
    n = N / length
    along = np.sum(n * v_normals, axis=2, keepdims=True)
    v_N = np.where(exists, (v_normals - along * n) / length, 0)
    v_a, v_b = np.cross(b, v_N), np.cross(v_N, a)
    rays = _rays(camera, depth)
    v_points = np.zeros_like(rays)
    v_points[:-1, :-1] -= v_a + v_b
    v_points[1:, :-1] += v_a
    v_points[:-1, 1:] += v_b
    return np.sum(rays * v_points, axis=2)


def _rays(camera: Camera, depth: Floats) -> Floats:
    """Return the camera-frame directions r [H, W, 3] of the pixel centres, whose z is 1."""
    height, width = depth.shape
    return pinhole_rays(np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5, camera).astype(depth.dtype)


def _cross_products(depth: Floats, camera: Camera) -> tuple[Floats, Floats, Floats, Bools]:
    """Return a, b and N [H - 1, W - 1, 3], and whether all three pixels have a depth [H - 1, W - 1, 1].

    Where they have one, N is not zero, because three rays through different pixels are linearly independent.
    """
    points = depth[:, :, None] * _rays(camera, depth)
    a, b = points[1:, :-1] - points[:-1, :-1], points[:-1, 1:] - points[:-1, :-1]
    exists = (depth[:-1, :-1] > 0) & (depth[1:, :-1] > 0) & (depth[:-1, 1:] > 0)
    return a, b, np.cross(a, b), exists[:, :, None]
