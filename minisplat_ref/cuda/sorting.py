"""The one sort of a view: pairs (tile, Gaussian) by tile, and within a tile by depth, by a radix sort.

A pass sorts by one digit of four bits and keeps the order of equal ones; digits come from the last to the first. A
thread has 32 consecutive pairs: it counts their digits, the counts are scanned digit by digit, and it writes its pairs
from there on in their order. So there are no atomic operations, and the order is that of any stable sort.
"""

from typing import Any

import numpy as np

from minisplat_ref.cuda.arrays import empty
from minisplat_ref.cuda.scanning import exclusive_sums
from minisplat_ref.cuda.target import cuda, device_function, gpu_kernel, launch_rows

CHUNK = 32  # pairs of a thread
DIGIT_BITS = 4
N_DIGITS = 1 << DIGIT_BITS


@gpu_kernel
def write_order(order):
    """Write the order before the first pass."""
    i = cuda.grid(1)
    if i < order.shape[0]:
        order[i] = i


@device_function
def digit_of(keys, pair, shift):
    """Return a digit of a key."""
    return (keys[pair] >> shift) & (N_DIGITS - 1)


@gpu_kernel
def count_digits(keys, order, shift, counts):
    """Write how often each digit occurs in one chunk, to ``counts`` [16 * chunks], digit after digit."""
    chunk, n = cuda.grid(1), order.shape[0]
    n_chunks = counts.shape[0] // N_DIGITS
    if chunk >= n_chunks:
        return
    for digit in range(N_DIGITS):
        counts[digit * n_chunks + chunk] = 0
    for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, n)):
        counts[digit_of(keys, order[i], shift) * n_chunks + chunk] += 1


@gpu_kernel
def move_pairs(keys, order, shift, places, moved):
    """Write the pairs of one chunk to their places, which ``places`` [16 * chunks + 1] counts on."""
    chunk, n = cuda.grid(1), order.shape[0]
    n_chunks = (places.shape[0] - 1) // N_DIGITS
    if chunk >= n_chunks:
        return
    for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, n)):
        pair = order[i]
        k = digit_of(keys, pair, shift) * n_chunks + chunk
        moved[places[k]] = pair
        places[k] += 1


def sort_pairs(tiles: Any, depth_bits: Any, n_tiles: int) -> Any:
    """Return the order of the pairs by (tile, depth); equal ones keep their order.

    Parameters
    ----------
    tiles : device array of shape (M,) of int32
        Tile of each pair, below ``n_tiles``.
    depth_bits : device array of shape (M,) of int32 or int64
        Bits of the Gaussian's depth as an integer: positive floats are ordered as their bits are.
    n_tiles : int

    Returns
    -------
    device array of shape (M,) of int32
        Index of the pair that comes first, of the second, and so on.
    """
    n, n_chunks = len(tiles), -(-len(tiles) // CHUNK)
    order, moved = empty(n, np.int32), empty(n, np.int32)
    if n == 0:
        return order
    counts = empty(N_DIGITS * n_chunks, np.int32)
    launch_rows(write_order, n, order)
    for keys, n_bits in ((depth_bits, 8 * depth_bits.dtype.itemsize), (tiles, (n_tiles - 1).bit_length())):
        for shift in range(0, n_bits, DIGIT_BITS):
            launch_rows(count_digits, n_chunks, keys, order, np.int32(shift), counts)
            launch_rows(move_pairs, n_chunks, keys, order, np.int32(shift), exclusive_sums(counts), moved)
            order, moved = moved, order
    return order
