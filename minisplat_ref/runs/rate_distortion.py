"""How small a model may be: the drop of each size with its standard error, the rule that chooses one, and the knee.

A *size* is a number of Gaussians. The same V photographs are measured before and after, so the drop is a mean of paired
differences d_v = PSNR_v(before) - PSNR_v(after), in which what makes one photograph harder than another cancels::

    drop = mean of d_v,   standard error = sqrt(sum (d_v - drop)^2 / (V - 1) / V)

The knee is that of Kneedle (Satopaa et al. 2011): both axes go from 0 to 1, and the knee is where the curve lies
highest above its chord. The count is taken as a logarithm. Left out: Kneedle's smoothing and its threshold, for which
ten points are too few. The knee depends on where the curve begins and ends, so it decides only if nothing else does.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.runs.progress import PSNR_MAX

N_SIZES = 8
SIZES_PER_HALVING = 2  # so that the smallest is 1 / 16 of all


class Point(NamedTuple):
    """One size, measured."""

    n_gaussians: int
    n_bytes: int
    """Of the PLY."""
    psnrs: tuple[float, ...]
    """dB, of each view."""
    drop: float
    """dB, mean over the views; 0 for all Gaussians."""
    standard_error: float
    """dB, of the drop."""

    @property
    def psnr(self) -> float:
        """Mean of the views, dB."""
        return float(np.mean(self.psnrs))

    @property
    def worst(self) -> float:
        """The drop plus its standard error, dB: what has to be within a limit."""
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
        dB, of the same views; what is above ``PSNR_MAX``, as that of equal images is, counts as that.

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


def sizes(n: int, n_candidates: int, *further: int) -> list[int]:
    """Return the numbers of Gaussians to measure, ascending: a geometric series below ``n``, and ``further`` ones.

    Parameters
    ----------
    n : int
        Gaussians that there are.
    n_candidates : int
        Those of any importance, at most ``n``: no size is larger.
    *further : int
        At least 1 each.
    """
    series = (round(n * 2 ** (-k / SIZES_PER_HALVING)) for k in range(1, N_SIZES + 1))
    return sorted({min(max(1, size), n_candidates) for size in (*series, *further)})


def between(points: Sequence[Point], reference: Point, max_drop: float) -> int | None:
    """Return a size that tells more of where the limit lies: the geometric mean of two neighbours, one on either side.

    Parameters
    ----------
    points : sequence of Point
        Smaller than ``reference``.
    reference : Point
        All Gaussians, which lose nothing.
    max_drop : float
        dB, for the drop plus one standard error.

    Returns
    -------
    n_gaussians : int or None
        Between the smallest size within the limit and the next smaller one; None where there is none or no number lies
        between them.
    """
    upper = min(p.n_gaussians for p in (*points, reference) if p is reference or p.worst <= max_drop)
    lower = max((p.n_gaussians for p in points if p.n_gaussians < upper), default=upper)
    middle = round((lower * upper) ** 0.5)
    return middle if lower < middle < upper else None


def smallest_within(points: Sequence[Point], max_drop: float) -> Point:
    """Return the smallest size whose drop, plus one standard error, is at most ``max_drop`` dB.

    Raises
    ------
    InputError
        There is none.
    """
    within = [point for point in points if point.worst <= max_drop]
    if not within:
        best = min(points, key=lambda point: point.worst)
        raise InputError(
            f"no smaller model loses at most {max_drop:g} dB: {best.n_gaussians:,} Gaussians come nearest with"
            f" {best.drop:.3f} +- {best.standard_error:.3f} dB on {len(best.psnrs)} held-out training views; allow"
            " more, or a longer --fine-tune"
        )
    return min(within, key=lambda point: point.n_gaussians)


def knee(points: Sequence[Point]) -> Point:
    """Return the size where the PSNR over the logarithm of the count lies highest above its chord.

    Parameters
    ----------
    points : sequence of Point
        Of different sizes; of equals the smallest counts.
    """
    points = sorted(points, key=lambda point: point.n_gaussians)
    x = _unit(np.log([point.n_gaussians for point in points]))
    y = _unit(np.minimum([point.psnr for point in points], PSNR_MAX))
    return points[int(np.argmax(y - x))]


def _unit(values: np.ndarray) -> np.ndarray:
    """Return values moved to [0, 1]; zeros where all are equal."""
    span = np.ptp(values)
    return (values - values.min()) / span if span > 0 else np.zeros_like(values)
