"""Reuse the memory of large arrays that live for part of an iteration.

The C library reuses the memory of smaller arrays. That of large ones goes back to the system, which zeroes pages before
handing them out again, and compacts fragmented memory first.

One block is cached, the last one freed. The moments of all pairs and, once they are summed, the gradient with respect
to the coefficients of colour use it in turn.
"""

import weakref

import numpy as np

LARGE = 1 << 25  # bytes; glibc keeps no more
SLACK = 2  # a block may be this many times larger than requested

_cached: list[np.ndarray] = []


def large_empty(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Return an array like ``numpy.empty``; its memory is cached once nothing refers to it or a view of it."""
    n_bytes = int(np.prod(shape)) * dtype.itemsize
    if n_bytes < LARGE:
        return np.empty(shape, dtype)
    try:
        block = _cached.pop()  # atomic: two threads never get the same block
    except IndexError:
        block = np.empty(0, np.uint8)
    if not n_bytes <= block.size <= SLACK * n_bytes:
        block = np.empty(n_bytes, np.uint8)
    numbers = np.frombuffer(block.data, dtype, int(np.prod(shape)))  # every view of it keeps it alive
    weakref.finalize(numbers, _keep, block).atexit = False
    return numbers.reshape(shape)


def _keep(block: np.ndarray) -> None:
    _cached[:] = [block]
