"""Polynomial exponentials of other degrees than the one in use: what a term less, or one more, would cost and gain.

The form is that of :mod:`minisplat_ref.cpu.exponential`: exp(x) = 2^n 2^f with n the nearest integer to x log2(e), 2^f
by a polynomial on [-1/2, 1/2], n added to the exponent bits. Each function is of its own at module level, because the
compiled kernels on disk are found again by the name of the exponential.
"""

import math
from collections.abc import Callable

import numpy as np

from minisplat_ref.cpu.exponential import exp_fast
from minisplat_ref.scalar._jit import scalar
from minisplat_ref.types import Floats

LOG2_E = np.float32(math.log2(math.e))
SMALLEST = np.float32(-126.0)  # least exponent of a normal float32
HALF = np.float32(0.5)


def _coefficients(degree: int) -> tuple[np.float32, ...]:
    """Chebyshev interpolation of 2^f on [-1/2, 1/2], from f^0 up."""
    fit = np.polynomial.chebyshev.Chebyshev.interpolate(np.exp2, degree, domain=[-0.5, 0.5])
    return tuple(np.float32(value) for value in fit.convert(kind=np.polynomial.Polynomial).coef)


A0, A1, A2, A3 = _coefficients(3)
B0, B1, B2, B3, B4 = _coefficients(4)
C0, C1, C2, C3, C4, C5, C6 = _coefficients(6)


@scalar
def _split(x):  # type: ignore[no-untyped-def]
    t = max(x * LOG2_E, SMALLEST)
    n = np.floor(t + HALF)
    return n, t - n


@scalar
def _times_power_of_two(mantissa, n):  # type: ignore[no-untyped-def]
    return mantissa * np.int32((np.int32(n) + np.int32(127)) << np.int32(23)).view(np.float32)


@scalar
def exp_degree_3(x):  # type: ignore[no-untyped-def]
    """Return exp of a float32 x <= 0 by a cubic."""
    n, f = _split(x)
    return _times_power_of_two(((A3 * f + A2) * f + A1) * f + A0, n)


@scalar
def exp_degree_4(x):  # type: ignore[no-untyped-def]
    """Return exp of a float32 x <= 0 by a quartic."""
    n, f = _split(x)
    return _times_power_of_two((((B4 * f + B3) * f + B2) * f + B1) * f + B0, n)


@scalar
def exp_degree_6(x):  # type: ignore[no-untyped-def]
    """Return exp of a float32 x <= 0 by a polynomial of degree 6."""
    n, f = _split(x)
    return _times_power_of_two((((((C6 * f + C5) * f + C4) * f + C3) * f + C2) * f + C1) * f + C0, n)


EXPONENTIALS: dict[int, Callable[[np.float32], np.float32]] = {
    3: exp_degree_3,
    4: exp_degree_4,
    5: exp_fast,
    6: exp_degree_6,
}
"""By degree; 5 is what float32 uses."""


def relative_errors(exp: Callable[[np.float32], np.float32], xs: Floats) -> Floats:
    """Return the relative error at every one of some float32 numbers, evaluated in plain Python."""
    values = np.array([exp(x) for x in xs], np.float64)
    exact = np.exp(xs.astype(np.float64))
    return np.abs(values / exact - 1)
