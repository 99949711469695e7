"""How far one Gaussian's visible ellipse reaches within a band of pixel rows.

The ellipse is the set a (dx + slope dy)^2 + pivot dy^2 <= q with q = 2 ln(opacity / alpha_min) and the factors a, slope
and pivot of the conic: outside, alpha is below alpha_min. It is convex, so its right-most point within a band of rows
is the right-most point of all if that lies in the band, and otherwise lies on the nearer edge of the band.
"""

import math
from typing import NamedTuple

import numpy as np

from minisplat_ref.scalar._jit import scalar
from minisplat_ref.scalar.lanes import larger, smaller, sqrt
from minisplat_ref.scalar.literals import ONE, TWO, ZERO

FLAT = np.float32(1e-30)  # px^-2: a conic that is no ellipse reaches over any image


class Outline(NamedTuple):
    """Edge of a visible ellipse around the origin."""

    slope: float
    inverse_a: float
    pivot: float
    q: float
    tilt: float
    """dy of the right-most point."""


class Ellipse(NamedTuple):
    """A visible ellipse around the origin."""

    outline: Outline
    half_width: float
    """Largest dx."""
    half_height: float
    """Largest dy."""


@scalar
def visible_ellipse(a, slope, pivot, opacity, alpha_min, margin):
    """Ellipse on which alpha equals alpha_min, its level raised by a relative and an absolute margin."""
    q = TWO * math.log(opacity / alpha_min)
    q += margin * (q + margin)
    inverse_a, pivot = ONE / max(a, FLAT), max(pivot, FLAT)
    half_height = math.sqrt(q / pivot)
    # The inverse of the conic has 1 / a + slope^2 / pivot as its first entry, and -slope / pivot beside the diagonal.
    lean = slope * half_height
    half_width = math.sqrt(q * inverse_a + lean * lean)
    tilt = -lean * (half_height / half_width)
    return Ellipse(Outline(slope, inverse_a, pivot, q, tilt), half_width, half_height)


@scalar
def rightmost_offset(outline, low, high, side):
    """Return the largest dx (side 1) or the largest -dx (side -1) of the ellipse with low <= dy <= high.

    Of numbers or lanes. The band has to meet the ellipse. The left side is the right side of the ellipse turned by half
    a circle.
    """
    dy = smaller(larger(side * outline.tilt, low), high)
    root = sqrt(larger(outline.q - outline.pivot * dy * dy, ZERO) * outline.inverse_a)
    return root - side * outline.slope * dy
