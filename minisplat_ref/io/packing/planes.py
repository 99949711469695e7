"""Integers as planes of bytes: all lowest bytes, then all second ones, so that similar bytes are adjacent for a packer.

The values of a column are adjacent within a plane. Signed integers are first mapped by zigzag encoding,
``0, -1, 1, -2, ... -> 0, 1, 2, 3, ...``, which leaves the upper bytes of small ones zero.
"""

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.types import Ints

PLANES_MAX = 8


def zigzag(values: Ints) -> NDArray[np.uint64]:
    """Return ``2 v`` for ``v >= 0`` and ``-2 v - 1`` below, of int64."""
    return ((values << 1) ^ (values >> 63)).view(np.uint64)


def unzigzag(values: NDArray[np.uint64]) -> Ints:
    """Return the int64 values that :func:`zigzag` has encoded."""
    return (values >> np.uint64(1)).view(np.int64) ^ -(values & np.uint64(1)).view(np.int64)


def to_planes(values: NDArray[np.uint64]) -> tuple[bytes, int]:
    """Return the integers [N, C] as bytes [P, C, N], and the number of planes P that the largest one needs."""
    n_planes = max(1, -(-int(values.max(initial=0)).bit_length() // 8))
    columns = np.ascontiguousarray(values.T)  # [C, N]
    planes = [((columns >> np.uint64(8 * p)) & np.uint64(255)).astype(np.uint8) for p in range(n_planes)]
    return b"".join(plane.tobytes() for plane in planes), n_planes


def from_planes(raw: bytes, n_planes: int, n_columns: int, n: int) -> NDArray[np.uint64]:
    """Return the integers [N, C] that :func:`to_planes` has stored as bytes [P, C, N]."""
    planes = np.frombuffer(raw, np.uint8).reshape(n_planes, n_columns, n)
    columns = np.zeros(planes.shape[1:], np.uint64)  # [C, N]
    for p, plane in enumerate(planes):
        columns |= plane.astype(np.uint64) << np.uint64(8 * p)
    return np.ascontiguousarray(columns.T)
