"""Alpha blending of one hit at one pixel (3DGS equations 2 and 3), forward and backward.

Selections instead of branches: the pixel loops that call these functions are vectorised, and every lane computes both
sides anyway. A finished pixel keeps the negative of its transmittance, so that no later hit can pass the stop test
and no second array is needed to remember it.
"""

from typing import NamedTuple

from minisplat_ref.scalar._jit import scalar
from minisplat_ref.scalar.literals import HALF, ONE, ZERO


class Frame(NamedTuple):
    """Image size, and the thresholds of the conventions in the data's dtype."""

    width: int
    height: int
    alpha_min: float
    alpha_max: float
    transmittance_min: float
    """Smallest transmittance that a blended hit may leave."""
    mean_gradient_max: float
    """Unclamped alpha above which no gradient reaches the mean; infinity where the conventions let it pass."""
    shape_gradient_max: float
    """The same for conic and opacity."""


@scalar
def mahalanobis(dx, dy, a, b, c):
    """Return sigma = d^T conic d / 2."""
    return HALF * (a * dx * dx + c * dy * dy) + b * dx * dy


@scalar
def blend(transmittance, sigma, unclamped, frame):
    """Blend one hit.

    Returns
    -------
    transmittance : float
        After the hit; negative once the pixel is finished.
    weight : float
        alpha T of the hit, 0 where it is skipped.
    """
    alpha = min(unclamped, frame.alpha_max)
    after = transmittance * (ONE - alpha)
    is_hit = (alpha >= frame.alpha_min) & (sigma >= ZERO)
    is_open = after >= frame.transmittance_min
    weight = alpha * transmittance if is_hit & is_open else ZERO
    stopped = after if is_open else -abs(transmittance)
    return (stopped if is_hit else transmittance), weight


@scalar
def alpha_vjp(transmittance, weight, unclamped, behind, shade, frame):
    """Gradient of the loss by the alpha of one hit.

    With S the part of <v, image> that is composited behind the hit, background and alpha channel included, the image is
    ... + T alpha c + (1 - alpha) (S / (1 - alpha)), so that dL/dalpha = T <v, c> - S / (1 - alpha).

    Parameters
    ----------
    transmittance : float
        T before the hit.
    weight : float
        alpha T, 0 where the hit was skipped.
    unclamped : float
        opacity exp(-sigma).
    behind : float
        S.
    shade : float
        <v, c>.

    Returns
    -------
    float
        dL/dalpha, 0 where the hit was skipped.
    """
    alpha = min(unclamped, frame.alpha_max)
    value = transmittance * shade - behind / (ONE - alpha)
    return value if weight > ZERO else ZERO
