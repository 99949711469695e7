"""``python cuda_sorting.py OUT``: scans and sorts in the simulator, with blocks of a few numbers, so that many run."""

import pickle
import sys
from pathlib import Path

import numpy as np

SCANNED = (1, 16, 17, 150)  # numbers; up to 16 one block does all, and of 150 the blocks' sums need several
SORTED = (1, 9, 40)  # keys; a block has 8
DEPTHS = (0.5, -2.0, 1e30, -0.0, -1e30, 0.0, -1e-30, 1e-30, -1.0, 3.0)
BITS = {np.int32: 9, np.int64: 36}


def make_counts(n):
    """Numbers to add, some of them 0."""
    return np.random.default_rng(n).integers(0, 4, n)


def make_keys(n, dtype):
    """Keys of 9 bits in int32 and 36 in int64, many of them equal in their last digits or altogether."""
    rng = np.random.default_rng(n)
    return (rng.integers(0, 5, n) << (BITS[dtype] - 3) | rng.integers(0, 3, n)).astype(dtype)


def main(path):
    """Write what the kernels return to a file."""
    from minisplat_ref.cuda import scanning, sorting, tiling
    from minisplat_ref.cuda.arrays import to_host
    from minisplat_ref.cuda.target import cuda

    scanning.THREADS, scanning.NUMBERS, scanning.BLOCK_NUMBERS, scanning.ONE_BLOCK = 4, 2, 8, 16
    sorting.THREADS, sorting.KEYS, sorting.BLOCK_KEYS, sorting.N_DIGITS, sorting.DIGIT_BITS = 4, 2, 8, 4, 2
    sums = {n: scanning.exclusive_sums(cuda.to_device(make_counts(n))).copy_to_host() for n in SCANNED}
    found = {}
    for dtype, n_bits in BITS.items():
        for n in SORTED:
            keys = cuda.to_device(make_keys(n, dtype))
            pair = sorting.sort_by_key(keys, sorting.initial_order(n), n_bits)
            found[dtype.__name__, n] = tuple(array.copy_to_host() for array in pair)
    orders = {t.__name__: to_host(tiling.order_by_depth(np.array(DEPTHS, t))) for t in (np.float32, np.float64)}
    Path(path).write_bytes(pickle.dumps((sums, found, orders)))


if __name__ == "__main__":
    main(sys.argv[1])
