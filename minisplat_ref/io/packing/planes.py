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


def count_planes(largest: int) -> int:
    """Return the number of planes that integers up to ``largest`` need, at least one."""
    return max(1, -(-largest.bit_length() // 8))


def put_planes(planes: NDArray[np.uint8], rows: slice, values: NDArray[np.uint64]) -> None:
    """Store the integers [n, C] of some rows in planes [P, C, N]."""
    columns = np.ascontiguousarray(values.T)  # [C, n]
    for p, plane in enumerate(planes):
        plane[:, rows] = (columns >> np.uint64(8 * p)) & np.uint64(255)


def to_planes(values: NDArray[np.uint64]) -> tuple[bytes, int]:
    """Return the integers [N, C] as bytes [P, C, N], and the number of planes P that the largest one needs."""
    planes = np.empty((count_planes(int(values.max(initial=0))), values.shape[1], len(values)), np.uint8)
    put_planes(planes, slice(None), values)
    return planes.tobytes(), len(planes)


def from_planes(raw: bytes, n_planes: int, n_columns: int, n: int) -> NDArray[np.uint64]:
    """Return the integers [N, C] that :func:`to_planes` has stored as bytes [P, C, N]."""
    planes = np.frombuffer(raw, np.uint8).reshape(n_planes, n_columns, n)
    columns = np.zeros(planes.shape[1:], np.uint64)  # [C, N]
    for p, plane in enumerate(planes):
        columns |= plane.astype(np.uint64) << np.uint64(8 * p)
    return np.ascontiguousarray(columns.T)
