"""The unscented transform: mean and covariance of a Gaussian in the image of any camera (3DGUT, arXiv 2412.12507).

Seven sigma points, the mean and two on each principal axis, are projected; nothing is differentiated. With n = 3,
``lambda = alpha^2 (n + kappa) - n`` and the standard deviations s_k along the axes a_k::

    x_0 = mu,   x_k = mu +- sqrt(n + lambda) s_k a_k
    w_0 = lambda / (n + lambda),   w_k = 1 / (2 (n + lambda));   for the covariance w_0 + 1 - alpha^2 + beta

Here alpha = 0.1, beta = 2, kappa = 0, as there. The result only bounds a footprint; rendering does not use it.
"""

import numpy as np

from minisplat_ref.mechanisms.cameras.models import CameraModel
from minisplat_ref.types import Bools, Camera, Floats

ALPHA, BETA, KAPPA = 0.1, 2.0, 0.0
N = 3
LAMBDA = ALPHA**2 * (N + KAPPA) - N
SPREAD = float(np.sqrt(N + LAMBDA))
MEAN_WEIGHTS = np.array([LAMBDA / (N + LAMBDA)] + 2 * N * [1 / (2 * (N + LAMBDA))])
COVARIANCE_WEIGHTS = MEAN_WEIGHTS + np.array([1 - ALPHA**2 + BETA] + 2 * N * [0.0])


def sigma_points(x: Floats, axes: Floats) -> Floats:
    """Return the sigma points [N, 7, 3] of Gaussians.

    Parameters
    ----------
    x : ndarray of shape (N, 3)
        Means.
    axes : ndarray of shape (N, 3, 3)
        Principal axes as columns, as long as the standard deviations.
    """
    steps = SPREAD * np.swapaxes(axes, 1, 2)
    return np.concatenate([x[:, None], x[:, None] + steps, x[:, None] - steps], axis=1)


def unscented(x: Floats, axes: Floats, model: CameraModel, camera: Camera) -> tuple[Floats, Floats, Bools]:
    """Return means [N, 2] and covariances [N, 2, 2] in the image, pixels, and whether all sigma points are seen [N].

    Parameters
    ----------
    x, axes
        As for :func:`sigma_points`, camera frame.
    model : CameraModel
        That of ``camera``.
    camera : Camera
        The view; its pose is not used.
    """
    points = sigma_points(x, axes).reshape(-1, 3)
    is_seen = np.asarray(model.is_seen(points, camera).reshape(-1, 2 * N + 1).all(axis=1))
    pixels = model.project(points, camera).reshape(-1, 2 * N + 1, 2)
    # The weights are up to 99 and add up to one, so offsets from the centre's pixel lose fewer digits.
    offsets = pixels - pixels[:, :1]
    shifts = np.einsum("k,nki->ni", MEAN_WEIGHTS, offsets)
    around = offsets - shifts[:, None]
    covariances = np.einsum("k,nki,nkj->nij", COVARIANCE_WEIGHTS, around, around)
    return pixels[:, 0] + shifts, covariances, is_seen
