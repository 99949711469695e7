"""How far two arrays are apart, with what rounding decides set aside."""

from typing import NamedTuple

import numpy as np

from minisplat_ref.types import Bools, Floats


class Difference(NamedTuple):
    """Of one array from the truth's."""

    max_error: float
    """Largest |given - expected|; infinite where one of them is not finite."""
    rms_error: float
    """Root of the mean square of the same."""
    scale: float
    """Largest |expected|, or 1 where all is zero."""
    tolerance: float
    """Allowed part of the scale."""
    n_over: int
    """Number of values that are off by more."""
    n: int
    """Number of values that were compared."""
    n_flips: int = 0
    """Number of values that were set aside as flips, being off by more."""

    @property
    def relative(self) -> float:
        """Largest error as a part of the scale."""
        return self.max_error / self.scale

    @property
    def excess(self) -> float:
        """Largest error in units of what is allowed; above 1 it diverges."""
        return self.relative / self.tolerance if self.tolerance else np.inf * (self.max_error > 0)


def difference(given: Floats, expected: Floats, tolerance: float, may_flip: Bools | None = None) -> Difference:
    """Compare two arrays of one shape, value by value.

    Parameters
    ----------
    given, expected : ndarray
        The other renderer's and the truth's.
    tolerance : float
        Part of the largest expected value that a value may be off.
    may_flip : ndarray of bool, optional
        Places, along the first axes, that rounding decides. They are neither averaged in nor failed, but counted
        where they are off.

    Returns
    -------
    Difference
        Zeros for empty arrays.
    """
    given, expected = np.asarray(given, np.float64), np.asarray(expected, np.float64)
    is_compared = np.ones(expected.shape, bool)
    if may_flip is not None:
        is_compared &= ~may_flip.reshape(may_flip.shape + (1,) * (expected.ndim - may_flip.ndim))
    with np.errstate(invalid="ignore"):
        errors = np.abs(given - expected)
    errors = np.where(np.isfinite(errors), errors, np.inf)
    scale = float(np.max(np.abs(expected), initial=0)) or 1.0
    is_over = errors > tolerance * scale
    compared = errors[is_compared]
    if compared.size == 0:
        return Difference(0.0, 0.0, scale, tolerance, 0, 0, int(is_over.sum()))
    return Difference(
        max_error=float(compared.max()),
        rms_error=float(np.sqrt(np.mean(compared**2))),
        scale=scale,
        tolerance=tolerance,
        n_over=int((is_over & is_compared).sum()),
        n=int(is_compared.sum()),
        n_flips=int((is_over & ~is_compared).sum()),
    )
