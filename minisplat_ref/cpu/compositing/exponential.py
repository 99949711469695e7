"""The falloff exp(-sigma) in two precisions: libm's, and polynomials that the compiler vectorises.

A call of libm's ``exp`` for every pixel is scalar and costs more than the rest of the blending. The polynomial form
splits exp(x) = 2^n 2^f with n the nearest integer to x log2(e) and |f| <= 1/2, evaluates 2^f, and adds n to the
exponent bits. That for float64 evaluates exp(f ln 2) = exp(x - n ln 2), with ln 2 as a sum of two numbers.
"""

import math
from collections.abc import Callable

import numpy as np

from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import ldexp, libm_exp, maximum, rint

_LOG2_E = np.float32(math.log2(math.e))
_SMALLEST = np.float32(-60.0)  # far below any visible alpha, far above denormals, which cost tens of cycles

# 2^f on [-1/2, 1/2], coefficients of f^0 to f^5: Chebyshev interpolation, relative error below 2e-7
_C0, _C1, _C2, _C3, _C4, _C5 = (
    np.float32(value)
    for value in np.polynomial.chebyshev.Chebyshev.interpolate(np.exp2, 5, domain=[-0.5, 0.5])
    .convert(kind=np.polynomial.Polynomial)
    .coef
)


_WIDE_LOG2_E = math.log2(math.e)
_WIDE_SMALLEST = -1000.0  # of n: 2^n is a normal number
_LN_2_HIGH = float.fromhex("0x1.62e42feep-1")  # its last bits are zero, so that its product with n is exact
_LN_2_LOW = float.fromhex("0x1.a39ef35793c76p-33")

# 1 / k! for k up to 13: on [-ln 2 / 2, ln 2 / 2] the rest of the series is below 5e-18
_W0, _W1, _W2, _W3, _W4, _W5, _W6, _W7, _W8, _W9, _W10, _W11, _W12, _W13 = (1 / math.factorial(k) for k in range(14))


@scalar
def exp_wide(x):
    """Return exp of float64 lanes x <= 0, to a relative error of 4e-16; at least 2^-1000."""
    n = maximum(rint(x * _WIDE_LOG2_E), _WIDE_SMALLEST)
    r = maximum((x - n * _LN_2_HIGH) - n * _LN_2_LOW, -1.0)  # below it only where n is its smallest
    square = r * r
    fourth = square * square
    low = (_W0 + _W1 * r) + (_W2 + _W3 * r) * square
    middle = (_W4 + _W5 * r) + (_W6 + _W7 * r) * square
    high = (_W8 + _W9 * r) + (_W10 + _W11 * r) * square + (_W12 + _W13 * r) * fourth
    return ldexp(low + (middle + high * fourth) * fourth, n)


@scalar
def exp_exact(x):
    """Return libm's exp."""
    return libm_exp(x)


@scalar
def powers_of_two(x):
    """Return the integer n >= -60 and f in [-1/2, 1/2] with exp(x) = 2^n 2^f, for float32 lanes."""
    t = maximum(x * _LOG2_E, _SMALLEST)
    n = rint(t)
    return n, t - n


@scalar
def exp_fast(x):
    """Return exp of float32 lanes x <= 0, to a relative error of 6e-7 for x >= -6; at least 2^-60."""
    n, f = powers_of_two(x)
    square = f * f
    low, middle, high = _C0 + _C1 * f, _C2 + _C3 * f, _C4 + _C5 * f  # independent, as in Estrin's scheme
    return ldexp(low + (middle + high * square) * square, n)


def choose_exponential(dtype: np.dtype) -> Callable:
    """Return the exponential for data of a dtype: the polynomial for float32, libm's for float64."""
    return exp_fast if dtype == np.float32 else exp_exact
