"""How far one Gaussian's visible ellipse reaches within a band of pixel rows.

The ellipse is the set a dx^2 + 2 b dx dy + c dy^2 <= q with q = 2 ln(opacity / alpha_min): outside, alpha is below
alpha_min. It is convex, so its right-most point within a band of rows is the right-most point of all if that lies in
the band, and otherwise lies on the nearer edge of the band.
"""

import math
from typing import NamedTuple

from minisplat_ref.scalar._jit import scalar
from minisplat_ref.scalar.literals import ONE, TWO, ZERO


class Ellipse(NamedTuple):
    """A visible ellipse around the origin."""

    b: float
    inverse_a: float
    det: float
    """a c - b^2."""
    qa: float
    """q a."""
    half_height: float
    """Largest dy."""
    tilt: float
    """dy of the right-most point."""


@scalar
def visible_ellipse(a, b, c, opacity, alpha_min, margin):
    """Ellipse on which alpha equals alpha_min, its level raised by a relative and an absolute margin."""
    q = TWO * math.log(opacity / alpha_min)
    q += margin * (q + margin)
    det = a * c - b * b
    half_width = math.sqrt(q * c / det)
    return Ellipse(b, ONE / a, det, q * a, math.sqrt(q * a / det), -(b / c) * half_width)


@scalar
def rightmost_offset(ellipse, low, high, side):
    """Return the largest dx (side 1) or the largest -dx (side -1) of the ellipse with low <= dy <= high.

    The band has to meet the ellipse. The left side is the right side of the ellipse turned by half a circle.
    """
    dy = min(max(side * ellipse.tilt, low), high)
    root = math.sqrt(max(ellipse.qa - ellipse.det * dy * dy, ZERO))
    return (root - side * ellipse.b * dy) * ellipse.inverse_a
