"""Rays through a tree of Gaussians, forward and back: ``mechanisms.rays.blending`` without testing every Gaussian.

The gradient needs no lock and depends on no order of threads: each ray writes the contributions of its hits to separate
rows, and each Gaussian then sums its rows in the order of the rays.

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
from minisplat_ref.mechanisms.rays.pixel_rays import BlendedRays, Hits, RayGradient, Rays, Tracer
from minisplat_ref.mechanisms.rays.traversal import OPACITY, RayTree, empty_lists, finder, limits_of, ray_of
from minisplat_ref.types import Floats, Ints

RAYS_PER_PART = 64  # a multiple of eight
GAUSSIANS_PER_PART = 32
HITS_KEPT_PER_RAY = 64  # more than rays meet on average; memory that no hit needs is never touched
HITS_KEPT_MAX = 1 << 24  # 470 MB


class RayResponse(NamedTuple):
    """The response of one row of a tree to a ray."""

    meet: Callable
    """``meet(records, row, ray)`` of eight rays: see :func:`~minisplat_ref.mechanisms.rays.traversal.finder`."""
    meet_vjp: Callable
    """``meet_vjp(records, row, ray, unclamped, v_unclamped, v_t)`` of one ray: tuples of derivatives with respect to
    the mean [3], the ray's direction [3], and the row's shape [n_shape]. That of its origin is that of the mean,
    negative."""
    n_shape: int
    shapes_of: Callable[[RayTree, Floats], Floats]
    """``shapes_of(tree, v_rows)``: the gradient of the Gaussians' shapes [N, ...] from those of the rows' [N', K]."""


class _Kernels(NamedTuple):
    blend: Callable
    differentiate_rays: Callable
    add_up: Callable


def tracer_of(response: RayResponse, tree: RayTree) -> Tracer:
    """Return the three functions of tracing, by kernels."""
    return Tracer(
        partial(list_hits, response, tree),
        partial(blend_rays, response, tree),
        partial(blend_rays_vjp, response, tree),
    )


@scalar
def is_accepted(T, limits):
    """Return whether a ray takes a hit that leaves it with the transmittance T."""
    return T > limits.transmittance_min or (T == limits.transmittance_min and not limits.stops_at_equality)


class KeptHits(NamedTuple):
    """The blended hits of rays, as forward found them: the gradient traces nothing again.

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


class _HitGradient(NamedTuple):
    unclamped: Floats  # [room]
    depths: Floats  # [room]
    rays: Floats  # [P, 6] with respect to origins and directions


class _HitsOfRows(NamedTuple):
    offsets: Ints  # [N' + 1] of each row of the tree
    hits: Ints  # [H] in the order of the rays
    rays: Ints  # [H]


class _RayCotangents(NamedTuple):
    image: Floats  # [P, 3]
    depths: Floats  # [P]
    behind: Floats  # [P] T_end (v_image . b + v_T)


@functools.cache
def _kernels_of(response: RayResponse) -> _Kernels:
    """Return the kernels of a response; each is compiled when it is first called."""
    find_hits, meet_vjp, n_shape = finder(response.meet), response.meet_vjp, response.n_shape
    n_sums = 7 + n_shape

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

    @kernel()
    def differentiate_rays(tree, colors, rays, limits, n_threads, kept, cotangents, v):
        """Write the gradient with respect to each hit and each ray, from the last hit to the first."""
        n_rays = len(rays.near)
        taken = make_shared_counter()
        for _ in prange(n_threads):
            v_unclamped, v_depths, v_rays = v
            for part in dynamic_range(taken, (n_rays + RAYS_PER_PART - 1) // RAYS_PER_PART):
                for r in range(part * RAYS_PER_PART, min((part + 1) * RAYS_PER_PART, n_rays)):
                    ray, behind = ray_of(rays, r), cotangents.behind[r]
                    red, green, blue = cotangents.image[r, 0], cotangents.image[r, 1], cotangents.image[r, 2]
                    for k in range(6):
                        v_rays[r, k] = 0.0
                    for h in range(kept.starts[r] + kept.n_hits[r] - 1, kept.starts[r] - 1, -1):
                        row = kept.rows[h]
                        g, weight, unclamped = tree.gaussian_ids[row], kept.weights[h], kept.unclamped[h]
                        alpha = min(limits.alpha_max, unclamped)
                        v_dot_c = red * colors[g, 0] + green * colors[g, 1] + blue * colors[g, 2]
                        v_dot_c += cotangents.depths[r] * kept.depths[h]
                        v_alpha = weight / alpha * v_dot_c - behind / (1.0 - alpha)
                        behind += weight * v_dot_c
                        v_unclamped[h] = v_alpha if unclamped <= limits.alpha_max else 0.0
                        v_depths[h] = weight * cotangents.depths[r]
                        of_mean, of_direction, _of_shape = meet_vjp(
                            tree.records, row, ray, unclamped, v.unclamped[h], v.depths[h]
                        )
                        for k in range(3):
                            v_rays[r, k] -= of_mean[k]
                            v_rays[r, 3 + k] += of_direction[k]

    @kernel()
    def add_up(tree, rays, n_threads, kept, groups, v_image, v, sums):
        """Add the gradient of each row up: mean, opacity, colour, shape."""
        n_rows = len(tree.gaussian_ids)
        taken = make_shared_counter()
        for _ in prange(n_threads):
            for part in dynamic_range(taken, (n_rows + GAUSSIANS_PER_PART - 1) // GAUSSIANS_PER_PART):
                for row in range(part * GAUSSIANS_PER_PART, min((part + 1) * GAUSSIANS_PER_PART, n_rows)):
                    for k in range(n_sums):
                        sums[row, k] = 0.0
                    for i in range(groups.offsets[row], groups.offsets[row + 1]):
                        h, r = groups.hits[i], groups.rays[i]
                        unclamped = kept.unclamped[h]
                        of_mean, _of_direction, of_shape = meet_vjp(
                            tree.records, row, ray_of(rays, r), unclamped, v.unclamped[h], v.depths[h]
                        )
                        for k in range(3):
                            sums[row, k] += of_mean[k]
                            sums[row, 4 + k] += kept.weights[h] * v_image[r, k]
                        sums[row, 3] += unclamped / tree.records[row, OPACITY] * v.unclamped[h]
                        for k in range(n_shape):
                            sums[row, 7 + k] += of_shape[k]

    return _Kernels(blend, differentiate_rays, add_up)


@kernel(parallel=False)
def _sort_by_row(kept, groups):
    """Write which hits each row of the tree has, in the order of the rays; ``groups.offsets`` are zeros."""
    offsets, hits, rays = groups
    for r in range(len(kept.n_hits)):
        for h in range(kept.starts[r], kept.starts[r] + kept.n_hits[r]):
            offsets[kept.rows[h] + 1] += 1
    for row in range(len(offsets) - 1):
        offsets[row + 1] += offsets[row]
    place = offsets[:-1].copy()
    for r in range(len(kept.n_hits)):
        for h in range(kept.starts[r], kept.starts[r] + kept.n_hits[r]):
            i = place[kept.rows[h]]
            hits[i], rays[i] = h, r
            place[kept.rows[h]] = i + 1


def blend_rays(
    response: RayResponse, tree: RayTree, colors: Floats, rays: Rays, background: Floats, conventions: Conventions
) -> BlendedRays:
    """Blend what each ray meets: see :func:`minisplat_ref.mechanisms.rays.blending.blend_rays`.

    Parameters
    ----------
    response : RayResponse
        What a row of the tree does to a ray.
    tree : RayTree
        Gaussians in a tree.
    colors, rays, background, conventions
        As there.
    """
    room = min(HITS_KEPT_PER_RAY * len(rays.near), HITS_KEPT_MAX)
    return _blend(response, tree, (colors, background), rays, conventions, room)[0]


def list_hits(response: RayResponse, tree: RayTree, rays: Rays, conventions: Conventions) -> Hits:
    """Return the blended hits of each ray: see :func:`minisplat_ref.mechanisms.rays.blending.list_hits`."""
    black = np.zeros((tree.n, 3)), np.zeros(3)
    blended = blend_rays(response, tree, black[0], rays, black[1], conventions)
    kept = _kept_of(response, tree, rays, conventions, blended)
    offsets = np.concatenate([[0], np.cumsum(blended.n_hits)])
    ray_ids = np.repeat(np.arange(len(rays.near)), blended.n_hits)
    places = np.arange(offsets[-1]) + (kept.starts - offsets[:-1])[ray_ids]
    ids = tree.gaussian_ids[kept.rows[places]].astype(np.int64)
    unclamped, depths, weights = kept.unclamped[places], kept.depths[places], kept.weights[places]
    return Hits(offsets, ray_ids, ids, unclamped, depths, weights, blended.transmittances)


def blend_rays_vjp(
    response: RayResponse,
    tree: RayTree,
    colors: Floats,
    rays: Rays,
    background: Floats,
    conventions: Conventions,
    blended: BlendedRays,
    v_blended: tuple[Floats, Floats, Floats],
) -> RayGradient:
    """Gradient of :func:`blend_rays`: see :func:`minisplat_ref.mechanisms.rays.blending.blend_rays_vjp`."""
    v_image, v_depths, v_transmittances = (_wide(v) for v in v_blended)
    kernels, kept = _kernels_of(response), _kept_of(response, tree, rays, conventions, blended)
    n_rays, n_rows, room = len(rays.near), len(tree.gaussian_ids), len(kept.rows)
    behind = blended.transmittances * (v_image @ _wide(background) + v_transmittances)
    v = _HitGradient(np.empty(room), np.empty(room), np.empty((n_rays, 6)))
    cotangents, limits = _RayCotangents(v_image, v_depths, behind), limits_of(conventions, n_rows)
    kernels.differentiate_rays(tree, _wide(colors), rays, limits, n_threads(), kept, cotangents, v)
    groups = _HitsOfRows(np.zeros(n_rows + 1, np.int64), *np.empty((2, int(kept.n_hits.sum())), np.int64))
    _sort_by_row(kept, groups)
    sums, v_gaussians = np.empty((n_rows, 7 + response.n_shape)), np.zeros((tree.n, 7))
    kernels.add_up(tree, rays, n_threads(), kept, groups, v_image, v, sums)
    np.add.at(v_gaussians, tree.gaussian_ids, sums[:, :7])
    return RayGradient(
        means=v_gaussians[:, :3],
        shapes=response.shapes_of(tree, sums[:, 7:]),
        opacities=v_gaussians[:, 3],
        colors=v_gaussians[:, 4:],
        background=np.sum(blended.transmittances[:, None] * v_image, axis=0),
        origins=v.rays[:, :3],
        directions=v.rays[:, 3:],
    )


def _blend(
    response: RayResponse,
    tree: RayTree,
    shades: tuple[Floats, Floats],
    rays: Rays,
    conventions: Conventions,
    room: int,
) -> tuple[BlendedRays, int]:
    """Return the colours of the rays, with their hits if these fit into ``room``, and the room that they need."""
    n, n_hits = len(rays.near), np.empty(len(rays.near), np.int64)
    image, depths, transmittances, is_seen = np.empty((n, 3)), np.empty(n), np.empty(n), np.zeros(tree.n, bool)
    starts, rows, n_used = np.empty(n, np.int64), np.empty(room, np.int32), np.zeros(1, np.int64)
    kept = KeptHits(starts, n_hits, rows, np.empty(room), np.empty(room), np.empty(room), n_used)
    limits, wide = limits_of(conventions, len(tree.gaussian_ids)), (_wide(shades[0]), _wide(shades[1]))
    arrays = image, depths, transmittances, is_seen
    _kernels_of(response).blend(tree, wide, rays, limits, n_threads(), arrays, kept)
    is_complete, needed = n_used[0] <= room, int(n_used[0])
    return BlendedRays(image, depths, transmittances, n_hits, is_seen, kept if is_complete else None), needed


def _kept_of(
    response: RayResponse, tree: RayTree, rays: Rays, conventions: Conventions, blended: BlendedRays
) -> KeptHits:
    """Return the hits of rays that were blended; where there was no room for them, by tracing once more."""
    if blended.kept is not None:
        kept: KeptHits = blended.kept
        return kept
    black = np.zeros((tree.n, 3)), np.zeros(3)
    room = _blend(response, tree, black, rays, conventions, 0)[1]
    return _kept_of(response, tree, rays, conventions, _blend(response, tree, black, rays, conventions, room)[0])


def _wide(array: Floats) -> Floats:
    return np.ascontiguousarray(array, np.float64)
