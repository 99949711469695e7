"""A stable radix sort of keys with their values: of Gaussians by depth, and of their pairs by tile.

A pass sorts by one digit of six bits and keeps the order of equal ones; digits come from the last to the first. A
block has 2048 consecutive keys and each of its threads 16 of them. They count their digits in shared memory; the
blocks' counts are scanned digit by digit; and each thread writes its keys from where those of the threads before it
end, in their order. So there are no atomic operations, and the order is that of any stable sort.
"""

from typing import Any

import numpy as np

from minisplat_ref.cuda.arrays import empty
from minisplat_ref.cuda.scanning import exclusive_sums
from minisplat_ref.cuda.target import cuda, device_function, gpu_kernel, is_simulated, launch, launch_rows

DIGIT_BITS, THREADS = (4, 32) if is_simulated else (6, 128)  # of a block; the simulator has a Python thread for each
N_DIGITS = 1 << DIGIT_BITS  # at most as many as threads
KEYS = 16  # of a thread
BLOCK_KEYS = THREADS * KEYS


@gpu_kernel
def write_order(order):
    """Write 0, 1, 2, ...: the order before a sort."""
    i = cuda.grid(1)
    if i < order.shape[0]:
        order[i] = i


@device_function
def extract_digit(keys, i, shift):
    """Return a digit of a key."""
    return (keys[i] >> shift) & (N_DIGITS - 1)


@device_function
def count_own(keys, shift, counts):
    """Count the digits of the thread's keys in its column of ``counts`` [digits, threads]; return where they lie."""
    thread = cuda.threadIdx.x
    first = cuda.blockIdx.x * BLOCK_KEYS + thread * KEYS
    end = min(first + KEYS, keys.shape[0])
    for digit in range(N_DIGITS):
        counts[digit, thread] = 0
    for i in range(first, end):
        counts[extract_digit(keys, i, shift), thread] += 1
    cuda.syncthreads()
    return first, end


@gpu_kernel
def count_digits(keys, shift, totals):
    """Write how often each digit occurs in one block, to ``totals`` [digits * blocks], digit after digit."""
    counts = cuda.shared.array((N_DIGITS, THREADS), np.int32)
    count_own(keys, shift, counts)
    digit = cuda.threadIdx.x
    if digit < N_DIGITS:
        total = np.int32(0)
        for thread in range(THREADS):
            total += counts[digit, thread]
        totals[digit * cuda.gridDim.x + cuda.blockIdx.x] = total


@gpu_kernel
def move_keys(keys, values, shift, starts, sorted_keys, sorted_values):
    """Write the keys of one block and their values to their places, from ``starts`` [digits * blocks + 1] on."""
    places = cuda.shared.array((N_DIGITS, THREADS), np.int32)
    first, end = count_own(keys, shift, places)
    digit = cuda.threadIdx.x
    if digit < N_DIGITS:
        place = np.int32(starts[digit * cuda.gridDim.x + cuda.blockIdx.x])
        for thread in range(THREADS):
            count = places[digit, thread]
            places[digit, thread] = place
            place += count
    cuda.syncthreads()
    for i in range(first, end):
        own = extract_digit(keys, i, shift)
        place = places[own, cuda.threadIdx.x]
        sorted_keys[place], sorted_values[place] = keys[i], values[i]
        places[own, cuda.threadIdx.x] = place + 1


def initial_order(n: int) -> Any:
    """Return the numbers from 0 to ``n`` - 1, int32 on the device."""
    order = empty(n, np.int32)
    launch_rows(write_order, n, order)
    return order


def sort_by_key(keys: Any, values: Any, n_bits: int) -> tuple[Any, Any]:
    """Sort keys and, with them, their values; equal keys keep their order.

    Parameters
    ----------
    keys : device array of shape (M,) of int32 or int64
        Sorted as if they were unsigned. They and ``values`` are overwritten.
    values : device array of shape (M,) of int32
    n_bits : int
        Every key, unsigned, is below 2 to the power of it.

    Returns
    -------
    sorted keys, sorted values
        Of the same shapes and dtypes.
    """
    n, n_blocks = len(keys), -(-len(keys) // BLOCK_KEYS)
    if n == 0:
        return keys, values
    other_keys, other_values = empty(n, keys.dtype), empty(n, np.int32)
    totals = empty(N_DIGITS * n_blocks, np.int32)
    for shift in map(np.int32, range(0, n_bits, DIGIT_BITS)):
        launch(count_digits, n_blocks, THREADS, keys, shift, totals)
        starts = exclusive_sums(totals)
        launch(move_keys, n_blocks, THREADS, keys, values, shift, starts, other_keys, other_values)
        keys, values, other_keys, other_values = other_keys, other_values, keys, values
    return keys, values
