"""Gaussians before they are traced, as maps to the unit ball, beside the gradient.

Both backends use these: they are of the size of the population, and no loop over intersections.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.reference.covariance import rotation_matrices, rotation_matrices_vjp
from minisplat_ref.types import Bools, Floats


class Whitened(NamedTuple):
    """Gaussians with the maps that take them to the unit ball."""

    means: Floats
    """[N, 3] world frame."""
    maps: Floats
    """[N, 3, 3] ``M = diag(1/s) R^T``; not finite where a Gaussian cannot be rendered."""
    opacities: Floats
    """[N] in [0, 1]."""


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
