"""Rays through a tree of Gaussians, forward and back: ``mechanisms.rays.blending`` without testing every Gaussian.

The gradient needs no lock and depends on no order of threads: each ray writes what its hits contribute to rows of their
own, and each Gaussian then adds up its rows in the order of the rays.

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
from minisplat_ref.jit.scheduling import dynamic_range, make_shared_counter
from minisplat_ref.mechanisms.rays.pixel_rays import BlendedRays, Hits, RayGradient, Rays, Tracer
from minisplat_ref.mechanisms.rays.traversal import OPACITY, RayTree, empty_lists, finder, limits_of, ray_of
from minisplat_ref.types import Floats, Ints

RAYS_PER_PART = 64  # a multiple of eight
GAUSSIANS_PER_PART = 32


class RayResponse(NamedTuple):
    """What one row of a tree does to a ray."""

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
    list_hits: Callable
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
def goes_on(T, limits):
    """Return whether a ray takes a hit that leaves it with the transmittance T."""
    return T > limits.transmittance_min or (T == limits.transmittance_min and not limits.stops_at_equality)


class _HitGradient(NamedTuple):
    unclamped: Floats  # [H]
    depths: Floats  # [H]
    rays: Floats  # [P, 6] with respect to origins and directions


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
    def blend(tree, colors, rays, background, limits, n_threads, blended):
        n_rays = len(rays.near)
        taken = make_shared_counter()
        for _ in prange(n_threads):
            found = empty_lists(limits.capacity)
            image, depths, transmittances, n_hits, is_seen = blended
            for part in dynamic_range(taken, (n_rays + RAYS_PER_PART - 1) // RAYS_PER_PART):
                for r in range(part * RAYS_PER_PART, min((part + 1) * RAYS_PER_PART, n_rays)):
                    lane = r % WIDTH
                    if lane == 0:
                        find_hits(tree, rays, r, n_rays, limits, found)
                    n = found.counts[lane]
                    T, red, green, blue, depth, count = 1.0, 0.0, 0.0, 0.0, 0.0, 0
                    while count < n:
                        alpha = min(limits.alpha_max, found.unclamped[lane, count])
                        after = T * (1.0 - alpha)
                        if not goes_on(after, limits):
                            break
                        weight, g = alpha * T, tree.gaussian_ids[found.rows[lane, count]]
                        red += weight * colors[g, 0]
                        green += weight * colors[g, 1]
                        blue += weight * colors[g, 2]
                        depth += weight * found.depths[lane, count]
                        is_seen[g] = True
                        T = after
                        count += 1
                    image[r, 0] = red + T * background[0]
                    image[r, 1] = green + T * background[1]
                    image[r, 2] = blue + T * background[2]
                    depths[r], transmittances[r], n_hits[r] = depth, T, count

    @kernel()
    def list_all(tree, rays, limits, n_threads, hits):
        """Write the hits with rows of the tree; ``hits.offsets`` tells how many each ray has."""
        n_rays = len(rays.near)
        taken = make_shared_counter()
        for _ in prange(n_threads):
            found = empty_lists(limits.capacity)
            offsets, ray_ids, rows, unclamped, depths, weights, transmittances = hits
            for part in dynamic_range(taken, (n_rays + RAYS_PER_PART - 1) // RAYS_PER_PART):
                for r in range(part * RAYS_PER_PART, min((part + 1) * RAYS_PER_PART, n_rays)):
                    lane = r % WIDTH
                    if lane == 0:
                        find_hits(tree, rays, r, n_rays, limits, found)
                    T, first = 1.0, offsets[r]
                    for i in range(offsets[r + 1] - first):
                        alpha = min(limits.alpha_max, found.unclamped[lane, i])
                        ray_ids[first + i], rows[first + i] = r, found.rows[lane, i]
                        unclamped[first + i], depths[first + i] = found.unclamped[lane, i], found.depths[lane, i]
                        weights[first + i] = alpha * T
                        T *= 1.0 - alpha
                    transmittances[r] = T

    @kernel()
    def differentiate_rays(tree, colors, rays, limits, n_threads, hits, cotangents, v):
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
                    for h in range(hits.offsets[r + 1] - 1, hits.offsets[r] - 1, -1):
                        row = hits.gaussian_ids[h]
                        g, weight, unclamped = tree.gaussian_ids[row], hits.weights[h], hits.unclamped[h]
                        alpha = min(limits.alpha_max, unclamped)
                        v_dot_c = red * colors[g, 0] + green * colors[g, 1] + blue * colors[g, 2]
                        v_dot_c += cotangents.depths[r] * hits.depths[h]
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
    def add_up(tree, rays, n_threads, hits, groups, v_image, v, sums):
        """Add the gradient of each row up: mean, opacity, colour, shape."""
        n_rows = len(tree.gaussian_ids)
        taken = make_shared_counter()
        order, offsets = groups
        for _ in prange(n_threads):
            for part in dynamic_range(taken, (n_rows + GAUSSIANS_PER_PART - 1) // GAUSSIANS_PER_PART):
                for row in range(part * GAUSSIANS_PER_PART, min((part + 1) * GAUSSIANS_PER_PART, n_rows)):
                    for k in range(n_sums):
                        sums[row, k] = 0.0
                    for i in range(offsets[row], offsets[row + 1]):
                        h = order[i]
                        r = hits.ray_ids[h]
                        unclamped = hits.unclamped[h]
                        of_mean, _of_direction, of_shape = meet_vjp(
                            tree.records, row, ray_of(rays, r), unclamped, v.unclamped[h], v.depths[h]
                        )
                        for k in range(3):
                            sums[row, k] += of_mean[k]
                            sums[row, 4 + k] += hits.weights[h] * v_image[r, k]
                        sums[row, 3] += unclamped / tree.records[row, OPACITY] * v.unclamped[h]
                        for k in range(n_shape):
                            sums[row, 7 + k] += of_shape[k]

    return _Kernels(blend, list_all, differentiate_rays, add_up)


@kernel(parallel=False)
def _sort_by_row(rows, offsets, order):
    """Write where the hits of each row of the tree are, in the order of the rays; ``offsets`` [N' + 1] are zeros."""
    for row in rows:
        offsets[row + 1] += 1
    for row in range(len(offsets) - 1):
        offsets[row + 1] += offsets[row]
    place = offsets[:-1].copy()
    for h in range(len(rows)):
        order[place[rows[h]]] = h
        place[rows[h]] += 1


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
    n = len(rays.near)
    blended = BlendedRays(np.empty((n, 3)), np.empty(n), np.empty(n), np.empty(n, np.int64), np.zeros(tree.n, bool))
    limits = limits_of(conventions, len(tree.gaussian_ids))
    _kernels_of(response).blend(tree, _wide(colors), rays, _wide(background), limits, n_threads(), blended)
    return blended


def list_hits(response: RayResponse, tree: RayTree, rays: Rays, conventions: Conventions) -> Hits:
    """Return the blended hits of each ray: see :func:`minisplat_ref.mechanisms.rays.blending.list_hits`."""
    counts = blend_rays(response, tree, np.zeros((tree.n, 3)), rays, np.zeros(3), conventions).n_hits
    hits = _list_hits(response, tree, rays, conventions, counts)
    return hits._replace(gaussian_ids=tree.gaussian_ids[hits.gaussian_ids].astype(np.int64))


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
    kernels, hits = _kernels_of(response), _list_hits(response, tree, rays, conventions, blended.n_hits)
    behind = hits.transmittances * (v_image @ _wide(background) + v_transmittances)
    n_hits, n_rays, n_rows = len(hits.ray_ids), len(rays.near), len(tree.gaussian_ids)
    v = _HitGradient(np.empty(n_hits), np.empty(n_hits), np.empty((n_rays, 6)))
    cotangents, limits = _RayCotangents(v_image, v_depths, behind), limits_of(conventions, n_rows)
    kernels.differentiate_rays(tree, _wide(colors), rays, limits, n_threads(), hits, cotangents, v)
    order, offsets = np.empty(n_hits, np.int64), np.zeros(n_rows + 1, np.int64)
    _sort_by_row(hits.gaussian_ids, offsets, order)
    sums, v_gaussians = np.empty((n_rows, 7 + response.n_shape)), np.zeros((tree.n, 7))
    kernels.add_up(tree, rays, n_threads(), hits, (order, offsets), v_image, v, sums)
    np.add.at(v_gaussians, tree.gaussian_ids, sums[:, :7])
    return RayGradient(
        means=v_gaussians[:, :3],
        shapes=response.shapes_of(tree, sums[:, 7:]),
        opacities=v_gaussians[:, 3],
        colors=v_gaussians[:, 4:],
        background=np.sum(hits.transmittances[:, None] * v_image, axis=0),
        origins=v.rays[:, :3],
        directions=v.rays[:, 3:],
    )


def _list_hits(response: RayResponse, tree: RayTree, rays: Rays, conventions: Conventions, counts: Ints) -> Hits:
    """Return the hits, ``counts`` [P] per ray, with rows of the tree instead of the population's."""
    offsets = np.concatenate([[0], np.cumsum(counts)])
    n_hits = int(offsets[-1])
    ray_ids, rows = np.empty((2, n_hits), np.int64)
    unclamped, depths, weights = np.empty((3, n_hits))
    hits = Hits(offsets, ray_ids, rows, unclamped, depths, weights, np.empty(len(counts)))
    limits = limits_of(conventions, len(tree.gaussian_ids))
    _kernels_of(response).list_hits(tree, rays, limits, n_threads(), hits)
    return hits


def _wide(array: Floats) -> Floats:
    return np.ascontiguousarray(array, np.float64)
