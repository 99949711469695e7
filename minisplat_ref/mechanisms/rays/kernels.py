"""Any rays through a tree of Gaussians: ``mechanisms.rays.blending`` without testing every Gaussian; no gradient.

The rays of an image have a shorter way, with a gradient (:mod:`.tile_kernels`). These may begin anywhere: shadows,
mirrors, glass.

Bundles that a kernel writes to are taken apart first: Numba drops ``bundle.array[i] = x`` from a parallel loop.
"""

import functools
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.jit.compile import kernel, n_threads, prange, scalar
from minisplat_ref.jit.lanes import WIDTH
from minisplat_ref.jit.scheduling import dynamic_range, fetch_and_add, make_shared_counter
from minisplat_ref.mechanisms.rays.pixel_rays import BlendedRays, Hits, Rays, Tracer
from minisplat_ref.mechanisms.rays.traversal import RayTree, empty_lists, finder, limits_of
from minisplat_ref.types import Floats, Ints

RAYS_PER_PART = 64  # a multiple of eight
HITS_KEPT_PER_RAY = 64  # more than rays meet on average; memory that no hit needs is never touched
HITS_KEPT_MAX = 1 << 24  # 470 MB


def tracer_of(meet: Callable, tree: RayTree) -> Tracer:
    """Return the functions of tracing, by kernels.

    Parameters
    ----------
    meet : callable
        What a row of the tree does to a ray, see :func:`~minisplat_ref.mechanisms.rays.traversal.finder`.
    tree : RayTree
        Gaussians in a tree.
    """
    return Tracer(partial(list_hits, meet, tree), partial(blend_rays, meet, tree))


@scalar
def is_accepted(T, limits):
    """Return whether a ray takes a hit that leaves it with the transmittance T."""
    return T > limits.transmittance_min or (T == limits.transmittance_min and not limits.stops_at_equality)


class KeptHits(NamedTuple):
    """The blended hits of rays, in the order in which they were found.

    Ray r has ``n_hits[r]`` of them from ``starts[r]`` on, nearest first. Which rays come first depends on the threads.
    """

    starts: Ints
    """[P]."""
    n_hits: Ints
    """[P]."""
    rows: Ints
    """[room] int32 of the tree."""
    unclamped: Floats
    """[room] alpha before the clamp."""
    depths: Floats
    """[room] t."""
    weights: Floats
    """[room] ``w = alpha T``."""
    n_used: Ints
    """[1] the room that all hits need; if there was less, some are missing."""


@functools.cache
def _kernel_of(meet: Callable) -> Callable:
    """Return the kernel of a response; it is compiled when it is first called."""
    find_hits = finder(meet)

    @kernel()
    def blend(tree, shades, rays, limits, n_threads, blended, kept):
        n_rays = len(rays.near)
        taken = make_shared_counter()
        colors, background = shades
        for _ in prange(n_threads):
            found = empty_lists(limits.capacity)
            image, depths, transmittances, is_seen = blended
            starts, n_hits, kept_rows, kept_unclamped, kept_depths, kept_weights, n_used = kept
            for part in dynamic_range(taken, (n_rays + RAYS_PER_PART - 1) // RAYS_PER_PART):
                for r in range(part * RAYS_PER_PART, min((part + 1) * RAYS_PER_PART, n_rays)):
                    lane = r % WIDTH
                    if lane == 0:
                        find_hits(tree, rays, r, n_rays, limits, found)
                    n = found.counts[lane]
                    start = fetch_and_add(n_used, n)
                    is_kept = start + n <= len(kept_rows)
                    T, red, green, blue, depth, count = 1.0, 0.0, 0.0, 0.0, 0.0, 0
                    while count < n:
                        unclamped = found.unclamped[lane, count]
                        alpha = min(limits.alpha_max, unclamped)
                        after = T * (1.0 - alpha)
                        if not is_accepted(after, limits):
                            break
                        row = found.rows[lane, count]
                        weight, g = alpha * T, tree.gaussian_ids[row]
                        red += weight * colors[g, 0]
                        green += weight * colors[g, 1]
                        blue += weight * colors[g, 2]
                        depth += weight * found.depths[lane, count]
                        is_seen[g] = True
                        if is_kept:
                            kept_rows[start + count], kept_unclamped[start + count] = row, unclamped
                            kept_depths[start + count], kept_weights[start + count] = found.depths[lane, count], weight
                        T = after
                        count += 1
                    image[r, 0] = red + T * background[0]
                    image[r, 1] = green + T * background[1]
                    image[r, 2] = blue + T * background[2]
                    depths[r], transmittances[r], n_hits[r], starts[r] = depth, T, count, start

    return blend


def blend_rays(
    meet: Callable, tree: RayTree, colors: Floats, rays: Rays, background: Floats, conventions: Conventions
) -> BlendedRays:
    """Blend what each ray meets: see :func:`minisplat_ref.mechanisms.rays.blending.blend_rays`.

    Parameters
    ----------
    meet, tree
        As for :func:`tracer_of`.
    colors, rays, background, conventions
        As there.
    """
    return _blend(meet, tree, (colors, background), rays, conventions, 0)[0]


def list_hits(meet: Callable, tree: RayTree, rays: Rays, conventions: Conventions) -> Hits:
    """Return the blended hits of each ray: see :func:`minisplat_ref.mechanisms.rays.blending.list_hits`."""
    black, room = (np.zeros((tree.n, 3)), np.zeros(3)), min(HITS_KEPT_PER_RAY * len(rays.near), HITS_KEPT_MAX)
    blended, kept = _blend(meet, tree, black, rays, conventions, room)
    if kept.n_used[0] > room:  # some are missing
        blended, kept = _blend(meet, tree, black, rays, conventions, int(kept.n_used[0]))
    offsets = np.concatenate([[0], np.cumsum(blended.n_hits)])
    ray_ids = np.repeat(np.arange(len(rays.near)), blended.n_hits)
    places = np.arange(offsets[-1]) + (kept.starts - offsets[:-1])[ray_ids]
    ids = tree.gaussian_ids[kept.rows[places]].astype(np.int64)
    unclamped, depths, weights = kept.unclamped[places], kept.depths[places], kept.weights[places]
    return Hits(offsets, ray_ids, ids, unclamped, depths, weights, blended.transmittances)


def _blend(
    meet: Callable,
    tree: RayTree,
    shades: tuple[Floats, Floats],
    rays: Rays,
    conventions: Conventions,
    room: int,
) -> tuple[BlendedRays, KeptHits]:
    """Return the colours of the rays, and those of their hits that fit into ``room``."""
    n, n_hits = len(rays.near), np.empty(len(rays.near), np.int64)
    image, depths, transmittances, is_seen = np.empty((n, 3)), np.empty(n), np.empty(n), np.zeros(tree.n, bool)
    starts, rows, n_used = np.empty(n, np.int64), np.empty(room, np.int32), np.zeros(1, np.int64)
    kept = KeptHits(starts, n_hits, rows, np.empty(room), np.empty(room), np.empty(room), n_used)
    limits, wide = limits_of(conventions, len(tree.gaussian_ids)), (_wide(shades[0]), _wide(shades[1]))
    _kernel_of(meet)(tree, wide, rays, limits, n_threads(), (image, depths, transmittances, is_seen), kept)
    return BlendedRays(image, depths, transmittances, n_hits, is_seen), kept


def _wide(array: Floats) -> Floats:
    return np.ascontiguousarray(array, np.float64)
