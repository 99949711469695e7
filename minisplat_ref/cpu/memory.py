"""Large arrays that live for part of an iteration, in memory that is used again.

The C library keeps the memory of smaller arrays for the next. That of large ones goes back to the system, which clears
what it gives, and where memory is scattered moves it together first.

One block is cached, the last one freed. The moments of all pairs and, once they are summed, the gradient with respect
to the coefficients of colour use it in turn.
"""

import weakref

import numpy as np

LARGE = 1 << 25  # bytes; glibc keeps no more
SLACK = 2  # a block may be so many times larger than what is asked for

_kept: list[np.ndarray] = []


def large_empty(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Return an array as ``numpy.empty`` does; its memory is kept when nobody holds it or a view of it any more."""
    n_bytes = int(np.prod(shape)) * dtype.itemsize
    if n_bytes < LARGE:
        return np.empty(shape, dtype)
    try:
        block = _kept.pop()  # in one step: two threads never get the same block
    except IndexError:
        block = np.empty(0, np.uint8)
    if not n_bytes <= block.size <= SLACK * n_bytes:
        block = np.empty(n_bytes, np.uint8)
    numbers = np.frombuffer(block.data, dtype, int(np.prod(shape)))  # every view of it holds on to it
    weakref.finalize(numbers, _keep, block).atexit = False
    return numbers.reshape(shape)


def _keep(block: np.ndarray) -> None:
    _kept[:] = [block]
