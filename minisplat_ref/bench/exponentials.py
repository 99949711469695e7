"""Polynomial exponentials of other degrees than the one in use: the cost and gain of a term less, or one more.

The form is that of :mod:`minisplat_ref.cpu.compositing.exponential`: exp(x) = 2^n 2^f with n the nearest integer to
x log2(e), a polynomial for 2^f on [-1/2, 1/2], and n added to the exponent bits. Each degree has its own function
at module level, because compiled kernels on disk are identified by the name of the exponential.
"""

from collections.abc import Callable

import numpy as np

from minisplat_ref.cpu.compositing.exponential import exp_fast, powers_of_two
from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import ldexp
from minisplat_ref.types import Floats


def _coefficients(degree: int) -> tuple[np.float32, ...]:
    """Return the coefficients of the Chebyshev interpolation of 2^f on [-1/2, 1/2], from f^0 up."""
    fit = np.polynomial.chebyshev.Chebyshev.interpolate(np.exp2, degree, domain=[-0.5, 0.5])
    return tuple(np.float32(value) for value in fit.convert(kind=np.polynomial.Polynomial).coef)


A0, A1, A2, A3 = _coefficients(3)
B0, B1, B2, B3, B4 = _coefficients(4)
C0, C1, C2, C3, C4, C5, C6 = _coefficients(6)


@scalar
def exp_degree_3(x):  # type: ignore[no-untyped-def]
    """Return exp of float32 lanes x <= 0 by a cubic."""
    n, f = powers_of_two(x)
    return ldexp(((A3 * f + A2) * f + A1) * f + A0, n)


@scalar
def exp_degree_4(x):  # type: ignore[no-untyped-def]
    """Return exp of float32 lanes x <= 0 by a quartic."""
    n, f = powers_of_two(x)
    return ldexp((((B4 * f + B3) * f + B2) * f + B1) * f + B0, n)


@scalar
def exp_degree_6(x):  # type: ignore[no-untyped-def]
    """Return exp of float32 lanes x <= 0 by a polynomial of degree 6."""
    n, f = powers_of_two(x)
    return ldexp((((((C6 * f + C5) * f + C4) * f + C3) * f + C2) * f + C1) * f + C0, n)


EXPONENTIALS: dict[int, Callable[[Floats], Floats]] = {
    3: exp_degree_3,
    4: exp_degree_4,
    5: exp_fast,
    6: exp_degree_6,
}
"""By degree; float32 uses 5."""


def relative_errors(exp: Callable[[Floats], Floats], xs: Floats) -> Floats:
    """Return the relative errors at some float32 numbers, evaluated in plain Python."""
    return np.abs(exp(xs) / np.exp(xs.astype(np.float64)) - 1)
