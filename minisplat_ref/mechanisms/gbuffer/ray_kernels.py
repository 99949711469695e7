"""Surfels as kernels read them, their tree, and the loop that follows every ray through it."""

import functools
from collections.abc import Callable

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.jit.lanes import WIDTH
from minisplat_ref.jit.scheduling import dynamic_range, make_shared_counter
from minisplat_ref.mechanisms.rays.bvh import build
from minisplat_ref.mechanisms.rays.traversal import OPACITY, RayTree, empty_lists, finder
from minisplat_ref.types import Floats

CENTRE, U, V, NORMAL = 1, 4, 7, 10  # columns of a record beside the opacity; U and V are axes over deviations
RAYS_PER_PART = 64  # a multiple of eight


def tree_of(records: Floats, conventions: Conventions) -> RayTree:
    """Return the surfels with their tree; those that are too faint, without an area or not finite are left out.

    Alpha has fallen to ``alpha_min`` where ``u^2 + v^2 = 2 ln(o / alpha_min)``, so half of the box along axis j is
    ``sqrt(2 ln(o / alpha_min) (s_0^2 r_0j^2 + s_1^2 r_1j^2))``.
    """
    alpha_min = max(conventions.alpha_min, np.finfo(np.float64).tiny)
    seen = np.flatnonzero((records[:, OPACITY] >= alpha_min) & np.isfinite(records).all(axis=1))
    kept = records[seen]
    reach2 = 2 * np.log(kept[:, OPACITY] / alpha_min)
    squares = [axis**2 / np.sum(axis**2, axis=1, keepdims=True) ** 2 for axis in (kept[:, U:V], kept[:, V:NORMAL])]
    half = np.sqrt(reach2[:, None] * (squares[0] + squares[1]))
    tree = build(kept[:, CENTRE:U] - half, kept[:, CENTRE:U] + half)
    ids = seen[tree.rows].astype(np.int32)
    return RayTree(kept[tree.rows], ids, tree.boxes, tree.children, len(records))


@scalar
def meet(records, row, ray):
    """Return t and ``q = u^2 + v^2`` of eight rays."""
    x, y, z = records[row, CENTRE] - ray[0], records[row, CENTRE + 1] - ray[1], records[row, CENTRE + 2] - ray[2]
    n0, n1, n2 = records[row, NORMAL], records[row, NORMAL + 1], records[row, NORMAL + 2]
    t = (n0 * x + n1 * y + n2 * z) / (n0 * ray[3] + n1 * ray[4] + n2 * ray[5])
    x, y, z = t * ray[3] - x, t * ray[4] - y, t * ray[5] - z
    u = records[row, U] * x + records[row, U + 1] * y + records[row, U + 2] * z
    v = records[row, V] * x + records[row, V + 1] * y + records[row, V + 2] * z
    return t, u * u + v * v


@functools.cache
def measuring_kernel() -> Callable:
    """Return the kernel, which is compiled when it is first called."""
    find_hits = finder(meet)

    @kernel()
    def measure(tree, rays, limits, n_threads, left):
        n_rays = len(left)
        taken = make_shared_counter()
        for _ in prange(n_threads):
            found = empty_lists(limits.capacity)
            for part in dynamic_range(taken, (n_rays + RAYS_PER_PART - 1) // RAYS_PER_PART):
                end = min((part + 1) * RAYS_PER_PART, n_rays)
                for first in range(part * RAYS_PER_PART, end, WIDTH):
                    find_hits(tree, rays, first, n_rays, limits, found)
                    for k in range(min(WIDTH, end - first)):
                        left[first + k] = found.left[k]

    return measure
