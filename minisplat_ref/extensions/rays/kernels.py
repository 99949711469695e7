"""Rays through a tree of Gaussians: the functions of :mod:`.reference`, which skip what a ray misses.

The gradient needs no lock and does not depend on the order of threads: each ray writes the contributions of its hits to
rows of their own, and each Gaussian then sums its rows in the order of the rays.

A kernel unpacks bundles before it writes to them, because Numba drops ``bundle.array[i] = x`` from a parallel loop.
"""

import math
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.extensions.rays import bvh
from minisplat_ref.extensions.rays.formulas import (
    END_MARGIN,
    MEAN,
    N_COLUMNS,
    OPACITY,
    REACH,
    Limits,
    empty_lists,
    find_hits,
    pair_vjp,
    ray_of,
    times_transpose,
)
from minisplat_ref.extensions.rays.types import BlendedRays, Hits, RayGradient, Rays, Whitened
from minisplat_ref.jit.compile import kernel, n_threads, prange, scalar
from minisplat_ref.jit.lanes import WIDTH
from minisplat_ref.jit.scheduling import dynamic_range, shared_counter
from minisplat_ref.types import Floats, Ints

RAYS_PER_PART = 64  # a multiple of eight
GAUSSIANS_PER_PART = 32


class Scene(NamedTuple):
    """Gaussians in the order of a tree's leaves."""

    records: Floats
    """[N', N_COLUMNS] records of the Gaussians that can be seen at all."""
    ids: Ints
    """[N'] int32 their rows in the population."""
    boxes: Floats
    """[K, 2, 6] as in :class:`.bvh.Tree`, which is unpacked, since bundles of kernels cannot be nested."""
    children: Ints
    """[K, 2, 2] as in :class:`.bvh.Tree`."""
    n: int
    """Number of Gaussians of the population."""


def scene_of(gaussians: Whitened, conventions: Conventions) -> Scene:
    """Return Gaussians with their tree, without those that are too faint or not finite."""
    # Half-extents of the ellipsoid |M x|^2 = q: Sigma = M^-1 M^-T, and row i of M is R_i / s_i.
    least = max(conventions.alpha_min, np.finfo(np.float64).tiny)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        reaches = 2 * np.log(gaussians.opacities / least)  # q
        inverse_variances = np.sum(gaussians.maps**2, axis=2)  # [N, 3] 1 / s^2
        axes = gaussians.maps / inverse_variances[:, :, None]  # [N, 3, 3] s_i R_i
        half = np.sqrt(reaches[:, None] * np.sum(axes**2, axis=1))  # [N, 3]
        is_finite = np.isfinite(gaussians.means).all(axis=1) & np.isfinite(half).all(axis=1)
    seen = np.flatnonzero(is_finite & np.isfinite(inverse_variances).all(axis=1) & (reaches >= 0))
    tree = bvh.build(gaussians.means[seen] - half[seen], gaussians.means[seen] + half[seen])
    ids = seen[tree.rows]
    records = np.empty((len(ids), N_COLUMNS))
    records[:, :MEAN] = gaussians.maps[ids].reshape(-1, 9)
    records[:, MEAN:OPACITY] = gaussians.means[ids]
    records[:, OPACITY] = gaussians.opacities[ids]
    records[:, REACH] = reaches[ids] + bvh.SLACK
    return Scene(records, ids.astype(np.int32), tree.boxes, tree.children, len(gaussians.means))


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


@scalar
def goes_on(T, limits):
    """Return whether a ray takes a hit that leaves it with the transmittance T."""
    return T > limits.transmittance_min or (T == limits.transmittance_min and not limits.stops_at_equality)


@kernel()
def _blend(scene, colors, rays, background, limits, n_threads, blended):
    n_rays = len(rays.near)
    taken = shared_counter()
    for _ in prange(n_threads):
        found = empty_lists(limits.capacity)
        image, depths, transmittances, n_hits, is_seen = blended
        for part in dynamic_range(taken, (n_rays + RAYS_PER_PART - 1) // RAYS_PER_PART):
            for r in range(part * RAYS_PER_PART, min((part + 1) * RAYS_PER_PART, n_rays)):
                lane = r % WIDTH
                if lane == 0:
                    find_hits(scene, rays, r, n_rays, limits, found)
                n = found.counts[lane]
                T, red, green, blue, depth, count = 1.0, 0.0, 0.0, 0.0, 0.0, 0
                while count < n:
                    alpha = min(limits.alpha_max, found.unclamped[lane, count])
                    after = T * (1.0 - alpha)
                    if not goes_on(after, limits):
                        break
                    weight, g = alpha * T, scene.ids[found.rows[lane, count]]
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
def _list(scene, rays, limits, n_threads, hits):
    """Write the hits with rows of the scene; ``hits.offsets`` tells how many each ray has."""
    n_rays = len(rays.near)
    taken = shared_counter()
    for _ in prange(n_threads):
        found = empty_lists(limits.capacity)
        offsets, ray_ids, rows, unclamped, depths, weights, transmittances = hits
        for part in dynamic_range(taken, (n_rays + RAYS_PER_PART - 1) // RAYS_PER_PART):
            for r in range(part * RAYS_PER_PART, min((part + 1) * RAYS_PER_PART, n_rays)):
                lane = r % WIDTH
                if lane == 0:
                    find_hits(scene, rays, r, n_rays, limits, found)
                T, first = 1.0, offsets[r]
                for i in range(offsets[r + 1] - first):
                    alpha = min(limits.alpha_max, found.unclamped[lane, i])
                    ray_ids[first + i], rows[first + i] = r, found.rows[lane, i]
                    unclamped[first + i], depths[first + i] = found.unclamped[lane, i], found.depths[lane, i]
                    weights[first + i] = alpha * T
                    T *= 1.0 - alpha
                transmittances[r] = T


class _HitGradient(NamedTuple):
    unclamped: Floats  # [H]
    depths: Floats  # [H]
    rays: Floats  # [P, 6] with respect to origins and directions


class _RayCotangents(NamedTuple):
    image: Floats  # [P, 3]
    depths: Floats  # [P]
    behind: Floats  # [P] T_end (v_image . b + v_T)


@kernel()
def _differentiate_rays(scene, colors, rays, limits, n_threads, hits, cotangents, v):
    """Write the gradient with respect to each hit and each ray, from the last hit to the first."""
    n_rays = len(rays.near)
    taken = shared_counter()
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
                    g, weight, unclamped = scene.ids[row], hits.weights[h], hits.unclamped[h]
                    alpha = min(limits.alpha_max, unclamped)
                    light = red * colors[g, 0] + green * colors[g, 1] + blue * colors[g, 2]
                    light += cotangents.depths[r] * hits.depths[h]
                    v_alpha = weight / alpha * light - behind / (1.0 - alpha)
                    behind += weight * light
                    v_unclamped[h] = v_alpha if unclamped <= limits.alpha_max else 0.0
                    v_depths[h] = weight * cotangents.depths[r]
                    of_p, of_v = pair_vjp(scene.records, row, ray, unclamped, v.unclamped[h], v.depths[h])
                    of_mean, of_direction = (
                        times_transpose(scene.records, row, of_p),
                        times_transpose(scene.records, row, of_v),
                    )
                    for k in range(3):
                        v_rays[r, k] -= of_mean[k]
                        v_rays[r, 3 + k] += of_direction[k]


@kernel(parallel=False)
def _sort_by_gaussian(rows, offsets, order):
    """Write where the hits of each row of the scene are, in the order of the rays; ``offsets`` [N' + 1] are zeros."""
    for row in rows:
        offsets[row + 1] += 1
    for row in range(len(offsets) - 1):
        offsets[row + 1] += offsets[row]
    place = offsets[:-1].copy()
    for h in range(len(rows)):
        order[place[rows[h]]] = h
        place[rows[h]] += 1


@kernel()
def _add_up(scene, rays, n_threads, hits, groups, v_image, v, sums):
    """Sum the gradients of each Gaussian with respect to its map, mean, opacity and colour."""
    n_rows = len(scene.ids)
    taken = shared_counter()
    order, offsets = groups
    for _ in prange(n_threads):
        for part in dynamic_range(taken, (n_rows + GAUSSIANS_PER_PART - 1) // GAUSSIANS_PER_PART):
            for row in range(part * GAUSSIANS_PER_PART, min((part + 1) * GAUSSIANS_PER_PART, n_rows)):
                mean = scene.records[row, MEAN], scene.records[row, MEAN + 1], scene.records[row, MEAN + 2]
                for k in range(16):
                    sums[row, k] = 0.0
                for i in range(offsets[row], offsets[row + 1]):
                    h = order[i]
                    r = hits.ray_ids[h]
                    ray = ray_of(rays, r)
                    unclamped = hits.unclamped[h]
                    of_p, of_v = pair_vjp(scene.records, row, ray, unclamped, v.unclamped[h], v.depths[h])
                    of_mean = times_transpose(scene.records, row, of_p)
                    for a in range(3):
                        for b in range(3):
                            sums[row, 3 * a + b] += of_p[a] * (mean[b] - ray[b]) + of_v[a] * ray[3 + b]
                        sums[row, 9 + a] += of_mean[a]
                        sums[row, 13 + a] += hits.weights[h] * v_image[r, a]
                    sums[row, 12] += unclamped / scene.records[row, OPACITY] * v.unclamped[h]


def blend_rays(scene: Scene, colors: Floats, rays: Rays, background: Floats, conventions: Conventions) -> BlendedRays:
    """Blend the hits of each ray; see :func:`minisplat_ref.extensions.rays.reference.blend_rays`.

    Parameters
    ----------
    scene : Scene
        From :func:`scene_of`.
    colors, rays, background, conventions
        As for the reference.
    """
    n = len(rays.near)
    blended = BlendedRays(np.empty((n, 3)), np.empty(n), np.empty(n), np.empty(n, np.int64), np.zeros(scene.n, bool))
    limits = limits_of(conventions, len(scene.ids))
    _blend(scene, _wide(colors), rays, _wide(background), limits, n_threads(), blended)
    return blended


def list_hits(scene: Scene, rays: Rays, conventions: Conventions) -> Hits:
    """Return the blended hits of each ray; see :func:`minisplat_ref.extensions.rays.reference.list_hits`."""
    counts = blend_rays(scene, np.zeros((scene.n, 3)), rays, np.zeros(3), conventions).n_hits
    hits = _listed(scene, rays, conventions, counts)
    return hits._replace(gaussian_ids=scene.ids[hits.gaussian_ids].astype(np.int64))


def blend_rays_vjp(
    scene: Scene,
    colors: Floats,
    rays: Rays,
    background: Floats,
    conventions: Conventions,
    blended: BlendedRays,
    v_blended: tuple[Floats, Floats, Floats],
) -> RayGradient:
    """Gradient of :func:`blend_rays`: see :func:`minisplat_ref.extensions.rays.reference.blend_rays_vjp`."""
    v_image, v_depths, v_transmittances = (_wide(v) for v in v_blended)
    hits = _listed(scene, rays, conventions, blended.n_hits)
    behind = hits.transmittances * (v_image @ _wide(background) + v_transmittances)
    n_hits, n_rays, n_rows = len(hits.ray_ids), len(rays.near), len(scene.ids)
    v = _HitGradient(np.empty(n_hits), np.empty(n_hits), np.empty((n_rays, 6)))
    cotangents, limits = _RayCotangents(v_image, v_depths, behind), limits_of(conventions, n_rows)
    _differentiate_rays(scene, _wide(colors), rays, limits, n_threads(), hits, cotangents, v)
    order, offsets = np.empty(n_hits, np.int64), np.zeros(n_rows + 1, np.int64)
    _sort_by_gaussian(hits.gaussian_ids, offsets, order)
    sums, v_gaussians = np.empty((n_rows, 16)), np.zeros((scene.n, 16))
    _add_up(scene, rays, n_threads(), hits, (order, offsets), v_image, v, sums)
    v_gaussians[scene.ids] = sums
    return RayGradient(
        means=v_gaussians[:, 9:12],
        maps=v_gaussians[:, :9].reshape(-1, 3, 3),
        opacities=v_gaussians[:, 12],
        colors=v_gaussians[:, 13:],
        background=np.sum(hits.transmittances[:, None] * v_image, axis=0),
        origins=v.rays[:, :3],
        directions=v.rays[:, 3:],
    )


def _listed(scene: Scene, rays: Rays, conventions: Conventions, counts: Ints) -> Hits:
    """Return the hits, ``counts`` [P] per ray, with rows of the scene instead of the population's."""
    offsets = np.concatenate([[0], np.cumsum(counts)])
    n_hits = int(offsets[-1])
    ray_ids, rows = np.empty((2, n_hits), np.int64)
    unclamped, depths, weights = np.empty((3, n_hits))
    hits = Hits(offsets, ray_ids, rows, unclamped, depths, weights, np.empty(len(counts)))
    _list(scene, rays, limits_of(conventions, len(scene.ids)), n_threads(), hits)
    return hits


def _wide(array: Floats) -> Floats:
    return np.ascontiguousarray(array, np.float64)
