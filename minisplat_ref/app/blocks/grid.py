"""Blocks on the ground: a plane through the cameras, cores with equal numbers of them, and regions around the cores."""

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from minisplat_ref.app.runs.scene_part import Box, Plane
from minisplat_ref.errors import InputError
from minisplat_ref.types import Floats

OVERLAP = 0.2  # of a core's width, which its region adds on each side: 20 % as in VastGaussian
FLAT = 1e-6  # of the cameras' extent: a thinner region has no width to divide


class Block(NamedTuple):
    """One block of the grid."""

    name: str
    """Its indices along the first and the second axis, such as ``0-1``."""
    core: Box
    """The part that the merged model takes; the outermost cores have no outer edge."""
    region: Box
    """The part that it trains: the core and its surroundings."""
    n_cameras: int
    """In the core."""


def ground_plane(centers: Floats) -> Plane:
    """Return the plane in which cameras are spread most: the principal plane of their centres.

    Parameters
    ----------
    centers : ndarray of shape (V, 3)
        In the frame of the files.

    Returns
    -------
    Plane
        Through their mean. The first axis is that of the greatest spread; of each axis the largest component is
        positive.
    """
    origin = centers.mean(axis=0)
    _, _, axes = np.linalg.svd(centers - origin, full_matrices=False)  # rows by falling spread
    axes = axes[:2]
    largest = axes[np.arange(2), np.abs(axes).argmax(axis=1)]
    return Plane(origin, axes * np.sign(largest)[:, None])


def divide(coordinates: Floats, shape: tuple[int, int]) -> list[Block]:
    """Return the blocks of a grid: slabs along the first axis, each divided along the second.

    Parameters
    ----------
    coordinates : ndarray of shape (V, 2)
        Of the cameras on the plane.
    shape : pair of int
        Slabs, and blocks of a slab.

    Returns
    -------
    list of Block
        Row by row. Their cores are disjoint and cover the plane.

    Raises
    ------
    InputError
        There are too few cameras, or too many are in one line to be divided like this.
    """
    n_slabs, n_in_slab = shape
    reach = float(np.ptp(coordinates, axis=0).max())
    blocks = []
    for i, (low, high) in enumerate(_intervals(coordinates[:, 0], n_slabs, reach, shape)):
        in_slab = coordinates[(coordinates[:, 0] >= low) & (coordinates[:, 0] < high)]
        for k, (bottom, top) in enumerate(_intervals(in_slab[:, 1], n_in_slab, reach, shape)):
            core = Box((low, bottom), (high, top))
            inside = in_slab[core.contains(in_slab)]
            blocks.append(Block(f"{i}-{k}", core, widen(core, inside), len(inside)))
    return blocks


def widen(core: Box, inside: Floats) -> Box:
    """Return a core with its surroundings; where it has no edge, its cameras [V, 2] determine its width."""
    low, high = [], []
    for axis in range(2):
        first = core.low[axis] if math.isfinite(core.low[axis]) else float(inside[:, axis].min())
        last = core.high[axis] if math.isfinite(core.high[axis]) else float(inside[:, axis].max())
        margin = OVERLAP * (last - first)
        low.append(core.low[axis] - margin)
        high.append(core.high[axis] + margin)
    return Box((low[0], low[1]), (high[0], high[1]))


def _intervals(values: Floats, n: int, reach: float, shape: tuple[int, int]) -> Iterator[tuple[float, float]]:
    """Give n half-open intervals that cover the line, with equal numbers of the values, within one."""
    ordered = np.sort(values)
    last = [k * len(ordered) // n for k in range(1, n)]  # of the next interval: the first value
    if len(ordered) < n:
        raise _undividable(shape, f"a slab has {len(ordered)} cameras for {n} blocks")
    if any(ordered[k] - ordered[k - 1] <= FLAT * reach for k in last):
        raise _undividable(shape, "cameras stand side by side where blocks would be divided")
    edges = [-math.inf, *(0.5 * float(ordered[k - 1] + ordered[k]) for k in last), math.inf]
    yield from pairwise(edges)


def _undividable(shape: Sequence[int], why: str) -> InputError:
    a, b = shape
    return InputError(
        f"--blocks {a}x{b} cannot be made, {why}: give fewer, such as {max(1, a // 2)}x1, or leave --blocks out"
    )
