"""The levels of precision of ``.msz``, and the step that each gives to each field.

Level 0 keeps every float32. From level 1 to 12 geometry and colours alternately become coarser by a factor of two, so
every second level takes one bit less for every number.

The step of the centres must fit the scene: it is a fraction of the size of the small Gaussians. That size is computed
from scales that are already quantised, or a second encoding might choose another step.
"""

import math
from typing import NamedTuple

import numpy as np

from minisplat_ref.types import Ints

N_LEVELS = 13
DEFAULT = 5
SMALL = 0.1  # quantile of the Gaussians' middle standard deviations that represents the small ones


class Exponents(NamedTuple):
    """The step of each field, as a power of two."""

    means: int
    """Relative to the size of the small Gaussians; in a file, world units."""
    quats: int
    """Of components relative to the largest one."""
    log_scales: int
    opacity_logits: int
    sh_dc: int
    sh_rest: int


# Chosen so that at level 8 each field alone costs less than 0.03 dB in a short training of a phone video. Higher
# harmonics need the finest step, because the errors of all 45 add up in one colour.
FINEST = Exponents(means=-7, quats=-10, log_scales=-8, opacity_logits=-6, sh_dc=-8, sh_rest=-9)
"""Of level 1."""


def exponents(level: int) -> Exponents:
    """Return the exponents of a level from 1 to 12; that of the means is relative."""
    geometry, color = level // 2, (level - 1) // 2  # bits that are dropped
    coarser = Exponents(geometry, geometry, geometry, color, color, color)
    return Exponents(*(finest + bits for finest, bits in zip(FINEST, coarser, strict=True)))


def size_exponent(log_scales: Ints, exponent: int) -> int:
    """Return e such that 2^e is the size of the small Gaussians, rounded down.

    Parameters
    ----------
    log_scales : ndarray of shape (N, 3)
        Integers on the lattice of step 2^exponent. The middle one of the three counts, so that flat Gaussians may be as
        thin as they are.
    exponent : int
        Of the step of ``log_scales``.
    """
    if len(log_scales) == 0:
        return 0
    middle = np.median(log_scales, axis=1)  # [N] one of the three
    small = float(np.quantile(middle, SMALL, method="lower")) * 2.0**exponent
    return math.floor(min(max(small / math.log(2.0), -100.0), 60.0))


def describe_levels() -> tuple[str, ...]:
    """Return a short description of each level."""
    return ("exact", *(f"log scales in steps of 2^{exponents(level).log_scales}" for level in range(1, N_LEVELS)))
