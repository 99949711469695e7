"""Front-to-back order of the visible Gaussians: a radix sort of the depths' bits.

Positive IEEE floats are ordered as the integers that their bits spell, so that sorting them takes a fixed number of
linear passes: 3 of 11 bits for float32, 6 for float64. Each pass is stable, which makes equal depths keep the order of
their rows.
"""

import numpy as np

from minisplat_ref.scalar._jit import kernel
from minisplat_ref.types import Floats, Ints

DIGIT_BITS = 11  # 2048 counters: they fit the first-level cache
_PASSES = {np.dtype(np.float32): 3, np.dtype(np.float64): 6}


@kernel(parallel=False)
def _radix_order(keys, order, n_passes):
    other_keys = np.empty_like(keys)
    other_order = np.empty_like(order)
    n = keys.size
    n_digits = 1 << DIGIT_BITS
    counts = np.zeros((n_passes, n_digits), np.int64)
    for i in range(n):
        for digit in range(n_passes):
            counts[digit, (keys[i] >> (DIGIT_BITS * digit)) & (n_digits - 1)] += 1
    for digit in range(n_passes):
        shift = DIGIT_BITS * digit
        total = 0
        for value in range(n_digits):
            count = counts[digit, value]
            counts[digit, value] = total
            total += count
        for i in range(n):
            value = (keys[i] >> shift) & (n_digits - 1)
            place = counts[digit, value]
            counts[digit, value] = place + 1
            other_keys[place] = keys[i]
            other_order[place] = order[i]
        keys, other_keys = other_keys, keys
        order, other_order = other_order, order
    return order


def depth_order(depths: Floats, radii: Ints) -> Ints:
    """Sort the visible Gaussians front to back.

    Parameters
    ----------
    depths : ndarray of shape (N,)
        Camera z, positive where visible.
    radii : ndarray of shape (N, 2)
        0 where culled.

    Returns
    -------
    ndarray of shape (V,), int32
        Rows of the visible Gaussians, nearest first, equal depths in row order.
    """
    visible = np.flatnonzero(radii[:, 0]).astype(np.int32)
    bits = np.int32 if depths.dtype == np.float32 else np.int64  # positive floats: the sign bit is 0
    return _radix_order(depths[visible].view(bits), visible, _PASSES[depths.dtype])
