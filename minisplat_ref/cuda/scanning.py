"""Sums of all numbers before each: where what a thread writes begins, when threads write different amounts.

Groups of 32 numbers are summed, their sums are scanned in the same way, and each group continues from its start.
"""

from typing import Any

import numpy as np

from minisplat_ref.cuda.arrays import empty
from minisplat_ref.cuda.target import cuda, gpu_kernel, launch, launch_rows

GROUP = 32  # numbers that one thread adds


@gpu_kernel
def sum_groups(counts, sums):
    """Write the sum of one group."""
    group = cuda.grid(1)
    if group < sums.shape[0]:
        total = np.int64(0)
        for i in range(group * GROUP, min((group + 1) * GROUP, counts.shape[0])):
            total += counts[i]
        sums[group] = total


@gpu_kernel
def spread_groups(counts, starts, offsets):
    """Write the sums before each number of one group, given that before its first; after the last, the sum of all."""
    group, n = cuda.grid(1), counts.shape[0]
    if group * GROUP < n:
        total = starts[group]
        for i in range(group * GROUP, min((group + 1) * GROUP, n)):
            offsets[i] = total
            total += counts[i]
        if (group + 1) * GROUP >= n:
            offsets[n] = total


@gpu_kernel
def start_at_zero(starts):
    """Write 0: before everything."""
    starts[0] = 0


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
    offsets, n_groups = empty(n + 1, np.int64), -(-n // GROUP)
    if n_groups == 1:
        starts = empty(1, np.int64)
        launch(start_at_zero, 1, 1, starts)
    else:
        sums = empty(n_groups, np.int64)
        launch_rows(sum_groups, n_groups, counts, sums)
        starts = exclusive_sums(sums)
    launch_rows(spread_groups, n_groups, counts, starts, offsets)
    return offsets
