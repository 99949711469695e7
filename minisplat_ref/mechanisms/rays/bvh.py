"""A bounding volume hierarchy, with which a ray skips whole branches that it misses.

Each inner node splits its Gaussians at the median of the centres, along the axis on which they spread most, until at
most ``LEAF`` are left. It stores the boxes of both halves, so that a step reads one row of each table.

The box of a Gaussian contains the ellipsoid on which alpha has fallen to ``alpha_min``; its half-length along axis j is
``sqrt(q Sigma_jj)`` with ``q = 2 ln(o / alpha_min)``. It is slightly enlarged, so that rounding never excludes a ray
that grazes it.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.jit.compile import kernel, scalar
from minisplat_ref.types import Floats, Ints

LEAF = 8
LEVELS_MAX = 64  # of a balanced tree: more than 2^63 leaves
IS_INNER = -1
SLACK = 1e-9  # of a box, relative to its size and to its distance from the origin


class Tree(NamedTuple):
    """A bounding volume hierarchy with K inner nodes; row 0 is the root."""

    boxes: Floats
    """[K, 2, 6] of both halves: low x, y, z, high x, y, z."""
    children: Ints
    """[K, 2, 2] int32: a node and ``IS_INNER``, or the first row of a leaf and how many it has."""
    rows: Ints
    """[N] int32 rows of the Gaussians, leaf after leaf."""


def build(low: Floats, high: Floats) -> Tree:
    """Return the tree of N boxes.

    Parameters
    ----------
    low, high : ndarray of shape (N, 3)
        Opposite corners, float64 and finite, world frame. N may be 0.
    """
    n_nodes = max(1, len(low))
    size = SLACK * (high - low + np.maximum(np.abs(low), np.abs(high)))
    tree = Tree(np.empty((n_nodes, 2, 6)), np.zeros((n_nodes, 2, 2), np.int32), np.arange(len(low), dtype=np.int32))
    used = _split_all(low - size, high + size, tree)
    return Tree(tree.boxes[:used].copy(), tree.children[:used].copy(), tree.rows)


@scalar
def select_median(rows: Ints, first: int, end: int, middle: int, low: Floats, high: Floats, axis: int) -> None:
    """Reorder ``rows[first:end]`` so that the centres before ``middle`` are no larger than those after it."""
    left, right = first, end - 1
    while left < right:
        pivot = low[rows[middle], axis] + high[rows[middle], axis]
        i, j = left, right
        while i <= j:
            while low[rows[i], axis] + high[rows[i], axis] < pivot:
                i += 1
            while pivot < low[rows[j], axis] + high[rows[j], axis]:
                j -= 1
            if i <= j:
                rows[i], rows[j] = rows[j], rows[i]
                i += 1
                j -= 1
        if j < middle:
            left = i
        if middle < i:
            right = j


@scalar
def widest_axis(rows: Ints, first: int, end: int, low: Floats, high: Floats) -> int:
    """Return the axis on which the centres spread most."""
    widest, axis = -1.0, 0
    for k in range(3):
        least, most = np.inf, -np.inf
        for i in range(first, end):
            twice = low[rows[i], k] + high[rows[i], k]
            least, most = min(least, twice), max(most, twice)
        if most - least > widest:
            widest, axis = most - least, k
    return axis


@kernel(parallel=False)
def _split_all(low: Floats, high: Floats, tree: Tree) -> int:
    """Fill the tree from the root down, and return the number of its nodes."""
    firsts, ends = np.zeros(LEVELS_MAX, np.int64), np.zeros(LEVELS_MAX, np.int64)
    nodes = np.zeros(LEVELS_MAX, np.int64)
    ends[0] = len(tree.rows)
    n_waiting, used = 1, 1
    while n_waiting > 0:
        n_waiting -= 1
        first, end, node = firsts[n_waiting], ends[n_waiting], nodes[n_waiting]
        middle = (first + end) // 2
        if end - first > 1:
            axis = widest_axis(tree.rows, first, end, low, high)
            select_median(tree.rows, first, end, middle, low, high, axis)
        for side in range(2):
            begin, stop = (first, middle) if side == 0 else (middle, end)
            for k in range(3):
                tree.boxes[node, side, k], tree.boxes[node, side, 3 + k] = np.inf, -np.inf
                for i in range(begin, stop):
                    tree.boxes[node, side, k] = min(tree.boxes[node, side, k], low[tree.rows[i], k])
                    tree.boxes[node, side, 3 + k] = max(tree.boxes[node, side, 3 + k], high[tree.rows[i], k])
            if stop - begin <= LEAF:
                tree.children[node, side, 0], tree.children[node, side, 1] = begin, stop - begin
            else:
                tree.children[node, side, 0], tree.children[node, side, 1] = used, IS_INNER
                firsts[n_waiting], ends[n_waiting], nodes[n_waiting] = begin, stop, used
                n_waiting += 1
                used += 1
    return used
