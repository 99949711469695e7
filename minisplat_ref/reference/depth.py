"""Stage 6: the depth of a pixel: the mean over its hits, or the point where its ray meets the dominant Gaussian.

The blended depth divided by the accumulated opacity is the mean depth of the hits. Where a ray passes through several
surfaces, this mean lies on none of them. Mini-Splatting appendix D takes one surface instead. Along the ray ``x(t) = o
+ t d`` a Gaussian is densest where ``(x - mu)^T Sigma^-1 (x - mu)`` is smallest::

    t = (mu - o)^T Sigma^-1 d / (d^T Sigma^-1 d)

This is also the middle of the chord through the ellipsoid at any number of sigmas, so no size has to be chosen. The
direction has camera z equal to 1, so that t is the depth. Left out: lens effects; a test whether the ray hits the
ellipsoid at all (Mini-Splatting has none either). The median depth, which is sharper at edges but has no derivative
with respect to opacities, comes from compositing.
"""

import numpy as np

from minisplat_ref.constants import DEPTH_ALPHA_MIN
from minisplat_ref.reference.covariance import rotation_matrices, rotation_matrices_vjp
from minisplat_ref.reference.pinhole import pinhole_rays
from minisplat_ref.types import Bools, Camera, Floats, Ints, SurfacePoints


def expected_depth(accumulated_depth: Floats, alpha: Floats) -> Floats:
    """Return the mean depth of a pixel's hits: ``z = D / alpha`` with ``D = sum_g w_g z_g`` and ``alpha = sum_g w_g``.

    gsplat divides by ``max(alpha, 1e-10)``, which is the same: the alpha of a pixel that was hit is at least alpha_min.

    Parameters
    ----------
    accumulated_depth : ndarray of shape (..., H, W)
        D, the last channel of an image that was rendered with depth.
    alpha : ndarray of shape (..., H, W)
        Accumulated opacity.

    Returns
    -------
    ndarray of shape (..., H, W)
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
    v_depth : ndarray of shape (..., H, W)
        Derivative with respect to the depth.

    Returns
    -------
    v_accumulated_depth : ndarray of shape (..., H, W)
        Derivative with respect to ``accumulated_depth``.
    v_alpha : ndarray of shape (..., H, W)
        Derivative with respect to ``alpha``.
    """
    is_hit = _is_hit(accumulated_depth, alpha)
    v_accumulated_depth = np.where(is_hit, v_depth / np.where(is_hit, alpha, 1), 0)
    return v_accumulated_depth, -v_accumulated_depth * expected_depth(accumulated_depth, alpha)


def surface_points(means: Floats, quats: Floats, scales: Floats, camera: Camera, dominant_ids: Ints) -> SurfacePoints:
    """Return the point on each pixel's ray at which the pixel's dominant Gaussian is densest.

    With the whitening ``W = diag(1 / s) R^T``, for which ``Sigma^-1 = W^T W``::

        a = W (mu - o),  b = W d,  t = (a . b) / (b . b)

    Parameters
    ----------
    means : ndarray of shape (N, 3)
        World frame.
    quats : ndarray of shape (N, 4)
        wxyz, any length.
    scales : ndarray of shape (N, 3)
        Standard deviations, world units.
    camera : Camera
        The view; its principal point is used.
    dominant_ids : ndarray of shape (H, W)
        Gaussian of each pixel, -1 for none: :attr:`minisplat_ref.types.BlendStats.dominant_ids`.

    Returns
    -------
    SurfacePoints
        Zeros where there is no Gaussian or ``t <= 0``.
    """
    ys, xs = np.nonzero(dominant_ids >= 0)
    origin, d, a, b, _ = _whiten(means, quats, scales, camera, dominant_ids[ys, xs], ys, xs)
    t = np.einsum("pi,pi->p", a, b) / np.einsum("pi,pi->p", b, b)  # [P]
    is_in_front = t > 0
    points = np.zeros((*dominant_ids.shape, 3), dtype=means.dtype)
    depths = np.zeros(dominant_ids.shape, dtype=means.dtype)
    points[ys, xs] = np.where(is_in_front[:, None], origin + t[:, None] * d, 0)
    depths[ys, xs] = np.where(is_in_front, t, 0)
    return SurfacePoints(points, depths)


def surface_points_vjp(
    means: Floats,
    quats: Floats,
    scales: Floats,
    camera: Camera,
    dominant_ids: Ints,
    v_points: Floats,
    v_depths: Floats,
) -> tuple[Floats, Floats, Floats]:
    """Gradient of :func:`surface_points` with respect to the Gaussians.

    ::

        v_t = d . v_point + v_depth                            0 where t <= 0
        v_a = v_t b / (b . b),  v_b = v_t (a - 2 t b) / (b . b)
        v_mu = W^T v_a
        v_W = v_a (mu - o)^T + v_b d^T                         summed over the Gaussian's pixels
        v_R_jk = (v_W)_kj / s_k,  v_s_k = -sum_j (v_W)_kj W_kj / s_k

    Parameters
    ----------
    means, quats, scales, camera, dominant_ids
        As for :func:`surface_points`.
    v_points : ndarray of shape (H, W, 3)
        Derivative with respect to the points.
    v_depths : ndarray of shape (H, W)
        Derivative with respect to the depths.

    Returns
    -------
    v_means : ndarray of shape (N, 3)
        Derivative with respect to ``means``.
    v_quats : ndarray of shape (N, 4)
        Derivative with respect to ``quats``.
    v_scales : ndarray of shape (N, 3)
        Derivative with respect to ``scales``.
    """
    ys, xs = np.nonzero(dominant_ids >= 0)
    ids = dominant_ids[ys, xs]
    origin, d, a, b, W = _whiten(means, quats, scales, camera, ids, ys, xs)
    b_dot_b = np.einsum("pi,pi->p", b, b)
    t = np.einsum("pi,pi->p", a, b) / b_dot_b

    v_t = np.where(t > 0, np.einsum("pi,pi->p", d, v_points[ys, xs]) + v_depths[ys, xs], 0)
    v_a = (v_t / b_dot_b)[:, None] * b  # [P, 3]
    v_b = (v_t / b_dot_b)[:, None] * (a - 2 * t[:, None] * b)
    v_means, v_W = np.zeros_like(means), np.zeros_like(W)
    np.add.at(v_means, ids, np.einsum("pki,pk->pi", W[ids], v_a))
    np.add.at(v_W, ids, np.einsum("pk,pj->pkj", v_a, means[ids] - origin) + np.einsum("pk,pj->pkj", v_b, d))

    v_R = np.swapaxes(v_W / scales[:, :, None], 1, 2)
    v_scales = -np.einsum("nkj,nkj->nk", v_W, W) / scales
    return v_means, rotation_matrices_vjp(quats, v_R), v_scales


def _is_hit(accumulated_depth: Floats, alpha: Floats) -> Bools:
    return (alpha > DEPTH_ALPHA_MIN) & (accumulated_depth > 0)


def _whiten(
    means: Floats, quats: Floats, scales: Floats, camera: Camera, ids: Ints, ys: Ints, xs: Ints
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return o [3], and d, a, b [P, 3] of the pixels' rays, and W [N, 3, 3]."""
    camera = camera.astype(means.dtype)
    origin = camera.center
    d = pinhole_rays(xs + 0.5, ys + 0.5, camera).astype(means.dtype) @ camera.cam_from_world_R  # rows of R^T r
    W = np.swapaxes(rotation_matrices(quats), 1, 2) / scales[:, :, None]
    a = np.einsum("pki,pi->pk", W[ids], means[ids] - origin)
    b = np.einsum("pki,pi->pk", W[ids], d)
    return origin, d, a, b, W
