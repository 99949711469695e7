"""Maps before and after tracing, beside their gradients: Gaussians to unit balls, and pixels to rays.

Both backends share them, since they take one step per Gaussian or per pixel and no loop over pairs.
"""

import functools

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.extensions.rays.types import Rays, Whitened
from minisplat_ref.reference.covariance import rotation_matrices, rotation_matrices_vjp
from minisplat_ref.reference.pinhole import pinhole_rays, with_principal_point
from minisplat_ref.types import Bools, Camera, Floats, Ints


def whiten(means: Floats, quats: Floats, log_scales: Floats, opacities: Floats) -> Whitened:
    """Return the maps ``M = diag(1/s) R^T`` of Gaussians, in float64.

    Parameters
    ----------
    means : ndarray of shape (N, 3)
        World frame.
    quats : ndarray of shape (N, 4)
        Quaternions wxyz of any length.
    log_scales : ndarray of shape (N, 3)
        Logarithms of the standard deviations, world units.
    opacities : ndarray of shape (N,)
        Activated opacities, from 0 to 1.
    """
    R = rotation_matrices(quats.astype(np.float64))
    with np.errstate(over="ignore", invalid="ignore"):
        maps = np.exp(-log_scales.astype(np.float64))[:, :, None] * np.swapaxes(R, 1, 2)
    return Whitened(means.astype(np.float64), maps, opacities.astype(np.float64))


def whiten_vjp(quats: Floats, log_scales: Floats, gaussians: Whitened, v_maps: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`whiten`: ``M_ij = R_ji / s_i``, so ``v_R_ji = v_M_ij / s_i``, ``v_log_s_i = -M_i . v_M_i``.

    Parameters
    ----------
    quats, log_scales
        As for :func:`whiten`.
    gaussians : Whitened
        The result of :func:`whiten`.
    v_maps : ndarray of shape (N, 3, 3)
        Derivative with respect to the maps.

    Returns
    -------
    v_quats : ndarray of shape (N, 4)
    v_log_scales : ndarray of shape (N, 3)
    """
    is_met: Bools = np.any(v_maps, axis=(1, 2))  # the others may have no finite map
    maps = np.where(is_met[:, None, None], gaussians.maps, 0.0)
    inverse_scales = np.exp(-np.where(is_met[:, None], log_scales, 0.0).astype(np.float64))
    v_R = np.swapaxes(inverse_scales[:, :, None] * v_maps, 1, 2)
    return rotation_matrices_vjp(quats.astype(np.float64), v_R), -np.sum(maps * v_maps, axis=2)


def pixel_rays(camera: Camera, conventions: Conventions) -> Rays:
    """Return the rays [H W] through the centres of all pixels, row by row, with directions whose camera z is 1.

    So t is the camera z of a point on the ray, and the near and far planes of ``conventions`` bound it.
    """
    camera = with_principal_point(camera, conventions).astype(np.float64)
    directions = _camera_rays(camera) @ camera.cam_from_world_R
    origins = np.broadcast_to(camera.center, directions.shape)
    limits = (np.full(len(directions), plane) for plane in (conventions.near_plane, conventions.far_plane))
    return Rays(np.ascontiguousarray(origins), directions, *limits)


@functools.cache
def block_order(width: int, height: int) -> Ints:
    """Return the pixels [H W] in blocks of 4 x 2, since eight rays that traverse a tree together should be adjacent."""
    ys, xs = np.divmod(np.arange(width * height), width)
    return np.lexsort((xs, ys, xs // 4, ys // 2))


def pixel_rays_vjp(
    camera: Camera, conventions: Conventions, v_origins: Floats, v_directions: Floats
) -> tuple[Floats, Floats]:
    """Gradient of :func:`pixel_rays`.

    With ``d = R^T r`` and ``O = -R^T t``::

        v_R = sum_p r_p v_d_p^T - t v_O^T,   v_t = -R v_O,   v_O = sum_p v_O_p

    Parameters
    ----------
    camera, conventions
        As for :func:`pixel_rays`.
    v_origins, v_directions : ndarray of shape (P, 3)
        Derivatives with respect to the rays.

    Returns
    -------
    v_R : ndarray of shape (3, 3)
    v_t : ndarray of shape (3,)
    """
    camera = with_principal_point(camera, conventions).astype(np.float64)
    R, t = camera.cam_from_world_R, camera.cam_from_world_t
    v_O = v_origins.sum(axis=0)
    v_R = np.einsum("pi,pj->ij", _camera_rays(camera), v_directions) - np.outer(t, v_O)
    return v_R, -R @ v_O


def _camera_rays(camera: Camera) -> Floats:
    """Return the directions [H W, 3] in the camera frame."""
    ys, xs = np.mgrid[: camera.height, : camera.width] + 0.5
    return pinhole_rays(xs, ys, camera).reshape(-1, 3)
