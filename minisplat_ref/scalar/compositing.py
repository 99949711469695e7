"""Alpha blending of one hit at one pixel (3DGS equations (3) and (4)), forward and backward.

The functions take eight pixels at a time (``lanes``), with ``select`` instead of branches. A finished pixel stores its
transmittance negated: no later hit passes the stop test, and no second array has to mark the finished pixels.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import maximum, minimum, select
from minisplat_ref.jit.literals import HALF, ONE, TWO, ZERO

PIVOT_MIN = np.float32(1e-14)  # smallest pivot of a conic relative to c: a little above float64's rounding
HALF_FACTOR_MAX = np.float32(1e30)  # without a low-pass a footprint can be thinner than float32 can square


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
def factors(a, b, c):
    """Return (a, slope, pivot) with a dx^2 + 2 b dx dy + c dy^2 = a (dx + slope dy)^2 + pivot dy^2.

    The right side is a sum of squares, which cannot cancel; for a long oblique needle the three terms on the left are
    many orders of magnitude larger than their sum. The pivot c - b^2 / a is such a difference itself, so conics are
    float64, and a lower bound keeps the pivot positive where they were rounded.
    """
    slope = b / a
    return a, slope, maximum(c - b * slope, PIVOT_MIN * c)


@scalar
def halve_factor(factor):
    """Return half of a factor of a conic; a negative one becomes so large that it leaves no hits."""
    return select(factor >= ZERO, minimum(HALF * factor, HALF_FACTOR_MAX), HALF_FACTOR_MAX)


@scalar
def mahalanobis(e, half_a, least):
    """Return sigma = d^T conic d / 2, given e = dx + slope dy and ``least`` = pivot dy^2 / 2; see ``factors``."""
    return half_a * e * e + least


@scalar
def conic_vjp_of_moments(slope, ee, ey, yy):
    """Return the gradient with respect to (a, b, c), given sums of dL/dsigma times e^2, e dy and dy^2.

    e = dx + slope dy, as in ``factors``.
    """
    return HALF * (ee - slope * (TWO * ey - slope * yy)), ey - slope * yy, HALF * yy


@scalar
def mean_vjp_of_moments(a, slope, pivot, qe, qy):
    """Return the gradient with respect to the image position, given sums of dL/dsigma times e and dy."""
    return a * qe, slope * a * qe + pivot * qy


@scalar
def blend(transmittance, unclamped, frame):
    """Blend one hit.

    Parameters
    ----------
    transmittance : lanes
        T before the hit; negative where the pixel is finished.
    unclamped : lanes
        opacity exp(-sigma); sigma is a sum of squares and never negative.

    Returns
    -------
    transmittance : lanes
        After the hit; negative once the pixel is finished.
    weight : lanes
        alpha T of the hit, 0 where it is skipped.
    """
    alpha = minimum(unclamped, frame.alpha_max)
    after = transmittance * (ONE - alpha)
    is_hit = alpha >= frame.alpha_min
    is_blended = is_hit & (after >= frame.transmittance_min)
    weight = select(is_blended, alpha * transmittance, ZERO)
    stopped = select(is_hit, -abs(transmittance), transmittance)
    return select(is_blended, after, stopped), weight


@scalar
def blend_vjp(transmittance, weight, unclamped, behind, v_dot_c, frame):
    """Return the derivative of the loss with respect to the alpha of one hit, ignoring the clamp.

    With S the part of <v, image> that is composited behind the hit, background and alpha channel included, the image is
    ... + T alpha c + (1 - alpha) (S / (1 - alpha)), so that dL/dalpha = T <v, c> - S / (1 - alpha).

    Parameters
    ----------
    transmittance : lanes
        T before the hit.
    weight : lanes
        alpha T, 0 where the hit was skipped.
    unclamped : lanes
        alpha before the clamp.
    behind : lanes
        S.
    v_dot_c : lanes
        <v, c>.

    Returns
    -------
    lanes
        dL/dalpha, 0 where the hit was skipped.
    """
    alpha = minimum(unclamped, frame.alpha_max)
    return select(weight > ZERO, transmittance * v_dot_c - behind / (ONE - alpha), ZERO)


@scalar
def sigma_vjp(transmittance, weight, unclamped, behind, v_dot_c, frame):
    """Return the derivative of the loss with respect to the sigma of one hit, where alpha is not clamped.

    With S the part of <v, image> that is composited behind the hit, background and alpha channel included, the image is
    ... + T alpha c + (1 - alpha) (S / (1 - alpha)), so that dL/dalpha = T <v, c> - S / (1 - alpha); and
    dalpha/dsigma = -alpha.

    Parameters
    ----------
    transmittance : lanes
        T before the hit.
    weight : lanes
        alpha T, 0 where the hit was skipped.
    unclamped : lanes
        opacity exp(-sigma).
    behind : lanes
        S.
    v_dot_c : lanes
        <v, c>.

    Returns
    -------
    lanes
        dL/dsigma, 0 where the hit was skipped.
    """
    alpha = minimum(unclamped, frame.alpha_max)
    return select(weight > ZERO, unclamped * (behind / (ONE - alpha) - transmittance * v_dot_c), ZERO)
