"""The falloff exp(-sigma) in two precisions: libm's, and a polynomial that the compiler vectorises.

A call of libm's ``exp`` for every pixel is scalar and costs more than the rest of the blending. The polynomial form
splits exp(x) = 2^n 2^f with n the nearest integer to x log2(e) and |f| <= 1/2, evaluates 2^f, and adds n to the
exponent bits.
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
