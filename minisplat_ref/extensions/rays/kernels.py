"""Rays through a tree of Gaussians: the functions of :mod:`.reference`, without looking at what a ray misses.

A ray goes into the nearer half first and keeps its hits sorted by t. Once those that it has found let less light
through than a ray may end with, no later hit beyond the last of them counts, and no box that begins there: this bound
moves nearer as hits are found. It is exact, because what else lies in front can only dim the ray more.

Bundles that a kernel writes to are taken apart first: Numba drops ``bundle.array[i] = x`` from a parallel loop.

The gradient needs no lock and depends on no order of threads: each ray writes what its hits contribute to rows of their
own, and each Gaussian then adds up its rows in the order of the rays.
"""

import math
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.extensions.rays import bvh
from minisplat_ref.extensions.rays.bvh import IS_INNER, MOST_LEVELS, entry, inverse_of
from minisplat_ref.extensions.rays.types import BlendedRays, Hits, RayGradient, Rays, Whitened
from minisplat_ref.jit.compile import kernel, n_threads, prange, scalar
from minisplat_ref.jit.turns import no_turns, turns
from minisplat_ref.types import Floats, Ints

RAYS_A_TURN = 64
GAUSSIANS_A_TURN = 32
MEAN, OPACITY, REACH = 9, 12, 13  # columns of a record; the map is the first nine
N_COLUMNS = 14
END_MARGIN = 0.999  # of the least transmittance: what is left out by the bound must not hang on a rounding


class Scene(NamedTuple):
    """Gaussians in the order of a tree's leaves."""

    records: Floats
    """[N', N_COLUMNS] of those that can be seen at all."""
    ids: Ints
    """[N'] int32 rows of the population."""
    boxes: Floats
    """[K, 2, 6], as in :class:`.bvh.Tree`; a bundle of a kernel holds no other bundle."""
    children: Ints
    """[K, 2, 2]."""
    n: int
    """Of the population."""


class Limits(NamedTuple):
    """The thresholds as the kernels read them."""

    alpha_min: float
    alpha_max: float
    transmittance_min: float
    stops_at_equality: bool
    capacity: int
    """Most hits that a ray holds at once."""


def scene_of(gaussians: Whitened, conventions: Conventions) -> Scene:
    """Return Gaussians with their tree; those that are too faint, or not finite, are left out."""
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
    """Return the thresholds of conventions; a ray through n Gaussians holds few if each takes its part of the light."""
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


class Found(NamedTuple):
    """What one ray has found, nearest first, and what it still has to look at; each thread has its own."""

    depths: Floats
    unclamped: Floats
    rows: Ints  # of the scene
    nodes: Ints
    entries: Floats


@scalar
def room_for(capacity):
    """Return empty lists."""
    return Found(
        np.empty(capacity, np.float64),
        np.empty(capacity, np.float64),
        np.empty(capacity, np.int64),
        np.empty(MOST_LEVELS, np.int64),
        np.empty(MOST_LEVELS, np.float64),
    )


@scalar
def whitened(records, row, ray):
    """Return p = M (mu - O) and v = M d."""
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
    """Return t and e = p - t v."""
    t = (v0 * p0 + v1 * p1 + v2 * p2) / (v0 * v0 + v1 * v1 + v2 * v2)
    return t, p0 - t * v0, p1 - t * v1, p2 - t * v2


@scalar
def insert(found, n, t, unclamped, row, ids):
    """Put a hit in its place among n; of equal depths, the lower row of the population comes first."""
    i = n
    while i > 0 and (found.depths[i - 1] > t or (found.depths[i - 1] == t and ids[found.rows[i - 1]] > ids[row])):
        found.depths[i] = found.depths[i - 1]
        found.unclamped[i] = found.unclamped[i - 1]
        found.rows[i] = found.rows[i - 1]
        i -= 1
    found.depths[i], found.unclamped[i], found.rows[i] = t, unclamped, row


@scalar
def find_hits(scene, ray, near, far, limits, found):
    """Fill ``found`` with all hits of a ray that may count, sorted; return how many."""
    ox, oy, oz, dx, dy, dz = ray
    line = ox, oy, oz, inverse_of(dx), inverse_of(dy), inverse_of(dz)
    boxes, children = scene.boxes, scene.children
    least = END_MARGIN * limits.transmittance_min
    n, T, bound = 0, 1.0, far
    found.nodes[0], found.entries[0] = 0, near
    n_waiting = 1
    while n_waiting > 0:
        n_waiting -= 1
        if found.entries[n_waiting] > bound:
            continue
        node = found.nodes[n_waiting]
        t0, t1 = entry(boxes, node, 0, line)
        s0, s1 = entry(boxes, node, 1, line)
        first = 0 if t0 <= s0 else 1
        for turn in range(2):
            side = first if turn == 0 else 1 - first
            begin, end = (t0, t1) if side == 0 else (s0, s1)
            count = children[node, side, 1]
            if count == IS_INNER or begin > end or end < near or begin > bound:
                continue
            for row in range(children[node, side, 0], children[node, side, 0] + count):
                p0, p1, p2, v0, v1, v2 = whitened(scene.records, row, ray)
                t, e0, e1, e2 = nearest_point(p0, p1, p2, v0, v1, v2)
                q = e0 * e0 + e1 * e1 + e2 * e2
                if not (q <= scene.records[row, REACH] and near < t and t < far and t <= bound):
                    continue
                unclamped = scene.records[row, OPACITY] * math.exp(-0.5 * q)
                alpha = min(limits.alpha_max, unclamped)
                if alpha < limits.alpha_min:
                    continue
                insert(found, n, t, unclamped, row, scene.ids)
                n += 1
                T *= 1.0 - alpha
                while n > 1 and T < least:  # does the last count without those that came to lie in front of it?
                    without = T / (1.0 - min(limits.alpha_max, found.unclamped[n - 1]))
                    if without >= least:
                        break
                    n -= 1
                    T = without
                if T < least:
                    bound = found.depths[n - 1]
        for turn in range(2):
            side = 1 - first if turn == 0 else first
            begin, end = (t0, t1) if side == 0 else (s0, s1)
            if children[node, side, 1] == IS_INNER and begin <= end and end >= near and begin <= bound:
                found.nodes[n_waiting], found.entries[n_waiting] = children[node, side, 0], begin
                n_waiting += 1
    return n


@scalar
def goes_on(T, limits):
    """Whether a ray takes the hit that leaves it with T."""
    return T > limits.transmittance_min or (T == limits.transmittance_min and not limits.stops_at_equality)


@scalar
def ray_of(rays, r):
    """Return the origin and the direction of ray r."""
    return (
        rays.origins[r, 0],
        rays.origins[r, 1],
        rays.origins[r, 2],
        rays.directions[r, 0],
        rays.directions[r, 1],
        rays.directions[r, 2],
    )


@kernel()
def _blend(scene, colors, rays, background, limits, n_threads, blended):
    n_rays = len(rays.near)
    taken = no_turns()
    for _ in prange(n_threads):
        found = room_for(limits.capacity)
        image, depths, transmittances, n_hits, is_seen = blended
        for part in turns(taken, (n_rays + RAYS_A_TURN - 1) // RAYS_A_TURN):
            for r in range(part * RAYS_A_TURN, min((part + 1) * RAYS_A_TURN, n_rays)):
                n = find_hits(scene, ray_of(rays, r), rays.near[r], rays.far[r], limits, found)
                T, red, green, blue, depth, count = 1.0, 0.0, 0.0, 0.0, 0.0, 0
                while count < n:
                    alpha = min(limits.alpha_max, found.unclamped[count])
                    after = T * (1.0 - alpha)
                    if not goes_on(after, limits):
                        break
                    weight, g = alpha * T, scene.ids[found.rows[count]]
                    red += weight * colors[g, 0]
                    green += weight * colors[g, 1]
                    blue += weight * colors[g, 2]
                    depth += weight * found.depths[count]
                    is_seen[g] = True
                    T = after
                    count += 1
                image[r, 0] = red + T * background[0]
                image[r, 1] = green + T * background[1]
                image[r, 2] = blue + T * background[2]
                depths[r], transmittances[r], n_hits[r] = depth, T, count


@kernel()
def _list(scene, rays, limits, n_threads, hits):
    """Write the hits down, with rows of the scene; ``hits.offsets`` says how many there are."""
    n_rays = len(rays.near)
    taken = no_turns()
    for _ in prange(n_threads):
        found = room_for(limits.capacity)
        offsets, ray_ids, rows, unclamped, depths, weights, transmittances = hits
        for part in turns(taken, (n_rays + RAYS_A_TURN - 1) // RAYS_A_TURN):
            for r in range(part * RAYS_A_TURN, min((part + 1) * RAYS_A_TURN, n_rays)):
                find_hits(scene, ray_of(rays, r), rays.near[r], rays.far[r], limits, found)
                T, first = 1.0, offsets[r]
                for i in range(offsets[r + 1] - first):
                    alpha = min(limits.alpha_max, found.unclamped[i])
                    ray_ids[first + i], rows[first + i] = r, found.rows[i]
                    unclamped[first + i], depths[first + i] = found.unclamped[i], found.depths[i]
                    weights[first + i] = alpha * T
                    T *= 1.0 - alpha
                transmittances[r] = T


class _HitGradient(NamedTuple):
    unclamped: Floats  # [H]
    depths: Floats  # [H]
    rays: Floats  # [P, 6] with respect to origins and directions


@scalar
def meet_vjp(records, row, ray, unclamped, v_unclamped, v_t):
    """Return v_p and v_v; see the reference's ``meet_vjp``."""
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
def back(records, row, v):
    """Return M^T v."""
    return (
        records[row, 0] * v[0] + records[row, 3] * v[1] + records[row, 6] * v[2],
        records[row, 1] * v[0] + records[row, 4] * v[1] + records[row, 7] * v[2],
        records[row, 2] * v[0] + records[row, 5] * v[1] + records[row, 8] * v[2],
    )


class _RayCotangents(NamedTuple):
    image: Floats  # [P, 3]
    depths: Floats  # [P]
    behind: Floats  # [P] T_end (v_image . b + v_T)


@kernel()
def _differentiate_rays(scene, colors, rays, limits, n_threads, hits, cotangents, v):
    """Write the gradient with respect to each hit and each ray, from the last hit to the first."""
    n_rays = len(rays.near)
    taken = no_turns()
    for _ in prange(n_threads):
        v_unclamped, v_depths, v_rays = v
        for part in turns(taken, (n_rays + RAYS_A_TURN - 1) // RAYS_A_TURN):
            for r in range(part * RAYS_A_TURN, min((part + 1) * RAYS_A_TURN, n_rays)):
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
                    of_p, of_v = meet_vjp(scene.records, row, ray, unclamped, v.unclamped[h], v.depths[h])
                    of_mean, of_direction = back(scene.records, row, of_p), back(scene.records, row, of_v)
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
    """Add the gradient of each Gaussian up: the map, the mean, the opacity, the colour."""
    n_rows = len(scene.ids)
    taken = no_turns()
    order, offsets = groups
    for _ in prange(n_threads):
        for part in turns(taken, (n_rows + GAUSSIANS_A_TURN - 1) // GAUSSIANS_A_TURN):
            for row in range(part * GAUSSIANS_A_TURN, min((part + 1) * GAUSSIANS_A_TURN, n_rows)):
                mean = scene.records[row, MEAN], scene.records[row, MEAN + 1], scene.records[row, MEAN + 2]
                for k in range(16):
                    sums[row, k] = 0.0
                for i in range(offsets[row], offsets[row + 1]):
                    h = order[i]
                    r = hits.ray_ids[h]
                    ray = ray_of(rays, r)
                    unclamped = hits.unclamped[h]
                    of_p, of_v = meet_vjp(scene.records, row, ray, unclamped, v.unclamped[h], v.depths[h])
                    of_mean = back(scene.records, row, of_p)
                    for a in range(3):
                        for b in range(3):
                            sums[row, 3 * a + b] += of_p[a] * (mean[b] - ray[b]) + of_v[a] * ray[3 + b]
                        sums[row, 9 + a] += of_mean[a]
                        sums[row, 13 + a] += hits.weights[h] * v_image[r, a]
                    sums[row, 12] += unclamped / scene.records[row, OPACITY] * v.unclamped[h]


def blend_rays(scene: Scene, colors: Floats, rays: Rays, background: Floats, conventions: Conventions) -> BlendedRays:
    """Blend what each ray meets: see :func:`minisplat_ref.extensions.rays.reference.blend_rays`.

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
    """Return the blended hits of each ray: see :func:`minisplat_ref.extensions.rays.reference.list_hits`."""
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
    """Return the hits, ``counts`` [P] of each ray, with rows of the scene in the place of the population's."""
    offsets = np.concatenate([[0], np.cumsum(counts)])
    n_hits = int(offsets[-1])
    ray_ids, rows = np.empty((2, n_hits), np.int64)
    unclamped, depths, weights = np.empty((3, n_hits))
    hits = Hits(offsets, ray_ids, rows, unclamped, depths, weights, np.empty(len(counts)))
    _list(scene, rays, limits_of(conventions, len(scene.ids)), n_threads(), hits)
    return hits


def _wide(array: Floats) -> Floats:
    return np.ascontiguousarray(array, np.float64)
