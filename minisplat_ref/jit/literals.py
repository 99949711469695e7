"""Constants that do not widen a float32: a bare Python literal would turn the expression into float64.

Each is exact in float32, so that it is exact in float64 arithmetic too.
"""

import numpy as np

ZERO = np.float32(0.0)
HALF = np.float32(0.5)
ONE = np.float32(1.0)
TWO = np.float32(2.0)
THREE = np.float32(3.0)
FOUR = np.float32(4.0)
SIX = np.float32(6.0)
