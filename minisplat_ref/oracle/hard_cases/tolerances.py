"""How far a precision may be from the float64 reference, each group with its reason.

Images: largest difference, relative to the largest value where that is above 1. Gradients: relative L2 of each block of
parameters, the worst of all blocks.
"""

from typing import NamedTuple


class Tolerance(NamedTuple):
    """Bounds of one group of cases."""

    reason: str
    """Why these; one line."""
    image64: float
    """Of the kernels in float64."""
    gradient64: float
    image32: float
    """Of the kernels in float32, with either exponential."""
    gradient32: float


ORDINARY = Tolerance(
    "sums of up to a thousand rounded terms: 1e-16 and 6e-8 each", 1e-12, 1e-10, image32=2e-5, gradient32=1e-4
)

LONG = Tolerance(
    "the reference subtracts products 1e12 times larger than their difference; float32 rounds 160 px beside half a px",
    1e-6,
    1e-4,
    image32=2e-5,
    gradient32=1e-3,
)

BEHIND = Tolerance(
    "behind an opaque hit what is left is a difference from the whole pixel: 6e-8 of the whole, divided by 1 - alpha",
    1e-12,
    1e-9,
    image32=2e-5,
    gradient32=1e-3,
)

DEEP = Tolerance(
    "a product of 1,500 factors and sums of as many terms: 6e-8 times their number, where roundings do not cancel",
    1e-11,
    1e-9,
    image32=1e-4,
    gradient32=1e-3,
)

WORLD = Tolerance(
    "coordinates of 1e6 leave float64 1e-10 of a unit, and the reference does not subtract the centre first",
    1e-8,
    1e-7,
    image32=2e-5,
    gradient32=1e-4,
)

HARMONICS = Tolerance(
    "terms that are 1e4 times larger than what is compared: relative to them it is 6e-8",
    1e-11,
    1e-10,
    image32=1e-4,
    gradient32=1e-3,
)

SIMILARITY = Tolerance(
    "variances are differences of means, 6e-8 of values up to 1, beside C2 = 9e-4; gradients near 0 are all rounding",
    1e-11,
    1e-9,
    image32=1e-5,
    gradient32=1e-3,
)

FAINT = Tolerance(
    "an expected depth divides by alpha, of which 1/255 is drawn: 6e-8 times 255",
    1e-11,
    1e-10,
    image32=1e-4,
    gradient32=1e-3,
)
