"""The loss of quality at each size of a model, with its standard error, and the search for the smallest size.

A *size* is a number of Gaussians. The same V photographs are measured before and after, so the drop is a mean of paired
differences d_v = PSNR_v(before) - PSNR_v(after), in which the difficulty of each photograph cancels::

    drop = mean of d_v,   standard error = sqrt(sum (d_v - drop)^2 / (V - 1) / V)

A size is within a limit if its drop plus one standard error is. The search goes down from all Gaussians by factors of
sqrt(2) to the first size that is not within the limit, and then halves the interval on a logarithmic scale.

There is no knee. Where the PSNR falls evenly with the logarithm of the count, as it does once a training has removed
what it does not need, the place of a knee depends on the first and last measured size, and may cost many dB.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from minisplat_ref.app.runs.progress import PSNR_MAX

STEP = 2**0.5  # ratio of neighbouring sizes while all are within the limit
CLOSE = 1.1  # ratio of the smallest size within the limit to the next smaller one, at which the search ends


class Point(NamedTuple):
    """One size, measured."""

    n_gaussians: int
    n_bytes: int
    """Of the PLY."""
    psnrs: tuple[float, ...]
    """dB, of each view."""
    ssims: tuple[float, ...]
    """Of each view."""
    drop: float
    """dB, mean over the views; 0 for all Gaussians."""
    standard_error: float
    """dB, of the drop."""

    @property
    def psnr(self) -> float:
        """Mean of the views, dB."""
        return float(np.mean(self.psnrs))

    @property
    def ssim(self) -> float:
        """Mean of the views."""
        return float(np.mean(self.ssims))

    @property
    def worst(self) -> float:
        """The drop plus its standard error, dB, which has to be within a limit."""
        return self.drop + self.standard_error


class PlySize(NamedTuple):
    """Bytes of a PLY, which are known before it is written."""

    header: int
    """Without the digits of the number of rows."""
    row: int

    def of(self, n: int) -> int:
        """Return the bytes of a file with ``n`` rows."""
        return self.header + len(str(n)) + n * self.row

    def max_rows(self, n_bytes: int) -> int:
        """Return the most rows that a file of at most ``n_bytes`` has; 0 where not even one fits."""
        n = max(0, (n_bytes - self.header) // self.row)
        while n > 0 and self.of(n) > n_bytes:
            n -= 1
        return n


def paired_drop(before: Sequence[float], after: Sequence[float]) -> tuple[float, float]:
    """Return the mean drop of the PSNR and its standard error, by the equations above.

    Parameters
    ----------
    before, after : sequence of V floats
        dB, of the same views; values above ``PSNR_MAX``, such as that of equal images, count as that.

    Returns
    -------
    drop, standard_error : float
        dB. The standard error of one view is NaN.
    """
    d = np.minimum(before, PSNR_MAX) - np.minimum(after, PSNR_MAX)  # [V]
    V = len(d)
    if V < 2:
        return float(d.mean()), float("nan")
    return float(d.mean()), float(np.sqrt(np.sum((d - d.mean()) ** 2) / (V - 1) / V))


def next_size(points: Sequence[Point], n: int, n_candidates: int, max_drop: float) -> int | None:
    """Return the size to measure next, on the way to the smallest one within a limit; None where it has been found.

    Parameters
    ----------
    points : sequence of Point
        The sizes that have been measured, smaller than ``n``, in any order.
    n : int
        All Gaussians, which lose nothing.
    n_candidates : int
        Those of any importance, at most ``n``: no size is larger.
    max_drop : float
        dB, for the drop plus one standard error.
    """
    upper = min((point.n_gaussians for point in points if point.worst <= max_drop), default=n)
    lower = max((point.n_gaussians for point in points if point.n_gaussians < upper), default=None)
    if lower is None:
        size = min(round(upper / STEP), n_candidates)
    elif upper <= CLOSE * lower:
        return None
    else:
        size = round((lower * upper) ** 0.5)
    return size if (lower or 0) < size < upper and size <= n_candidates else None


def smallest_within(points: Sequence[Point], max_drop: float) -> Point | None:
    """Return the smallest size whose drop, plus one standard error, is at most ``max_drop`` dB; None if none is."""
    within = (point for point in points if point.worst <= max_drop)
    return min(within, key=lambda point: point.n_gaussians, default=None)
