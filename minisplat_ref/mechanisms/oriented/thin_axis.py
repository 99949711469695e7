"""The normal of a primitive: the shortest axis of a Gaussian, the third axis of a surfel.

    n = R(q) e_a,   a = argmin_j log s_j; for a population with two scales a = 2

Its sign is open; losses take the absolute value of a cosine. The choice of the shortest axis is constant in the
gradient, as it is almost everywhere.
"""

from typing import Any

import numpy as np

from minisplat_ref.reference.covariance import rotation_matrices, rotation_matrices_vjp
from minisplat_ref.types import Floats, Ints

THIRD = 2


def thin_axes(population: Any) -> Ints:
    """Return which axis [N] of each primitive is its normal; a population has ``log_scales`` [N, 3] or [N, 2]."""
    log_scales = population.log_scales
    if log_scales.shape[1] == THIRD:
        return np.full(len(log_scales), THIRD)
    return np.argmin(log_scales, axis=1)


def normals_of(population: Any) -> Floats:
    """Return the unit normals [N, 3], world frame, of a population that has ``quats`` and ``log_scales``."""
    return rotation_matrices(population.quats)[np.arange(len(population.quats)), :, thin_axes(population)]


def normals_of_vjp(population: Any, v_normals: Floats) -> Floats:
    """Gradient [N, 4] of :func:`normals_of` with respect to the quaternions: ``v_R = v_n e_a^T``."""
    v_R = np.zeros((*v_normals.shape, 3), v_normals.dtype)
    v_R[np.arange(len(v_normals)), :, thin_axes(population)] = v_normals
    return rotation_matrices_vjp(population.quats, v_R)


def angles_between(normals: Floats, truth: Floats) -> Floats:
    """Return the angles [...] between unit normals [..., 3] in degrees, without regard to their sign."""
    return np.degrees(np.arccos(np.minimum(np.abs(np.sum(normals * truth, axis=-1)), 1)))
