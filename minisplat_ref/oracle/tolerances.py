"""Every tolerance of the oracle and of the benchmarks, each with its reason.

In order: gradients against differences; reference and kernels against 50 digits and against a peer; another renderer
against the reference, stage by stage; the benchmark's contenders; the groups of hard cases; and the margins at
thresholds within which rounding decides. Relative tolerances are relative to the largest value compared. Tolerances
that only tests need are in ``tests/helpers/tolerances.py``; those of a scene's photographs or a strategy are where they
are used.
"""

from typing import NamedTuple

import numpy as np

# --- gradients against differences ---

# Sixth-order differences in float64: rounding 1e-16 / 1e-4 of values up to 100, truncation below it.
GRADIENT_REL = 1e-8

# Where a threshold is so near that only a step of 1e-8 stays on its side: rounding 1e-16 / 1e-8 on values up to 100.
GRADIENT_REL_NEAR_THRESHOLD = 1e-6

# A block of a Jacobian or a gradient below this is vacuous or meant to be zero: real ones here are 1e-4 to 1e3.
GRADIENT_FLOOR = 1e-6

# Alpha must cover this fraction of an image before a check on it is meaningful.
COVERAGE_MIN = 0.05

# --- against a peer, against 50 digits ---

# gsplat's torch functions in float64, with a stage's input in common: 1e-16 times condition numbers up to 1e3.
PEER_REL = 1e-9

# Against 50 digits, divided by the condition number: a few dozen roundings of 1e-16 ...
TRUTH_FLOAT64 = 1e-13
# ... and of 6e-8, with a polynomial exponential of 1e-7.
TRUTH_FLOAT32 = 2e-6

# --- another renderer against the reference, stage by stage ---

# A stage of another float64 renderer, fed with the same input: 1e-16 times conditions up to 1e4, in sums of thousands
# of terms. Wrong formulas are off by 1e-4 and more.
COMPARE_FLOAT64 = 1e-9


class StageTolerance(NamedTuple):
    """Allowed error of another renderer's array, relative to the array's largest value."""

    float64: float
    float32: float
    """From rounded input, or from its own results of the stage before."""
    reason: str
    """Of float32, one line; published with the golden vectors."""

    def of(self, dtype: str | np.dtype) -> float:
        """Return the tolerance for results computed in ``dtype``."""
        return self.float32 if np.dtype(dtype) == np.float32 else self.float64


EXACT = StageTolerance(0.0, 0.0, "given or counted, not computed; a difference may still be harmless")
# A few roundings of 6e-8 ...
POSITION = StageTolerance(COMPARE_FLOAT64, 2e-6, "a product with the view matrix and one division")
UNSCENTED = StageTolerance(COMPARE_FLOAT64, 5e-5, "weights of -99 and 16.7, whose sizes add up to 199, times 6e-8")
# ... divided by the determinant of a covariance whose condition number is up to 1e2 ...
SHAPE = StageTolerance(
    COMPARE_FLOAT64, 2e-5, "the 2x2 inverse multiplies rounding by the condition number of the covariance"
)
# ... through an exponential of relative error 1e-7 to 1e-6, hundreds of times in a pixel ...
IMAGE = StageTolerance(COMPARE_FLOAT64, 2e-5, "hundreds of hits a pixel, each with an exponential")
# ... relative to windowed variances, differences of means, which count beside C2 = 9e-4 ...
LOSS = StageTolerance(COMPARE_FLOAT64, 5e-5, "variances are differences of means, divided by at least C2 = 9e-4")
# ... and in sums of either sign over pixels, divided by 1 - alpha >= 0.01.
GRADIENT = StageTolerance(
    COMPARE_FLOAT64, 1e-4, "sums over pixels of either sign, divided by 1 - alpha >= 0.01 and by z^2"
)
# ... an accumulated depth divided by an alpha that may be 1/255, both off by their last digits ...
EXPECTED_DEPTH = StageTolerance(COMPARE_FLOAT64, 1e-4, "a depth is divided by alpha, of which 1/255 may be drawn")
# ... two products with Sigma^-1, of which the ratio of the axes is the condition number, up to 1e2 here ...
SURFACE = StageTolerance(COMPARE_FLOAT64, 1e-4, "Sigma^-1 multiplies rounding by its condition number")
# ... and a few roundings of values of order 1.
ADAM = StageTolerance(COMPARE_FLOAT64, 2e-6, "a few roundings of each value")
# Of surfels: a depth or a colour, a difference of depths that nearly cancels, and a quotient of such differences.
SURFEL_DEPTH = StageTolerance(COMPARE_FLOAT64, 5e-5, "a depth is divided by alpha, hundreds of hits each rounded")
SURFEL_DISTORTION = StageTolerance(COMPARE_FLOAT64, 2e-4, "z_i A_i - M_i is a difference of nearly equal numbers")
SURFEL_NORMAL = StageTolerance(COMPARE_FLOAT64, 2e-3, "differences of neighbouring depths, divided by their length")
CALL_HARD = StageTolerance(1e-10, 2e-5, "grazing rays multiply rounding by the inverse of the angle")

# Of two weights in a pixel that are as near as this part of the larger, rounding decides which is the largest: they are
# products of hundreds of factors, each rounded to 6e-8.
TIE = 1e-4

# --- the benchmark's contenders ---

# The accuracy of an image in float32 where no hit falls on the other side of a threshold: hundreds of hits, each with
# an exponential of 1e-7 relative error at a distance that has lost digits to a coordinate of some hundred pixels.
BENCH_FLOAT32_IMAGE = 2e-5
# The same of every parameter's gradient, relative L2, without the pixels at a threshold.
BENCH_FLOAT32_GRADIENT = 1e-4
# Part of the pixels in which a hit may fall on the other side of a threshold in float32: none to 1e-4 on random scenes.
BENCH_FLIPPED_PIXELS = 1e-3
# Part of the pixels that may be off where an extension's thresholds are not known, hits that change places included.
BENCH_OFF_PIXELS = 1e-2
# The loss of a made room before any training, float32 against float32: its points lie on walls, many at one depth, and
# each renderer rounds them into another order. A pixel changes by up to 7e-3, one in five does; their mean by 4e-5.
BENCH_FLOAT32_LOSS = 1e-4
# float64 kernels against the reference: another order of sums of up to thousands of terms of 1e-16 each.
BENCH_FLOAT64 = 1e-11
# Gradient of a polynomial exponential, in units of its relative error: behind / (1 - alpha) multiplies it.
BENCH_EXPONENTIAL_GRADIENT = 10.0

# --- hard cases ---


class HardCaseTolerance(NamedTuple):
    """Allowed difference of a precision from the float64 reference in one group of hard cases.

    Images: largest difference, relative to the largest value where that is above 1. Gradients: relative L2 of each
    block of parameters, the worst of all blocks.
    """

    reason: str
    """The reason for these values, one line."""
    image64: float
    """Of the kernels in float64."""
    gradient64: float
    image32: float
    """Of the kernels in float32, with either exponential."""
    gradient32: float


ORDINARY = HardCaseTolerance(
    "sums of up to a thousand rounded terms: 1e-16 and 6e-8 each", 1e-12, 1e-10, image32=2e-5, gradient32=1e-4
)

LONG = HardCaseTolerance(
    "the reference subtracts products 1e12 times larger than their difference; float32 rounds 160 px beside half a px",
    1e-6,
    1e-4,
    image32=2e-5,
    gradient32=1e-3,
)

BESIDE = HardCaseTolerance(
    "x / z is 1,000 and more: gradients with respect to z and the camera are differences of sums 1e6 times larger",
    1e-6,
    1e-4,
    image32=2e-5,
    gradient32=0.2,  # (x / z)^2 times 6e-8 is 0.06; image, opacity and colour are as exact as elsewhere
)

BEHIND = HardCaseTolerance(
    "behind an opaque hit what is left is a difference from the whole pixel: 6e-8 of the whole, divided by 1 - alpha",
    1e-12,
    1e-9,
    image32=2e-5,
    gradient32=1e-3,
)

DEEP = HardCaseTolerance(
    "a product of 1,500 factors and sums of as many terms: 6e-8 times their number, where roundings do not cancel",
    1e-11,
    1e-9,
    image32=1e-4,
    gradient32=1e-3,
)

WORLD = HardCaseTolerance(
    "coordinates of 1e6 leave float64 1e-10 of a unit, and the reference does not subtract the centre first",
    1e-8,
    1e-7,
    image32=2e-5,
    gradient32=1e-4,
)

HARMONICS = HardCaseTolerance(
    "terms that are 1e4 times larger than what is compared: relative to them it is 6e-8",
    1e-11,
    1e-10,
    image32=1e-4,
    gradient32=1e-3,
)

SIMILARITY = HardCaseTolerance(
    "variances are differences of means, 6e-8 of values up to 1, beside C2 = 9e-4; gradients near 0 are all rounding",
    1e-11,
    1e-9,
    image32=1e-5,
    gradient32=1e-3,
)

FAINT = HardCaseTolerance(
    "an expected depth divides by alpha, of which 1/255 is drawn: 6e-8 times 255",
    1e-11,
    1e-10,
    image32=1e-4,
    gradient32=1e-3,
)

# A gradient smaller than this part of the median block is judged by the median: it is the rounding of the others.
BLOCK_FLOOR = 1e-2

# --- pixels at thresholds ---


class Margins(NamedTuple):
    """The distance from a threshold within which rounding decides on which side a value falls.

    Margins are relative to the threshold, as rounding is; see :mod:`minisplat_ref.oracle.thresholds`.
    """

    reason: str
    """The reason for these values, one line."""
    skip: float
    """Of a hit's alpha from ``alpha_min``."""
    clamp: float
    """Of a hit's alpha from ``alpha_max``."""
    stop: float
    """Of the transmittance behind a hit from ``transmittance_min``."""
    median: float
    """Of the same from one half."""
    place: float
    """The error of a pixel coordinate; a hit's alpha changes with it in proportion to the slope of its Gaussian."""
    order: float
    """Of the depth of a hit from that of the one before; those that are one float32 are always near enough."""


FLOAT32_RENDERER = Margins(
    "a centre at some hundred pixels is off by 3e-5 px in float32, and the exponent of alpha changes by up to 6 a pixel"
    " at 1/255, by up to 0.3 at the clamp; a depth is three products and sums of 6e-8 each",
    skip=255e-6,  # 1e-6 absolutely, where alpha_min is 1/255
    clamp=1e-5,
    stop=255e-6,
    median=255e-6,
    place=0.0,  # it is in the others
    order=5e-7,
)
"""For any correct renderer in float32 that computes its own projection."""

OWN_KERNELS = Margins(
    "footprints and depths come from float64: what is left is rounding of 6e-8 in exponent and exponential, twice in"
    " coordinates, and of a depth to its float32; but 1 - 0.99 is off by 1e-6, and a pixel can take several such hits",
    skip=1e-6,
    clamp=1e-6,
    stop=1e-5,
    median=1e-6,
    place=1.2e-7,
    order=0.0,
)
"""Of our float32 kernels in the hard cases.

By :data:`FLOAT32_RENDERER` a quarter of the pixels behind 4000 layers would be set aside, and every pixel where depths
are one rounding apart: that case would check nothing.
"""
