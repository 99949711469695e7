"""Stage 7, optional: the depth map that the Gaussians of a view add up to, and which way its surface faces.

The blended depth divided by the accumulated opacity is the mean depth of what a pixel shows. Its pixels, lifted to
points, make a surface whose normals are cross products of neighbouring differences, as in 2D Gaussian Splatting (Huang
et al. 2024). Left out: the depth of the first or of the middle hit, which is sharper at edges and has no derivative by
opacities.
"""

import numpy as np

from minisplat_ref.constants import DEPTH_ALPHA_MIN
from minisplat_ref.types import Bools, Camera, Floats


def expected_depth(accumulated_depth: Floats, alpha: Floats) -> Floats:
    """Mean depth of what a pixel shows: ``z = D / alpha`` with ``D = sum_g w_g z_g`` and ``alpha = sum_g w_g``.

    Parameters
    ----------
    accumulated_depth : ndarray of shape (H, W)
        D, the last channel of an image that was rendered with depth.
    alpha : ndarray of shape (H, W)
        Accumulated opacity.

    Returns
    -------
    ndarray of shape (H, W)
        Camera z, world units; 0 where nothing was hit.
    """
    is_hit = _is_hit(accumulated_depth, alpha)
    return np.where(is_hit, accumulated_depth / np.where(is_hit, alpha, 1), 0)


def expected_depth_vjp(accumulated_depth: Floats, alpha: Floats, v_depth: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`expected_depth`.

    ::

        v_D = v_z / alpha,  v_alpha = -v_z z / alpha           0 where nothing was hit

    Parameters
    ----------
    accumulated_depth, alpha
        As for the forward function.
    v_depth : ndarray of shape (H, W)
        Derivative by the depth.

    Returns
    -------
    v_accumulated_depth : ndarray of shape (H, W)
        Derivative by ``accumulated_depth``.
    v_alpha : ndarray of shape (H, W)
        Derivative by ``alpha``.
    """
    is_hit = _is_hit(accumulated_depth, alpha)
    v_accumulated_depth = np.where(is_hit, v_depth / np.where(is_hit, alpha, 1), 0)
    return v_accumulated_depth, -v_accumulated_depth * expected_depth(accumulated_depth, alpha)


def depth_normals(depth: Floats, camera: Camera) -> Floats:
    """Unit normals of the surface through a depth map's points ``X = z r``, r = ((x - cx) / fx, (y - cy) / fy, 1).

    From a pixel's point, its right neighbour's and its lower neighbour's::

        N = (X_down - X) x (X_right - X),   n = N / |N|

    Parameters
    ----------
    depth : ndarray of shape (H, W)
        Camera z; 0 for none.
    camera : Camera
        Its intrinsics.

    Returns
    -------
    ndarray of shape (H - 1, W - 1, 3)
        Camera frame, towards the camera; 0 where one of the three pixels has no depth.
    """
    _, _, N, exists = _cross_products(depth, camera)
    return np.where(exists, N, 0) / np.where(exists, np.linalg.norm(N, axis=2, keepdims=True), 1)


def depth_normals_vjp(depth: Floats, camera: Camera, v_normals: Floats) -> Floats:
    """Gradient of :func:`depth_normals`.

    With ``a = X_down - X`` and ``b = X_right - X``::

        v_N = (v_n - (n . v_n) n) / |N|                        0 where there is no normal
        v_a = b x v_N,  v_b = v_N x a
        v_X = sums of v_a, v_b and -(v_a + v_b) over the normals that a point has a part in
        v_z = r . v_X

    Parameters
    ----------
    depth, camera
        As for the forward function.
    v_normals : ndarray of shape (H - 1, W - 1, 3)
        Derivative by the normals.

    Returns
    -------
    ndarray of shape (H, W)
        Derivative by the depth.
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


def _is_hit(accumulated_depth: Floats, alpha: Floats) -> Bools:
    return (alpha > DEPTH_ALPHA_MIN) & (accumulated_depth > 0)


def _rays(camera: Camera, depth: Floats) -> Floats:
    """Camera-frame directions [H, W, 3] of the pixel centres, with z equal to 1."""
    height, width = depth.shape
    slopes_x = (np.arange(width) + 0.5 - camera.cx) / camera.fx
    slopes_y = (np.arange(height) + 0.5 - camera.cy) / camera.fy
    s, t = np.meshgrid(slopes_x, slopes_y)
    return np.stack([s, t, np.ones_like(s)], axis=2).astype(depth.dtype)


def _cross_products(depth: Floats, camera: Camera) -> tuple[Floats, Floats, Floats, Bools]:
    """Return a, b and N [H - 1, W - 1, 3] and whether all three pixels have a depth [H - 1, W - 1, 1].

    N is not zero then: three rays through different pixels are linearly independent.
    """
    points = depth[:, :, None] * _rays(camera, depth)
    a, b = points[1:, :-1] - points[:-1, :-1], points[:-1, 1:] - points[:-1, :-1]
    exists = (depth[:-1, :-1] > 0) & (depth[1:, :-1] > 0) & (depth[:-1, 1:] > 0)
    return a, b, np.cross(a, b), exists[:, :, None]
