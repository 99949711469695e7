"""Traversal of a tree by eight rays, and the formulas of one ray and one Gaussian.

Eight rays are traced together as lanes: a box or a Gaussian is tested if any of them may hit it. Each ray keeps its own
hits, sorted by t. Once the hits that a ray has found transmit less light than the ray may end with, no hit beyond the
last of them counts, and no box that begins there; this bound moves nearer as more hits are found. It is exact, because
further hits in front can only dim the ray more.
"""

import math
from typing import NamedTuple

import numpy as np

from minisplat_ref.cpu.gaussian_rows import rows_from
from minisplat_ref.extensions.rays.bvh import IS_INNER, MOST_LEVELS
from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import WIDTH, gather, load, maximum, minimum, reduce_any, reduce_max, select, store
from minisplat_ref.types import Floats, Ints

MEAN, OPACITY, REACH = 9, 12, 13  # columns of a record, whose first nine are the map M
N_COLUMNS = 14
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


class Found(NamedTuple):
    """The hits of eight rays, nearest first, and the stack of nodes that they still have to visit; one per thread."""

    depths: Floats  # [8, capacity]
    unclamped: Floats  # [8, capacity]
    rows: Ints  # [8, capacity] of the scene
    counts: Ints  # [8]
    left: Floats  # [8] transmittance behind all hits
    bounds: Floats  # [8] t beyond which nothing counts
    nodes: Ints  # [MOST_LEVELS]
    entries: Floats  # [MOST_LEVELS] a lower bound of t in the node
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
        np.empty(MOST_LEVELS, np.int64),
        np.empty(MOST_LEVELS, np.float64),
        np.empty(WIDTH, np.float64),
        np.empty(WIDTH, np.float64),
    )


@scalar
def whitened(records, row, ray):
    """Return ``p = M (mu - O)`` and ``v = M d`` of one ray or of eight."""
    ox, oy, oz, dx, dy, dz = ray
    ux, uy, uz = records[row, MEAN] - ox, records[row, MEAN + 1] - oy, records[row, MEAN + 2] - oz
    p0 = records[row, 0] * ux + records[row, 1] * uy + records[row, 2] * uz
    p1 = records[row, 3] * ux + records[row, 4] * uy + records[row, 5] * uz
    p2 = records[row, 6] * ux + records[row, 7] * uy + records[row, 8] * uz
    v0 = records[row, 0] * dx + records[row, 1] * dy + records[row, 2] * dz
    v1 = records[row, 3] * dx + records[row, 4] * dy + records[row, 5] * dz
    v2 = records[row, 6] * dx + records[row, 7] * dy + records[row, 8] * dz
    return p0, p1, p2, v0, v1, v2


@scalar
def nearest_point(p0, p1, p2, v0, v1, v2):
    """Return t and ``e = p - t v``."""
    t = (v0 * p0 + v1 * p1 + v2 * p2) / (v0 * v0 + v1 * v1 + v2 * v2)
    return t, p0 - t * v0, p1 - t * v1, p2 - t * v2


@scalar
def inverse_of(d):
    """Return 1 / d, large where d is zero."""
    return 1.0 / select(abs(d) > TINY, d, TINY)


@scalar
def slab_interval(boxes, node, side, line):
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


@scalar
def find_hits(scene, rays, first, end, limits, found):
    """Fill ``found`` with all hits that may count of the eight rays from ``first`` on, or fewer before ``end``.

    This is one long loop, because a helper with branches would count references of every array that it is given, which
    takes longer than its work.
    """
    records, ids, boxes, children = scene.records, scene.ids, scene.boxes, scene.children
    depths, alphas, rows, counts, left, bounds, nodes, entries, ts, qs = found
    least, alpha_min, alpha_max = END_MARGIN * limits.transmittance_min, limits.alpha_min, limits.alpha_max
    eight = rows_from(first, end)
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
        a0, a1 = slab_interval(boxes, node, 0, line)
        b0, b1 = slab_interval(boxes, node, 1, line)
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
                t, e0, e1, e2 = nearest_point(*whitened(records, row, ray))
                q = e0 * e0 + e1 * e1 + e2 * e2
                is_met = (q <= records[row, REACH]) & (near < t) & (t < far) & (t <= bound)
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


@scalar
def pair_vjp(records, row, ray, unclamped, v_unclamped, v_t):
    """Return v_p and v_v; see the reference's ``evaluate_pairs_vjp``."""
    p0, p1, p2, v0, v1, v2 = whitened(records, row, ray)
    t, e0, e1, e2 = nearest_point(p0, p1, p2, v0, v1, v2)
    k = -unclamped * v_unclamped  # 2 v_q
    j = v_t / (v0 * v0 + v1 * v1 + v2 * v2)
    of_p = k * e0 + j * v0, k * e1 + j * v1, k * e2 + j * v2
    of_v = (
        j * (p0 - 2.0 * t * v0) - t * k * e0,
        j * (p1 - 2.0 * t * v1) - t * k * e1,
        j * (p2 - 2.0 * t * v2) - t * k * e2,
    )
    return of_p, of_v


@scalar
def times_transpose(records, row, v):
    """Return ``M^T v``."""
    return (
        records[row, 0] * v[0] + records[row, 3] * v[1] + records[row, 6] * v[2],
        records[row, 1] * v[0] + records[row, 4] * v[1] + records[row, 7] * v[2],
        records[row, 2] * v[0] + records[row, 5] * v[1] + records[row, 8] * v[2],
    )
