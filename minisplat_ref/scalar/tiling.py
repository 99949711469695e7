"""How far one Gaussian's visible ellipse reaches within a band of pixel rows.

The ellipse is the set a dx^2 + 2 b dx dy + c dy^2 <= q with q = 2 ln(opacity / alpha_min): outside, alpha is below
alpha_min. It is convex, so its right-most point within a band of rows is the right-most point of all if that lies in
the band, and otherwise lies on the nearer edge of the band.
"""

import math

from minisplat_ref.scalar._jit import scalar
from minisplat_ref.scalar.literals import TWO, ZERO


@scalar
def support(opacity, alpha_min):
    """Level q of the ellipse on which alpha equals alpha_min."""
    return TWO * math.log(opacity / alpha_min)


@scalar
def rightmost_offset(a, b, c, det, q, low, high):
    """Return the largest dx of the ellipse with low <= dy <= high; the band has to meet the ellipse."""
    dy = min(max(-(b / c) * math.sqrt(q * c / det), low), high)
    return (-b * dy + math.sqrt(max(q * a - det * dy * dy, ZERO))) / a
