"""The extent of one Gaussian's visible ellipse within a band of pixel rows.

The ellipse is the set a (dx + slope dy)^2 + pivot dy^2 <= q with q = 2 ln(opacity / alpha_min) and the factors a, slope
and pivot of the conic: outside it, alpha is below alpha_min. The ellipse is convex: its rightmost point within a band
of rows is its rightmost point overall if that lies in the band, and otherwise lies on the nearer edge of the band.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import libm_log, maximum, minimum, select, sqrt
from minisplat_ref.jit.literals import ONE, TWO, ZERO

FAR = np.float32(1e9)  # px
FLAT = np.float32(1e-37)  # px^-2, the smallest with a reciprocal in float32; a flatter ellipse covers any image


class Outline(NamedTuple):
    """The boundary of a visible ellipse around the origin."""

    slope: float
    inverse_a: float
    pivot: float
    q: float
    tilt: float
    """dy of the rightmost point."""


@scalar
def visible_outline(a, slope, pivot, opacity, alpha_min, margin):
    """Return the outline on which alpha equals alpha_min, with q raised by a relative and an absolute margin.

    Takes numbers or lanes.
    """
    q = TWO * libm_log(opacity / alpha_min)
    q = q + margin * (q + margin)
    inverse_a, pivot = ONE / maximum(a, FLAT), maximum(pivot, FLAT)
    # The inverse of the conic has 1 / a + slope^2 / pivot as its first entry, and -slope / pivot beside the diagonal.
    lean = slope / pivot
    tilt = -lean * sqrt(q / (inverse_a + slope * lean))
    return Outline(slope, inverse_a, pivot, q, tilt)


@scalar
def rightmost_offset(outline, low, high, side):
    """Return the largest dx (side 1) or the largest -dx (side -1) of the ellipse with low <= dy <= high.

    Takes numbers or lanes; -FAR where the band does not meet the ellipse. The left side is the right side of the
    ellipse rotated by 180 degrees.
    """
    dy = minimum(maximum(side * outline.tilt, low), high)
    room = outline.q - outline.pivot * dy * dy  # negative only where the band misses the ellipse
    return select(room < ZERO, -FAR, sqrt(maximum(room, ZERO) * outline.inverse_a) - side * outline.slope * dy)
