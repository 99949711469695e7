"""Eight rays on their way through a tree of boxes.

Eight rays go together, as lanes: a box, or the contents of a leaf, is tested if any of them may meet it. Each keeps its
own hits, sorted by t. Once those that a ray has found let less light through than it may end with, no hit beyond the
last of them counts, and no box that begins there: this bound moves nearer as hits are found. It is exact, because other
primitives in front can only dim the ray more.
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.gaussian_rows import eight_rows
from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import WIDTH, gather, load, maximum, minimum, reduce_any, reduce_max, select, store
from minisplat_ref.mechanisms.rays.bvh import IS_INNER, LEVELS_MAX
from minisplat_ref.types import Floats, Ints

OPACITY = 0  # column of a record; the others are the extension's
TINY = 1e-300  # replaces zero components of a direction, so that no infinity is multiplied by zero
END_MARGIN = 0.999  # of the least transmittance, so that rounding does not decide what the bound omits


class Limits(NamedTuple):
    """The thresholds in the form that the kernels use."""

    alpha_min: float
    alpha_max: float
    transmittance_min: float
    stops_at_equality: bool
    capacity: int
    """Largest number of hits that a ray stores."""


class RayTree(NamedTuple):
    """The primitives of a tree, in the order of its leaves: whole Gaussians, or parts of them such as triangles."""

    records: Floats
    """[N', C] of those that can be seen at all; the column ``OPACITY`` is the opacity."""
    gaussian_ids: Ints
    """[N'] int32 their rows in the population."""
    boxes: Floats
    """[K, 2, 6], as in :class:`~minisplat_ref.mechanisms.rays.bvh.Tree`; a bundle of a kernel holds no other bundle."""
    children: Ints
    """[K, 2, 2] as in :class:`.bvh.Tree`."""
    n: int
    """Number of Gaussians of the population."""


class Found(NamedTuple):
    """The hits of eight rays, nearest first, and the stack of nodes that they still have to visit; one per thread."""

    depths: Floats  # [8, capacity]
    unclamped: Floats  # [8, capacity]
    rows: Ints  # [8, capacity] of the tree
    counts: Ints  # [8]
    left: Floats  # [8] transmittance behind all hits
    bounds: Floats  # [8] t beyond which nothing counts
    nodes: Ints  # [LEVELS_MAX]
    entries: Floats  # [LEVELS_MAX] a lower bound of t in the node
    t: Floats  # [8] of one Gaussian
    q: Floats  # [8] of it; infinite where it is missed


@scalar
def empty_lists(capacity):
    """Return empty lists with room for ``capacity`` hits per ray."""
    return Found(
        np.empty((WIDTH, capacity), np.float64),
        np.empty((WIDTH, capacity), np.float64),
        np.empty((WIDTH, capacity), np.int64),
        np.empty(WIDTH, np.int64),
        np.empty(WIDTH, np.float64),
        np.empty(WIDTH, np.float64),
        np.empty(LEVELS_MAX, np.int64),
        np.empty(LEVELS_MAX, np.float64),
        np.empty(WIDTH, np.float64),
        np.empty(WIDTH, np.float64),
    )


@scalar
def inverse_of(d):
    """Return 1 / d, large where d is zero."""
    return 1.0 / select(abs(d) > TINY, d, TINY)


@scalar
def entry(boxes, node, side, line):
    """Return the t at which lines enter and leave a box; they miss it where the former is larger."""
    ox, oy, oz, ix, iy, iz = line
    x0, x1 = (boxes[node, side, 0] - ox) * ix, (boxes[node, side, 3] - ox) * ix
    y0, y1 = (boxes[node, side, 1] - oy) * iy, (boxes[node, side, 4] - oy) * iy
    z0, z1 = (boxes[node, side, 2] - oz) * iz, (boxes[node, side, 5] - oz) * iz
    t0 = maximum(maximum(minimum(x0, x1), minimum(y0, y1)), minimum(z0, z1))
    t1 = minimum(minimum(maximum(x0, x1), maximum(y0, y1)), maximum(z0, z1))
    return t0, t1


@scalar
def ray_of(rays, r):
    """Return origin and direction of ray r."""
    origins, directions = rays.origins, rays.directions
    return origins[r, 0], origins[r, 1], origins[r, 2], directions[r, 0], directions[r, 1], directions[r, 2]


@scalar
def rays_of(rays, rows):
    """Return origins and directions of eight rays."""
    origins, directions = rays.origins, rays.directions
    return (
        gather(origins, rows, 0),
        gather(origins, rows, 1),
        gather(origins, rows, 2),
        gather(directions, rows, 0),
        gather(directions, rows, 1),
        gather(directions, rows, 2),
    )


def limits_of(conventions: Conventions, n: int) -> Limits:
    """Return the thresholds of conventions, and the number of hits that a ray through n Gaussians has to store.

    Each hit takes at least ``alpha_min`` of the light, which bounds that number.
    """
    least = END_MARGIN * conventions.transmittance_min
    capacity = n
    if least > 0 and conventions.alpha_min > 0:
        capacity = min(n, math.ceil(math.log(least) / math.log1p(-min(conventions.alpha_min, 0.5))))
    return Limits(
        conventions.alpha_min,
        conventions.alpha_max,
        conventions.transmittance_min,
        conventions.stops_at_equality,
        capacity + 2,
    )


@functools.cache
def finder(meet: Callable) -> Callable:
    """Return the function that finds the hits of eight rays.

    Parameters
    ----------
    meet : callable
        ``meet(records, row, ray)`` returns t and the squared distance q from the centre in standard deviations, of
        eight rays and a row of the tree; alpha is ``o exp(-q / 2)``, and q infinite where a ray misses.
    """

    @scalar
    def find_hits(tree, rays, first, end, limits, found):
        """Fill ``found`` with all hits that may count, of the eight rays from ``first`` on, or fewer before ``end``.

        One long loop: of every array that a helper with branches is given, references would be counted, which takes
        longer than what the helper does.
        """
        records, ids, boxes, children = tree.records, tree.gaussian_ids, tree.boxes, tree.children
        depths, alphas, rows, counts, left, bounds, nodes, entries, ts, qs = found
        least, alpha_min, alpha_max = END_MARGIN * limits.transmittance_min, limits.alpha_min, limits.alpha_max
        eight = eight_rows(first, end)
        ray, near, far = rays_of(rays, eight), gather(rays.near, eight, 0), gather(rays.far, eight, 0)
        line = ray[0], ray[1], ray[2], inverse_of(ray[3]), inverse_of(ray[4]), inverse_of(ray[5])
        bound, farthest = far, reduce_max(far)
        store(bounds, 0, far)
        for k in range(WIDTH):
            counts[k], left[k] = 0, 1.0
        nodes[0], entries[0] = 0, -np.inf
        n_waiting = 1
        while n_waiting > 0:
            n_waiting -= 1
            if entries[n_waiting] > farthest:
                continue
            node = nodes[n_waiting]
            a0, a1 = entry(boxes, node, 0, line)
            b0, b1 = entry(boxes, node, 1, line)
            a_is_met = reduce_any((a0 <= a1) & (a1 >= near) & (a0 <= bound))
            b_is_met = reduce_any((b0 <= b1) & (b1 >= near) & (b0 <= bound))
            a_entry, b_entry = -reduce_max(-a0), -reduce_max(-b0)
            nearer = 0 if a_entry <= b_entry else 1
            for step in range(2):  # push nodes, the farther one first
                side = nearer if step == 1 else 1 - nearer
                if children[node, side, 1] == IS_INNER and (a_is_met if side == 0 else b_is_met):
                    nodes[n_waiting], entries[n_waiting] = children[node, side, 0], a_entry if side == 0 else b_entry
                    n_waiting += 1
            for step in range(2):  # test leaves, the nearer one first
                side = nearer if step == 0 else 1 - nearer
                if children[node, side, 1] == IS_INNER or not (a_is_met if side == 0 else b_is_met):
                    continue
                for row in range(children[node, side, 0], children[node, side, 0] + children[node, side, 1]):
                    t, q = meet(records, row, ray)
                    is_met = (q < np.inf) & (near < t) & (t < far) & (t <= bound)
                    if not reduce_any(is_met):
                        continue
                    store(ts, 0, t)
                    store(qs, 0, select(is_met, q, np.inf))
                    for k in range(WIDTH):
                        if qs[k] == np.inf:
                            continue
                        unclamped = records[row, OPACITY] * math.exp(-0.5 * qs[k])
                        alpha = min(alpha_max, unclamped)
                        if alpha < alpha_min:
                            continue
                        t_k, n = ts[k], counts[k]
                        i = n
                        while i > 0 and (
                            depths[k, i - 1] > t_k or (depths[k, i - 1] == t_k and ids[rows[k, i - 1]] > ids[row])
                        ):
                            depths[k, i] = depths[k, i - 1]
                            alphas[k, i] = alphas[k, i - 1]
                            rows[k, i] = rows[k, i - 1]
                            i -= 1
                        depths[k, i], alphas[k, i], rows[k, i] = t_k, unclamped, row
                        n += 1
                        T = left[k] * (1.0 - alpha)
                        while n > 1 and T < least:  # does the last still count behind the new one?
                            without = T / (1.0 - min(alpha_max, alphas[k, n - 1]))
                            if without >= least:
                                break
                            n -= 1
                            T = without
                        left[k], counts[k] = T, n
                        if T < least:
                            bounds[k] = depths[k, n - 1]
                    bound = load(bounds, 0)
            farthest = reduce_max(bound)

    return find_hits
