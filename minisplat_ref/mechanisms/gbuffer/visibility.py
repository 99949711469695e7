"""How much light comes through a scene of surfels along any rays: reflected ones, or ones to a lamp.

The ray ``O + t d`` meets the disc of the centre mu, the axes r_0 and r_1, the normal n and the deviations s at::

    t = n.(mu - O) / n.d,   u = (O + t d - mu).r_0 / s_0,   v = (O + t d - mu).r_1 / s_1
    alpha = min(alpha_max, o exp(-(u^2 + v^2) / 2))

and what is left is the product of all 1 - alpha, in any order. Hits of alpha below ``alpha_min`` do not count, and no
more are sought where less than ``transmittance_min`` is left. There is no low-pass: a disc is hit where it is. No
gradient is given; what is hidden changes in steps.
"""

import functools
from collections.abc import Callable

import numpy as np

from minisplat_ref.backends import Backend
from minisplat_ref.constants import Conventions
from minisplat_ref.jit.compile import kernel, n_threads, prange, scalar
from minisplat_ref.jit.lanes import WIDTH
from minisplat_ref.jit.scheduling import dynamic_range, make_shared_counter
from minisplat_ref.mechanisms.rays.bvh import build
from minisplat_ref.mechanisms.rays.pixel_rays import Rays
from minisplat_ref.mechanisms.rays.traversal import OPACITY, RayTree, empty_lists, finder, limits_of
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.types import Floats, Primitives

CENTRE, U, V, NORMAL = 1, 4, 7, 10  # columns of a record beside the opacity; U and V are axes over deviations
N_COLUMNS = 13
RAYS_PER_PART = 64  # a multiple of eight
RAYS_AT_ONCE = 256  # in NumPy


def transmittances(primitives: Primitives, rays: Rays, conventions: Conventions, backend: Backend) -> Floats:
    """Return what is left of the light along each ray.

    Parameters
    ----------
    primitives : Primitives
        N surfels, world frame; their third scale is not read.
    rays : Rays
        P rays; only hits between near and far count.
    conventions : Conventions
        ``alpha_min``, ``alpha_max`` and ``transmittance_min`` are used.
    backend : Backend
        Compiled: by a tree of boxes. Otherwise every ray is tried against every surfel.

    Returns
    -------
    ndarray of shape (P,)
        In [0, 1], float64.
    """
    records = _records(primitives)
    if not backend.is_compiled:
        return _by_all_pairs(records, rays, conventions)
    tree = _tree_of(records, conventions)
    left = np.empty(len(rays.near))
    wide = Rays(*(np.ascontiguousarray(field, np.float64) for field in rays))
    _kernel()(tree, wide, limits_of(conventions, len(tree.gaussian_ids)), n_threads(), left)
    return left


def _records(primitives: Primitives) -> Floats:
    """Return the columns [N, 13] of all surfels."""
    means, quats, scales, opacities = (field.astype(np.float64) for field in primitives)
    R = rotation_matrices(quats)
    with np.errstate(divide="ignore", over="ignore"):
        axes = R[:, :, :2] / scales[:, None, :2]
    return np.column_stack([opacities, means, axes[:, :, 0], axes[:, :, 1], R[:, :, 2]])


def _by_all_pairs(records: Floats, rays: Rays, conventions: Conventions) -> Floats:
    left = np.ones(len(rays.near))
    opacities, centres, normals = records[:, OPACITY], records[:, CENTRE:U], records[:, NORMAL:]
    for first in range(0, len(left), RAYS_AT_ONCE):
        rows = slice(first, first + RAYS_AT_ONCE)
        origins, d = rays.origins[rows, None], rays.directions[rows, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.sum(normals * (centres - origins), axis=2) / np.sum(normals * d, axis=2)  # [P', N]
            p = origins + t[:, :, None] * d - centres
            q = np.sum(p * records[:, U:V], axis=2) ** 2 + np.sum(p * records[:, V:NORMAL], axis=2) ** 2
            alphas = np.minimum(conventions.alpha_max, opacities * np.exp(-q / 2))
            is_hit = (rays.near[rows, None] < t) & (t < rays.far[rows, None]) & (alphas >= conventions.alpha_min)
        left[rows] = np.prod(np.where(is_hit, 1 - alphas, 1), axis=1)
    return left


def _tree_of(records: Floats, conventions: Conventions) -> RayTree:
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
    return RayTree(kept[tree.rows], ids, np.zeros_like(ids), tree.boxes, tree.children, len(records))


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
def _kernel() -> Callable:
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
