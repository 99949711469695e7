"""The loss of quality at each size of a model, with its standard error, and the search for the smallest size.

A *size* is a number of Gaussians. The same V photographs are measured before and after, so the drop is a mean of paired
differences d_v = PSNR_v(before) - PSNR_v(after), in which the difficulty of each photograph cancels::

    drop = mean of d_v,   standard error = sqrt(sum (d_v - drop)^2 / (V - 1) / V)

A size is within a limit if its drop plus one standard error is. The search goes down from all Gaussians. Its first
step is the smallest that is worth making; if that is not within the limit, nothing is, and the search ends. The least
important Gaussians go first, so each further step costs more. With ``x = log(all / size)`` the drop rises about with
the square of x, which gives the next size, and at least in proportion to x: once a drop w at x is within the limit,
nothing beyond ``x limit / w`` is, and the search ends where that is no worthwhile step away. Between a size within
the limit and one that is not, it halves the interval of x.

There is no knee. Where the PSNR falls evenly with the logarithm of the count, as it does once a training has removed
what it does not need, the place of a knee depends on the first and last measured size, and may cost many dB.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from minisplat_ref.app.runs.progress import PSNR_MAX

STEP = 2**0.5  # ratio of neighbouring sizes while all are within the limit, at most
CLOSE = 1.1  # ratio of the smallest worthwhile step, and of the result to any smaller size that might do, at the end


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
    best = smallest_within(points, max_drop)
    if best is None:
        size = min(int(n / CLOSE), n_candidates)
        return size if 0 < size < n and not points else None
    upper = best.n_gaussians
    lower = max((point.n_gaussians for point in points if point.n_gaussians < upper), default=None)
    if upper <= CLOSE * max(lower or 0, _smallest_possible(best, n, max_drop)):
        return None
    if lower is not None:
        size = round((lower * upper) ** 0.5)
    else:
        x = np.log(n / upper)
        ratio = STEP if best.worst <= 0 else np.exp(x * (np.sqrt(max_drop / best.worst) - 1.0))
        size = int(upper / np.clip(ratio, CLOSE, STEP))
    return size if (lower or 0) < size < upper else None


def _smallest_possible(best: Point, n: int, max_drop: float) -> float:
    """Return the Gaussians below which nothing is within the limit, if the drop is at least in proportion to x."""
    return 0.0 if best.drop <= 0 else float(n * (best.n_gaussians / n) ** (max_drop / best.drop))


def count_sizes(points: Sequence[Point], n: int, n_candidates: int, max_drop: float) -> tuple[int, int | None]:
    """Return how many sizes the search has yet to measure, at least and at most; None where that is open.

    Parameters
    ----------
    points, n, n_candidates, max_drop
        As for :func:`next_size`.
    """
    size = next_size(points, n, n_candidates, max_drop)
    if size is None:
        return 0, 0
    best = smallest_within(points, max_drop)
    if best is None or best.drop <= 0:
        return 1, None
    # The drop of the next size is at least in proportion to x, and may be more than the limit.
    least = best.drop * np.log(size / n) / np.log(best.n_gaussians / n)
    outcomes = [Point(size, 0, (), (), drop, 0.0) for drop in (least, np.inf)]
    further = [count_sizes([*points, outcome], n, n_candidates, max_drop)[1] or 0 for outcome in outcomes]
    return 1, 1 + max(further)


def smallest_within(points: Sequence[Point], max_drop: float) -> Point | None:
    """Return the smallest size whose drop, plus one standard error, is at most ``max_drop`` dB; None if none is."""
    within = (point for point in points if point.worst <= max_drop)
    return min(within, key=lambda point: point.n_gaussians, default=None)
