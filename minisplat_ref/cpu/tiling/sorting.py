"""Sort floats with a radix sort of their bits.

Positive IEEE floats have the same order as the integers with their bits, negative ones the opposite order
(:func:`depth_keys`). Keys are sorted digit by digit in linear passes. Each pass is stable, so equal keys keep their
order. Keys close to each other share their leading bits: therefore digits are those of the difference to the smallest
key, and only as many pairs of digits as the largest difference needs are sorted.
"""

import numpy as np

from minisplat_ref.jit.compile import scalar
from minisplat_ref.types import Floats, Ints

DIGIT_BITS = 11  # 2048 counters, of two digits: they fit the first-level cache
DIGIT_MASK = (1 << DIGIT_BITS) - 1
KEY_BITS = 64  # of the longest keys


def depth_keys(depths: Floats) -> Ints:
    """Return integers [N] in the order of the depths, their bits as long as none is negative; both zeros are equal."""
    bits: Ints = depths.view(np.int32 if depths.dtype == np.float32 else np.int64)
    if bits.min(initial=0) >= 0:
        return bits
    keys: Ints = np.where(bits < 0, np.iinfo(bits.dtype).min - bits, bits)  # minus the bits without their sign
    return keys


@scalar
def _above(key, lowest):
    """Return the difference to the smallest key, unsigned: between two signs it may exceed the largest int64."""
    return np.uint64(np.int64(key) - np.int64(lowest))


@scalar
def _start_places(keys, lowest, shift, places, next_places):
    """Find where the first key of each digit goes, for the two digits from ``shift`` on, counting both in one pass."""
    places[:] = 0
    next_places[:] = 0
    for key in keys:
        bits = np.int64(_above(key, lowest) >> np.uint64(shift))
        places[bits & DIGIT_MASK] += 1
        next_places[(bits >> DIGIT_BITS) & DIGIT_MASK] += 1
    place = next_place = 0
    for digit in range(places.size):
        place, places[digit] = place + places[digit], place
        next_place, next_places[digit] = next_place + next_places[digit], next_place


@scalar
def _move(keys, values, lowest, shift, places, to_keys, to_values):
    for i in range(keys.size):
        digit = np.int64(_above(keys[i], lowest) >> np.uint64(shift)) & DIGIT_MASK
        place = places[digit]
        places[digit] = place + 1
        to_keys[place], to_values[place] = keys[i], values[i]


@scalar
def sort_stably(keys, values, other_keys, other_values, places):
    """Sort values [n] by their integer keys [n]; equal keys keep their order.

    Parameters
    ----------
    keys, values : ndarray of shape (n,)
        Sorted in place.
    other_keys, other_values : ndarray of shape (n,)
        Scratch.
    places : ndarray of shape (2, 2^DIGIT_BITS)
        Scratch.
    """
    lowest = highest = keys[0] if keys.size > 0 else 0
    for key in keys:
        lowest, highest = min(lowest, key), max(highest, key)
    for shift in range(0, KEY_BITS, 2 * DIGIT_BITS):  # two digits each time: the second pass is back
        if _above(highest, lowest) >> np.uint64(shift) == 0:
            break
        _start_places(keys, lowest, shift, places[0], places[1])
        _move(keys, values, lowest, shift, places[0], other_keys, other_values)
        _move(other_keys, other_values, lowest, shift + DIGIT_BITS, places[1], keys, values)
