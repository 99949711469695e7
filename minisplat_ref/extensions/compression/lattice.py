"""Uniform quantisation to lattices whose steps are powers of two, with error bounds that hold to the last bit.

A value x becomes the integer ``q = rint(x / step)`` and comes back as ``q step``, so ``|q step - x| <= step / 2``. With
``step = 2^e`` this bound is exact, because dividing by a power of two is exact. If x is a float32, so is the result:
where ``|q| <= 2^24`` it has 24 bits, and where ``|q|`` is larger, adjacent float32 numbers are further apart than the
lattice, so x is on it. A value on the lattice stays where it is, hence encoding decoded values again gives the same
integers.

A quaternion q, whose length has no meaning, is divided by its largest component. That becomes 1, the others are in
[-1, 1], and the sign is chosen so that the first component of magnitude 1 is +1. The integers decide all this, so it is
the same in a second encoding. The three others are off by at most ``step / 2`` each; as |q| >= 1, the rotation is off
by at most ``2 asin(sqrt(3) step / 2)``.
"""

import math
from typing import NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.types import Floats, Ints

LARGEST = 2**52  # of a lattice's integers: float64 holds them, and their differences, exactly


def to_lattice(values: Floats, exponent: int, name: str) -> Ints:
    """Return ``rint(x / 2^e)`` as int64.

    Parameters
    ----------
    values : ndarray of float32
        x, of any shape; finite.
    exponent : int
        e.
    name : str
        What the values are, for the message.

    Raises
    ------
    InputError
        A value is more than 2^52 steps from zero.
    """
    scaled = np.ldexp(values.astype(np.float64), -exponent)
    if not np.abs(scaled).max(initial=0.0) <= LARGEST:
        raise InputError(
            f"{name} reach {np.abs(values).max():.3g}, too far for steps of 2^{exponent}: remove the outliers, or"
            " write the exact level, --level 0"
        )
    return np.rint(scaled).astype(np.int64)


def from_lattice(integers: Ints, exponent: int) -> Floats:
    """Return ``q 2^e`` as float32."""
    with np.errstate(over="ignore"):  # of damaged files; values are checked to be finite
        return np.ldexp(integers.astype(np.float64), exponent).astype(np.float32)


class Rotations(NamedTuple):
    """Quaternions divided by their largest components, on the lattice."""

    largest: Ints
    """[N] index of the component that is 1, in the order w, x, y, z."""
    others: Ints
    """[N, 3] the remaining components in their order, integers of at most ``1 / step`` in magnitude."""


def to_rotations(quats: Floats, exponent: int) -> Rotations:
    """Return the quaternions divided by their largest components, quantised.

    Parameters
    ----------
    quats : ndarray of shape (N, 4)
        wxyz, of any length but zero.
    exponent : int
        e of the step 2^e, at most 0.
    """
    quats = quats.astype(np.float64)
    one = 2**-exponent
    integers = np.rint(quats / np.abs(quats).max(axis=1, initial=0.0)[:, None] * one).astype(np.int64)  # [N, 4]
    largest = np.argmax(np.abs(integers) == one, axis=1)  # [N] the first
    integers *= np.sign(np.take_along_axis(integers, largest[:, None], axis=1))
    return Rotations(largest, integers[_is_other(largest)].reshape(-1, 3))


def from_rotations(rotations: Rotations, exponent: int) -> Floats:
    """Return quaternions [N, 4] wxyz in float32 whose largest component is 1."""
    quats = np.ones((len(rotations.largest), 4), np.float32)
    quats[_is_other(rotations.largest)] = from_lattice(rotations.others, exponent).reshape(-1)
    return quats


def _is_other(largest: Ints) -> np.ndarray:
    """Return [N, 4], False for the largest component."""
    return np.arange(4) != largest[:, None]


def rotation_bound(exponent: int) -> float:
    """Return the largest error of a quantised rotation, radians; the step is ``2^exponent``."""
    return 2.0 * math.asin(min(1.0, math.sqrt(3.0) * 2.0**exponent / 2.0))
