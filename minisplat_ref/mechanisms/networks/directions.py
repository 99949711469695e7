"""The direction from which a camera sees a point, as input of a network, and its gradient.

It is in NumPy alone: a few operations per point are negligible compared with a network, which has kernels.
"""

import numpy as np

from minisplat_ref.reference.pinhole import pose
from minisplat_ref.types import Camera, Floats


def directions(means: Floats, camera: Camera) -> tuple[Floats, Floats]:
    """Return ``d = r / |r|`` [N, 3] with ``r = mu - o = mu + R^T t``, and the distances |r| [N, 1], world frame."""
    R, t = pose(camera, means.dtype)
    r = means + t @ R
    distances = np.maximum(np.linalg.norm(r, axis=1, keepdims=True), means.dtype.type(np.finfo(np.float32).tiny))
    return r / distances, distances


def directions_vjp(d: Floats, distances: Floats, camera: Camera, v_d: Floats) -> tuple[Floats, Floats, Floats]:
    """Gradient of :func:`directions` with respect to the means [N, 3], R [3, 3] and t [3].

    ::

        v_mu = v_r = (v_d - d (d . v_d)) / |r|,   v_o = -sum_n v_r
        v_R  = -t v_o^T,   v_t = -R v_o                      (o = -R^T t)
    """
    v_r = (v_d - d * np.sum(d * v_d, axis=1, keepdims=True)) / distances
    v_o = -v_r.sum(axis=0)
    R, t = pose(camera, d.dtype)
    return v_r, -np.outer(t, v_o), -R @ v_o
