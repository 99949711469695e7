"""Sums of all numbers before each: where what a thread writes begins, when threads write different amounts.

A block sums 2048 numbers; one block scans the sums of all blocks; and each block continues from its start. Within a
block a thread has consecutive numbers, and the sums of its threads are scanned in shared memory.
"""

from typing import Any

import numpy as np

from minisplat_ref.cuda.arrays import empty
from minisplat_ref.cuda.target import cuda, device_function, gpu_kernel, is_simulated, launch

THREADS = 32 if is_simulated else 256  # of a block; the simulator has a Python thread for each
NUMBERS = 8  # of a thread
BLOCK_NUMBERS = THREADS * NUMBERS
ONE_BLOCK = 32 * BLOCK_NUMBERS  # numbers up to which one block does it all, which is one launch


@device_function
def sum_range(counts, first, end):
    """Return the sum of some numbers."""
    total = np.int64(0)
    for i in range(first, end):
        total += counts[i]
    return total


@device_function
def scan_block(total, totals):
    """Return the sum of ``total`` over the threads before; ``totals`` [threads] is shared memory."""
    thread, step = cuda.threadIdx.x, 1
    totals[thread] = total
    cuda.syncthreads()
    while step < THREADS:
        before = totals[thread - step] if thread >= step else np.int64(0)
        cuda.syncthreads()
        totals[thread] += before
        cuda.syncthreads()
        step *= 2
    return totals[thread] - total


@gpu_kernel
def sum_blocks(counts, sums):
    """Write the sum of the numbers of one block."""
    totals = cuda.shared.array(THREADS, np.int64)
    first = cuda.blockIdx.x * BLOCK_NUMBERS + cuda.threadIdx.x * NUMBERS
    total = sum_range(counts, first, min(first + NUMBERS, counts.shape[0]))
    before = scan_block(total, totals)
    if cuda.threadIdx.x == THREADS - 1:
        sums[cuda.blockIdx.x] = before + total


@gpu_kernel
def scan_numbers(counts, starts, per_thread, offsets):
    """Write the sums before the numbers of one block, given that before its first, and after the last of all."""
    totals = cuda.shared.array(THREADS, np.int64)
    n = counts.shape[0]
    start = starts[cuda.blockIdx.x] if cuda.blockIdx.x > 0 else np.int64(0)
    first = (cuda.blockIdx.x * THREADS + cuda.threadIdx.x) * per_thread
    end = min(first + per_thread, n)
    total = start + scan_block(sum_range(counts, first, end), totals)
    for i in range(first, end):
        offsets[i] = total
        total += counts[i]
    if first < n and end == n:
        offsets[n] = total


def exclusive_sums(counts: Any) -> Any:
    """Return the sums before each number, and that of all.

    Parameters
    ----------
    counts : device array of shape (N,) of int
        At least one.

    Returns
    -------
    device array of shape (N + 1,) of int64
    """
    n = len(counts)
    offsets = empty(n + 1, np.int64)
    if n <= ONE_BLOCK:
        starts, n_blocks, per_thread = offsets, 1, -(-n // THREADS)  # nothing is before the first block
    else:
        n_blocks, per_thread = -(-n // BLOCK_NUMBERS), NUMBERS
        sums = empty(n_blocks, np.int64)
        launch(sum_blocks, n_blocks, THREADS, counts, sums)
        starts = exclusive_sums(sums)
    launch(scan_numbers, n_blocks, THREADS, counts, starts, per_thread, offsets)
    return offsets
