"""The falloff exp(-sigma) in two precisions: libm's, and a polynomial that the compiler turns into vector code.

A call of libm's ``exp`` for every pixel is scalar and costs more than the rest of the blending. The polynomial form
splits exp(x) = 2^n 2^f with n the nearest integer to x log2(e) and |f| <= 1/2, evaluates 2^f, and adds n to the
exponent bits.
"""

import math

import numpy as np

from minisplat_ref.scalar._jit import scalar

_LOG2_E = np.float32(math.log2(math.e))
_SMALLEST = np.float32(-126.0)  # least exponent of a normal float32; denormals cost tens of cycles
_HALF = np.float32(0.5)

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
    return math.exp(x)


@scalar
def exp_fast(x):
    """Return exp of a float32 x <= 0 to 3e-7 relative; values below 2^-126 return 2^-126."""
    t = max(x * _LOG2_E, _SMALLEST)
    n = np.floor(t + _HALF)
    f = t - n
    mantissa = ((((_C5 * f + _C4) * f + _C3) * f + _C2) * f + _C1) * f + _C0
    return mantissa * np.int32((np.int32(n) + np.int32(127)) << np.int32(23)).view(np.float32)
