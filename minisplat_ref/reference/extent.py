"""Stage 2c: the extent of a projected Gaussian, as a box of pixels. Nothing here has a gradient.

The conventions choose one of two rules. Full support (gsplat, Mini-Splatting2): the box holds every pixel whose alpha
reaches ``alpha_min``, solved from ``opacity exp(-r^2 / 2) = alpha_min``. INRIA's (the 3DGS code): all 16-pixel tiles
that the square of half-side 3 sigma touches, whatever the opacity.
"""

import numpy as np

from minisplat_ref.constants import INRIA_ROOT_MIN, INRIA_TILE, RADIUS_MAX, Conventions
from minisplat_ref.types import Camera, Floats


def extents(
    means2d: Floats, covariances2d: Floats, opacities: Floats, camera: Camera, conventions: Conventions
) -> tuple[Floats, Floats]:
    """Return half-extents and boxes of projected Gaussians, as whole numbers in floating point.

    A row with non-finite input is meaningless, as is one whose opacity is below ``alpha_min``; the caller culls it.

    Parameters
    ----------
    means2d : ndarray of shape (N, 2)
        Pixels.
    covariances2d : ndarray of shape (N, 2, 2)
        With the low-pass, px^2.
    opacities : ndarray of shape (N,)
        With the antialiasing compensation, if any.
    camera : Camera
        Gives the size of the image.
    conventions : Conventions
        ``has_full_support`` chooses the rule.

    Returns
    -------
    radii : ndarray of shape (N, 2)
        Half-extents along x and y, pixels.
    boxes : ndarray of shape (N, 4)
        Half-open x0, y0, x1, y1, clipped to the image; empty when ``x1 <= x0`` or ``y1 <= y0``.
    """
    rule = _full_support if conventions.has_full_support else _three_sigma_tiles
    radii, low, high = rule(means2d, covariances2d, opacities, conventions.alpha_min)
    size = np.array([camera.width, camera.height], dtype=means2d.dtype)
    return np.minimum(radii, RADIUS_MAX), np.hstack([np.clip(low, 0, size), np.clip(high, 0, size)])


def _full_support(
    means2d: Floats, covariances2d: Floats, opacities: Floats, alpha_min: float
) -> tuple[Floats, Floats, Floats]:
    """Bound the ellipse ``d^T conic d = e^2`` tightly: half-sides ``e sqrt(cov_xx)`` and ``e sqrt(cov_yy)``."""
    e = np.sqrt(2 * np.log(np.maximum(opacities / alpha_min, 1)))  # [N] sigmas
    variances = np.diagonal(covariances2d, axis1=1, axis2=2)  # [N, 2]
    radii = np.ceil(e[:, None] * np.sqrt(variances))
    return radii, np.floor(means2d - radii), np.ceil(means2d + radii)


def _three_sigma_tiles(
    means2d: Floats, covariances2d: Floats, opacities: Floats, alpha_min: float
) -> tuple[Floats, Floats, Floats]:
    """Apply INRIA's rule; its pixel centres are whole numbers, ours are at + 0.5."""
    mid = np.trace(covariances2d, axis1=1, axis2=2) / 2  # [N]
    det = covariances2d[:, 0, 0] * covariances2d[:, 1, 1] - covariances2d[:, 0, 1] * covariances2d[:, 1, 0]
    lambda_max = mid + np.sqrt(np.maximum(INRIA_ROOT_MIN, mid * mid - det))
    radii = np.repeat(np.ceil(3 * np.sqrt(lambda_max))[:, None], 2, axis=1)  # [N, 2]
    low = np.floor((means2d - 0.5 - radii) / INRIA_TILE) * INRIA_TILE
    high = np.floor((means2d - 0.5 + radii + INRIA_TILE - 1) / INRIA_TILE) * INRIA_TILE
    return radii, low, high
