"""Centres in a file: half floats of their offset from one point, in Morton order, as differences in planes of bytes.

A half float's bits, read as a whole number with its sign, ascend as the halves do. So neighbours in the order differ
by small whole numbers, and decoding is exact.
"""

from typing import Any

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.io.packing.planes import unzigzag, zigzag
from minisplat_ref.types import Floats

LARGEST_HALF = 65504.0
FARTHEST = 1e30  # distance of a centre of the scene from the origin along an axis


def to_halves(values: Floats, name: str) -> Floats:
    """Return values as half floats.

    Raises
    ------
    InputError
        They are too large; ``name`` is their name.
    """
    if not np.abs(values).max(initial=0.0) <= LARGEST_HALF:
        raise InputError(
            f"{name} reach {np.abs(values).max():.3g}, but half floats {LARGEST_HALF:g}: choose another format"
        )
    return values.astype(np.float16)


def to_differences(halves: Floats) -> Any:
    """Return half floats [N, 3] as unsigned integers, the differences from row to row of their ordered bits."""
    bits = halves.view(np.int16).astype(np.int64)
    ordered = np.where(bits < 0, -(bits & 0x7FFF), bits)  # both zeros are 0
    return zigzag(np.diff(ordered, axis=0, prepend=0))


def from_differences(differences: Any) -> Floats:
    """Return the half floats [N, 3] of :func:`to_differences`."""
    ordered = np.cumsum(unzigzag(differences), axis=0)
    halves: Floats = np.where(ordered < 0, -ordered | 0x8000, ordered).astype(np.uint16).view(np.float16)
    return halves
