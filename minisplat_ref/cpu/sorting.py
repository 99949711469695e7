"""Order of positive floats: a radix sort of their bits.

Positive IEEE floats are ordered as the integers that their bits spell, and those are sorted digit by digit in linear
passes. Each pass is stable, which makes equal keys keep their order. Keys that are near each other share their leading
bits: digits are those of the difference to the smallest key, and there are as few as the largest difference needs.
"""

from minisplat_ref.scalar._jit import scalar

DIGIT_BITS = 11  # 2048 counters: they fit the first-level cache


@scalar
def sort_stably(keys, values, other_keys, other_values, places):
    """Sort values [n] by their integer keys [n]; equal keys keep their order.

    Parameters
    ----------
    keys, values : ndarray of shape (n,)
        Overwritten.
    other_keys, other_values : ndarray of shape (n,)
        Scratch.
    places : ndarray of shape (2^DIGIT_BITS,)
        Scratch.

    Returns
    -------
    ndarray of shape (n,)
        ``values`` or ``other_values``, in which the sorted values are.
    """
    lowest = highest = keys[0] if keys.size > 0 else 0
    for key in keys:
        lowest, highest = min(lowest, key), max(highest, key)
    mask = places.size - 1
    shift = 0
    while (highest - lowest) >> shift > 0:
        places[:] = 0
        for key in keys:
            places[((key - lowest) >> shift) & mask] += 1
        place = 0
        for digit in range(places.size):
            place, places[digit] = place + places[digit], place
        for i in range(keys.size):
            digit = ((keys[i] - lowest) >> shift) & mask
            place = places[digit]
            places[digit] = place + 1
            other_keys[place], other_values[place] = keys[i], values[i]
        keys, other_keys = other_keys, keys
        values, other_values = other_values, values
        shift += DIGIT_BITS
    return values
