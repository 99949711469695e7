"""Signed distances: the opacity that follows from one, and where a surfel's centre is projected onto the surface.

gamma is held as ``omega = ln(1 / gamma)``, the logarithm of a length, so that it stays above 0 whatever Adam does.
"""

import numpy as np

from minisplat_ref.reference.covariance import rotation_matrices, rotation_matrices_vjp
from minisplat_ref.types import Floats

X_MIN = 1e-30  # of |x|: at a distance of 0 the logit has no value; there the opacity is 1 long before
HALF = np.log(3 + 2 * np.sqrt(2))  # 1.7627: gamma |s| at which the opacity is one half


def opacity_logits(distances: Floats, log_width: Floats) -> Floats:
    """Return the logits of ``o = sech^2 x``, ``x = gamma s / 2``.

    ::

        l = ln(o / (1 - o)) = ln(sech^2 x / tanh^2 x) = -2 ln sinh |x| = -2 (|x| + ln(1 - exp(-2 |x|)) - ln 2)

    Parameters
    ----------
    distances : ndarray of shape (N,)
        s, world units.
    log_width : ndarray of shape (1,)
        omega.
    """
    x = np.abs(_x(distances, log_width))
    logits: Floats = -2 * (x + np.log(-np.expm1(-2 * x)) - distances.dtype.type(np.log(2)))
    return logits


def opacity_logits_vjp(distances: Floats, log_width: Floats, v_logits: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`opacity_logits` with respect to distances [N] and log_width [1].

    ::

        dl/dx = -2 coth x,   dx/ds = gamma / 2,   dx/domega = -x
        v_s = -gamma coth(x) v_l,   v_omega = sum 2 x coth(x) v_l
    """
    x = _x(distances, log_width)
    coth = 1 / np.tanh(x)
    v_distances = -np.exp(-log_width.astype(x.dtype)) * coth * v_logits
    return v_distances, np.sum(2 * x * coth * v_logits, keepdims=True)


def _x(distances: Floats, log_width: Floats) -> Floats:
    """Return ``gamma s / 2``, away from 0."""
    x = distances * np.exp(-log_width.astype(distances.dtype)) / 2
    return np.where(np.abs(x) < X_MIN, x.dtype.type(X_MIN), x)


def reference_sharpness(distances: Floats) -> float:
    """Return the gamma at which the opacity of the median of ``|s|`` is one half; infinite if that is 0."""
    median = float(np.median(np.abs(distances))) if len(distances) else 0.0
    return HALF / median if median > 0 else np.inf


def projected(means: Floats, quats: Floats, distances: Floats) -> Floats:
    """Return the centres on the surface, ``x_0 = mu - s n``; n is the third axis of the surfel, [N, 3]."""
    return means - distances[:, None] * rotation_matrices(quats)[:, :, 2]


def projected_vjp(quats: Floats, distances: Floats, v_points: Floats) -> tuple[Floats, Floats, Floats]:
    """Gradient of :func:`projected` with respect to means, quats and distances.

    ::

        v_mu = v_x0,   v_s = -n . v_x0,   v_n = -s v_x0, and on through the third column of the rotation
    """
    R = rotation_matrices(quats)
    v_R = np.zeros_like(R)
    v_R[:, :, 2] = -distances[:, None] * v_points
    return v_points, rotation_matrices_vjp(quats, v_R), -np.sum(R[:, :, 2] * v_points, axis=1)
