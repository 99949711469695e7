"""Rays through the pixels of an image, forward and back, by the lists of its tiles.

A tile has eight packets of eight rays. A packet tests the primitives of its tile whose boxes it overlaps, nearest
first, until all others begin behind the last hit that counts; then each ray sorts its hits by t, ties by row, and
blends them. Once the hits that a ray has found let less light through than it may end with, nothing beyond the farthest
of them counts, because other primitives in front can only dim the ray more.

The gradient needs no lock and depends on no order of threads: each tile adds the contributions of its rays to separate
rows, one for each primitive in its list, and each primitive then sums its rows in the order of the tiles.

Bundles that a kernel writes to are taken apart first: Numba drops ``bundle.array[i] = x`` from a parallel loop.
"""

import functools
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.compositing.exponential import exp_wide
from minisplat_ref.cpu.memory import large_empty
from minisplat_ref.jit.compile import kernel, n_threads, prange, scalar
from minisplat_ref.jit.lanes import (
    WIDTH,
    accumulate,
    broadcast,
    gather,
    load,
    maximum,
    minimum,
    reduce_any,
    reduce_max,
    reduce_sums,
    scatter,
    select,
    store,
)
from minisplat_ref.jit.scheduling import dynamic_range, fetch_and_add, make_shared_counter
from minisplat_ref.mechanisms.rays.kernels import is_accepted
from minisplat_ref.mechanisms.rays.pixel_rays import BlendedRays, Hits, ImageTracer, RayGradient, Rays
from minisplat_ref.mechanisms.rays.tile_lists import TILE, TileLists
from minisplat_ref.mechanisms.rays.traversal import END_MARGIN, OPACITY, limits_of, rays_of
from minisplat_ref.types import Floats, Ints

PACKET_WIDTH, PACKET_HEIGHT = 4, 2  # pixels; eight packets, two side by side, make a tile
N_PACKETS = TILE * TILE // WIDTH
PRIMITIVES_PER_PART = 64
HITS_KEPT_PER_RAY = 64  # more than rays meet on average; memory that no hit needs is never touched
HITS_KEPT_MAX = 1 << 24  # 540 MB
PAIR, UNCLAMPED, T_OF_HIT, WEIGHT = range(4)  # columns of a hit that is kept
OF_OPACITY, OF_COLOR, OF_SHAPE = 3, 4, 7  # columns of a gradient, after that of the mean
ROOM_FOR_SHAPE = 9
N_SUMS = OF_SHAPE + ROOM_FOR_SHAPE  # twice eight


class RayResponse(NamedTuple):
    """The response of one record to a ray."""

    meet: Callable
    """``meet(records, row, ray)`` of eight rays: see :func:`~minisplat_ref.mechanisms.rays.traversal.finder`."""
    meet_vjp: Callable
    """``meet_vjp(records, row, ray, unclamped, v_unclamped, v_t)`` of eight rays: tuples of derivatives with respect to
    the mean [3], the ray's direction [3], and the shape [n_shape]. That of its origin is that of the mean, negative.
    Where a ray misses, they are ignored."""
    n_shape: int
    """At most ``ROOM_FOR_SHAPE``."""
    shapes_of: Callable[[Floats], Floats]
    """``shapes_of(v)``: a gradient of shapes [N, ...] from one of the records' [N, n_shape]."""


class InImage(NamedTuple):
    """N primitives in the lists of an image's tiles."""

    response: RayResponse
    lists: TileLists
    records: Floats
    """[N, C] that the response reads; the column ``OPACITY`` is the opacity. Those in no list may hold anything."""


class KeptHits(NamedTuple):
    """The blended hits of rays, as forward found them: the gradient traces nothing again.

    Ray r has ``n_hits[r]`` of them from ``starts[r]`` on, nearest first. Which rays come first depends on the threads.
    """

    starts: Ints
    """[P]."""
    n_hits: Ints
    """[P]."""
    hits: Floats
    """[room, 4] the pair, an integer; alpha before the clamp; t; ``w = alpha T``."""
    n_used: Ints
    """[1] the room that all hits need; if there was less, some are missing."""


class _Blended(NamedTuple):
    colors: Floats  # [N, 3]
    background: Floats  # [3]
    transmittances: Floats  # [P]
    starts: Ints  # [P] as of the hits that were kept
    n_hits: Ints  # [P]
    hits: Floats  # [H, 4]


class _Cotangents(NamedTuple):
    image: Floats  # [P, 3]
    depths: Floats  # [P]
    transmittances: Floats  # [P]


class _Kernels(NamedTuple):
    blend: Callable
    differentiate: Callable


def tracer_of(primitives: InImage) -> ImageTracer:
    """Return the three functions of tracing."""
    return ImageTracer(
        partial(list_hits, primitives), partial(blend_rays, primitives), partial(blend_rays_vjp, primitives)
    )


@scalar
def packets_of_box(boxes, n, x0, y0):
    """Return which packets of the tile at (x0, y0) a box overlaps, as bits."""
    left, right = max(boxes[n, 0] - x0, 0) // PACKET_WIDTH, min(boxes[n, 2] - x0 - 1, TILE - 1) // PACKET_WIDTH
    top, bottom = max(boxes[n, 1] - y0, 0) // PACKET_HEIGHT, min(boxes[n, 3] - y0 - 1, TILE - 1) // PACKET_HEIGHT
    columns = (2 << right) - (1 << left)  # of two bits
    packets = 0
    for row in range(top, bottom + 1):
        packets |= columns << 2 * row
    return packets


@scalar
def pixel_at(x, y, listed, other):
    """Return the pixel at (x, y), or another where this is beyond the image's edges."""
    return y * listed.width + x if x < listed.width and y < listed.height else other


@scalar
def pixels_of_packet(x, y, listed, other):
    """Return the eight pixels of the packet at (x, y), with another one for those beyond the image's edges."""
    return (
        pixel_at(x, y, listed, other),
        pixel_at(x + 1, y, listed, other),
        pixel_at(x + 2, y, listed, other),
        pixel_at(x + 3, y, listed, other),
        pixel_at(x, y + 1, listed, other),
        pixel_at(x + 1, y + 1, listed, other),
        pixel_at(x + 2, y + 1, listed, other),
        pixel_at(x + 3, y + 1, listed, other),
    )


@scalar
def only_where(condition, v):
    """Return three lanes, with zeros where a condition does not hold."""
    return select(condition, v[0], 0.0), select(condition, v[1], 0.0), select(condition, v[2], 0.0)


def _padding(n: int) -> Callable:
    """Return a function that appends n copies of a value to a tuple."""
    if n == 0:
        return scalar(lambda v, value: v)
    pad_rest = _padding(n - 1)

    @scalar
    def pad(v, value):
        return pad_rest((*v, value), value)

    return pad


@functools.cache
def _kernels_of(response: RayResponse) -> _Kernels:
    """Return the kernels of a response; each is compiled when it is first called."""
    meet, meet_vjp, n_shape = response.meet, response.meet_vjp, response.n_shape
    pad = _padding(ROOM_FOR_SHAPE - n_shape)

    @kernel()
    def blend(listed, records, shades, rays, limits, n_threads, blended, kept):
        rows, boxes, nearest, width, height = listed.rows, listed.boxes, listed.nearest, listed.width, listed.height
        n_columns, longest = (width + TILE - 1) // TILE, np.max(np.diff(listed.offsets))
        least = END_MARGIN * limits.transmittance_min
        taken = make_shared_counter()
        colors, background = shades
        for _ in prange(n_threads):
            image, depths, transmittances, is_seen = blended
            starts, n_hits, kept_hits, n_used = kept
            packets, pairs = np.empty(longest, np.uint8), np.empty(longest, np.int64)
            ts, alphas = np.empty(WIDTH * longest, np.float64), np.empty(WIDTH * longest, np.float64)
            order, sorted_ts = np.empty(longest, np.int64), np.empty(longest, np.float64)
            nearest_left = np.empty(longest, np.float64)
            for tile in dynamic_range(taken, len(listed.offsets) - 1):
                first, end = listed.offsets[tile], listed.offsets[tile + 1]
                tile_x, tile_y = TILE * (tile % n_columns), TILE * (tile // n_columns)
                nearest_so_far = np.inf
                for i in range(end - 1, first - 1, -1):
                    packets[i - first] = packets_of_box(boxes, rows[i], tile_x, tile_y)
                    nearest_so_far = min(nearest_so_far, nearest[rows[i]])
                    nearest_left[i - first] = nearest_so_far
                for packet in range(N_PACKETS):
                    x, y = tile_x + PACKET_WIDTH * (packet & 1), tile_y + PACKET_HEIGHT * (packet >> 1)
                    if x >= width or y >= height:
                        continue
                    eight = pixels_of_packet(x, y, listed, y * width + x)
                    ray, near, far = rays_of(rays, eight), gather(rays.near, eight, 0), gather(rays.far, eight, 0)
                    bound, farthest, n = far, reduce_max(far), 0
                    left, last = broadcast(1.0), broadcast(-np.inf)
                    for i in range(first, end):
                        if not packets[i - first] >> packet & 1:
                            continue
                        row = rows[i]
                        if nearest_left[i - first] > farthest:
                            break
                        t, q = meet(records, row, ray)
                        is_met = (q < np.inf) & (near < t) & (t < far) & (t <= bound)
                        if not reduce_any(is_met):
                            continue
                        unclamped = records[row, OPACITY] * exp_wide(-0.5 * q)
                        alpha = minimum(unclamped, limits.alpha_max)
                        is_met = is_met & (alpha >= limits.alpha_min)
                        pairs[n] = i
                        store(ts, WIDTH * n, select(is_met, t, np.inf))
                        store(alphas, WIDTH * n, unclamped)
                        n += 1
                        left = left * select(is_met, 1.0 - alpha, 1.0)
                        last = maximum(last, select(is_met, t, -np.inf))
                        bound = minimum(bound, select(left < least, last, np.inf))
                        farthest = reduce_max(bound)
                    for k in range(WIDTH):
                        if x + k % PACKET_WIDTH >= width or y + k // PACKET_WIDTH >= height:
                            continue
                        n_met = 0
                        for j in range(n):
                            order[n_met], sorted_ts[n_met] = j, ts[WIDTH * j + k]
                            n_met += ts[WIDTH * j + k] < np.inf
                        for h in range(1, n_met):
                            i, j, t_j = h, order[h], sorted_ts[h]
                            while i > 0 and (
                                sorted_ts[i - 1] > t_j
                                or (sorted_ts[i - 1] == t_j and rows[pairs[order[i - 1]]] > rows[pairs[j]])
                            ):
                                sorted_ts[i], order[i] = sorted_ts[i - 1], order[i - 1]
                                i -= 1
                            sorted_ts[i], order[i] = t_j, j
                        start = fetch_and_add(n_used, n_met)
                        is_kept = start + n_met <= len(kept_hits)
                        T, red, green, blue, depth, count = 1.0, 0.0, 0.0, 0.0, 0.0, 0
                        while count < n_met:
                            j = order[count]
                            one = alphas[WIDTH * j + k]
                            alpha_j = min(limits.alpha_max, one)
                            after = T * (1.0 - alpha_j)
                            if not is_accepted(after, limits):
                                break
                            weight, g = alpha_j * T, rows[pairs[j]]
                            red += weight * colors[g, 0]
                            green += weight * colors[g, 1]
                            blue += weight * colors[g, 2]
                            depth += weight * sorted_ts[count]
                            is_seen[g] = True
                            if is_kept:
                                h = start + count
                                kept_hits[h, PAIR], kept_hits[h, UNCLAMPED] = pairs[j], one
                                kept_hits[h, T_OF_HIT], kept_hits[h, WEIGHT] = sorted_ts[count], weight
                            T = after
                            count += 1
                        r = (y + k // PACKET_WIDTH) * width + x + k % PACKET_WIDTH
                        image[r, 0] = red + T * background[0]
                        image[r, 1] = green + T * background[1]
                        image[r, 2] = blue + T * background[2]
                        depths[r], transmittances[r], n_hits[r], starts[r] = depth, T, count, start

    @kernel()
    def differentiate(listed, records, rays, limits, n_threads, blended, cotangents, v):
        """Write the gradient with respect to each ray, and that of each pair: mean, opacity, colour, shape."""
        rows, width, height = listed.rows, listed.width, listed.height
        n_columns, longest = (width + TILE - 1) // TILE, np.max(np.diff(listed.offsets))
        taken = make_shared_counter()
        for _ in prange(n_threads):
            v_pairs, v_origins, v_directions = v
            is_hit, values = np.zeros(longest, np.bool_), np.zeros(4 * WIDTH * longest)
            colors, background, transmittances, starts, n_hits, hits = blended
            for tile in dynamic_range(taken, len(listed.offsets) - 1):
                first, end = listed.offsets[tile], listed.offsets[tile + 1]
                tile_x, tile_y = TILE * (tile % n_columns), TILE * (tile // n_columns)
                for i in range(N_SUMS * first, N_SUMS * end):
                    v_pairs[i] = 0.0
                for packet in range(N_PACKETS):
                    x, y = tile_x + PACKET_WIDTH * (packet & 1), tile_y + PACKET_HEIGHT * (packet >> 1)
                    if x >= width or y >= height:
                        continue
                    for k in range(WIDTH):  # from the last hit to the first
                        if x + k % PACKET_WIDTH >= width or y + k // PACKET_WIDTH >= height:
                            continue
                        r = (y + k // PACKET_WIDTH) * width + x + k % PACKET_WIDTH
                        red, green, blue = cotangents.image[r, 0], cotangents.image[r, 1], cotangents.image[r, 2]
                        v_depth = cotangents.depths[r]
                        behind = red * background[0] + green * background[1] + blue * background[2]
                        behind = transmittances[r] * (behind + cotangents.transmittances[r])
                        for h in range(starts[r] + n_hits[r] - 1, starts[r] - 1, -1):
                            pair, unclamped, weight = int(hits[h, PAIR]), hits[h, UNCLAMPED], hits[h, WEIGHT]
                            g, j = rows[pair], pair - first
                            alpha = min(limits.alpha_max, unclamped)
                            v_dot_c = red * colors[g, 0] + green * colors[g, 1] + blue * colors[g, 2]
                            v_dot_c += v_depth * hits[h, T_OF_HIT]
                            v_alpha = weight / alpha * v_dot_c - behind / (1.0 - alpha)
                            behind += weight * v_dot_c
                            is_hit[j] = True
                            at = 4 * WIDTH * j + k
                            values[at], values[at + WIDTH] = unclamped, weight
                            values[at + 2 * WIDTH] = v_alpha if unclamped <= limits.alpha_max else 0.0
                            values[at + 3 * WIDTH] = weight * v_depth
                    eight, zero = pixels_of_packet(x, y, listed, y * width + x), broadcast(0.0)
                    ray = rays_of(rays, eight)
                    v_image = (
                        gather(cotangents.image, eight, 0),
                        gather(cotangents.image, eight, 1),
                        gather(cotangents.image, eight, 2),
                    )
                    o_x, o_y, o_z, d_x, d_y, d_z = zero, zero, zero, zero, zero, zero
                    for j in range(end - first):
                        if not is_hit[j]:
                            continue
                        row = rows[first + j]
                        at = 4 * WIDTH * j
                        unclamped, weight = load(values, at), load(values, at + WIDTH)
                        v_unclamped, v_t = load(values, at + 2 * WIDTH), load(values, at + 3 * WIDTH)
                        of_mean, of_direction, of_shape = meet_vjp(records, row, ray, unclamped, v_unclamped, v_t)
                        is_own = weight > 0.0
                        of_mean, of_direction = only_where(is_own, of_mean), only_where(is_own, of_direction)
                        o_x, o_y, o_z = o_x - of_mean[0], o_y - of_mean[1], o_z - of_mean[2]
                        d_x, d_y, d_z = d_x + of_direction[0], d_y + of_direction[1], d_z + of_direction[2]
                        of_opacity = unclamped * v_unclamped / records[row, OPACITY]
                        of_color = (weight * v_image[0], weight * v_image[1], weight * v_image[2])
                        sums = (*of_mean, of_opacity, *of_color, *pad(of_shape, zero))
                        at = N_SUMS * (first + j)
                        accumulate(v_pairs, at, reduce_sums(sums[:8]))
                        accumulate(v_pairs, at + WIDTH, reduce_sums(sums[8:]))
                        is_hit[j] = False
                        store(values, 4 * WIDTH * j, (zero, zero, zero, zero))
                    eight = pixels_of_packet(x, y, listed, width * height)
                    scatter(v_origins, eight, 0, o_x)
                    scatter(v_origins, eight, 1, o_y)
                    scatter(v_origins, eight, 2, o_z)
                    scatter(v_directions, eight, 0, d_x)
                    scatter(v_directions, eight, 1, d_y)
                    scatter(v_directions, eight, 2, d_z)

    return _Kernels(blend, differentiate)


@kernel()
def _add_up(listed, n_threads, v_pairs, sums):
    """Add the gradients of each primitive up, over its tiles."""
    n, taken = len(sums), make_shared_counter()
    for _ in prange(n_threads):
        for part in dynamic_range(taken, (n + PRIMITIVES_PER_PART - 1) // PRIMITIVES_PER_PART):
            for row in range(part * PRIMITIVES_PER_PART, min((part + 1) * PRIMITIVES_PER_PART, n)):
                low, high = broadcast(0.0), broadcast(0.0)
                for i in range(listed.row_offsets[row], listed.row_offsets[row + 1]):
                    at = N_SUMS * listed.pairs[i]
                    low, high = low + load(v_pairs, at), high + load(v_pairs, at + WIDTH)
                store(sums[row], 0, low)
                store(sums[row], WIDTH, high)


def blend_rays(
    primitives: InImage, colors: Floats, rays: Rays, background: Floats, conventions: Conventions
) -> BlendedRays:
    """Blend what each ray meets: see :func:`minisplat_ref.mechanisms.rays.blending.blend_rays`.

    Parameters
    ----------
    primitives : InImage
        N primitives.
    rays : Rays
        Those through all pixels of the image, row by row.
    colors, background, conventions
        As there.
    """
    room = min(primitives.lists.n_pixels, HITS_KEPT_PER_RAY * len(rays.near), HITS_KEPT_MAX)
    return _blend(primitives, (colors, background), rays, conventions, room)[0]


def list_hits(primitives: InImage, rays: Rays, conventions: Conventions) -> Hits:
    """Return the blended hits of each ray: see :func:`minisplat_ref.mechanisms.rays.blending.list_hits`."""
    black = np.zeros((len(primitives.records), 3)), np.zeros(3)
    blended = blend_rays(primitives, black[0], rays, black[1], conventions)
    kept = _kept_of(primitives, rays, conventions, blended)
    offsets = np.concatenate([[0], np.cumsum(blended.n_hits)])
    ray_ids = np.repeat(np.arange(len(rays.near)), blended.n_hits)
    hits = kept.hits[np.arange(offsets[-1]) + (kept.starts - offsets[:-1])[ray_ids]]
    ids = primitives.lists.rows[hits[:, PAIR].astype(np.int64)].astype(np.int64)
    unclamped, depths, weights = hits[:, UNCLAMPED], hits[:, T_OF_HIT], hits[:, WEIGHT]
    return Hits(offsets, ray_ids, ids, unclamped, depths, weights, blended.transmittances)


def blend_rays_vjp(
    primitives: InImage,
    colors: Floats,
    rays: Rays,
    background: Floats,
    conventions: Conventions,
    blended: BlendedRays,
    v_blended: tuple[Floats, Floats, Floats],
) -> RayGradient:
    """Gradient of :func:`blend_rays`: see :func:`minisplat_ref.mechanisms.rays.blending.blend_rays_vjp`."""
    v_image, v_depths, v_transmittances = (_wide(v) for v in v_blended)
    response, lists, records = primitives
    kernels, kept = _kernels_of(response), _kept_of(primitives, rays, conventions, blended)
    n_rays, n = len(rays.near), len(records)
    cotangents, limits = _Cotangents(v_image, v_depths, v_transmittances), limits_of(conventions, n)
    known = _Blended(_wide(colors), _wide(background), blended.transmittances, kept.starts, kept.n_hits, kept.hits)
    v_pairs, sums = large_empty((N_SUMS * len(lists.rows),), np.dtype(np.float64)), np.empty((n, N_SUMS))
    v = v_pairs, np.empty((n_rays + 1, 3)), np.empty((n_rays + 1, 3))  # the last row is for no pixel
    kernels.differentiate(lists, records, rays, limits, n_threads(), known, cotangents, v)
    _add_up(lists, n_threads(), v_pairs, sums)
    return RayGradient(
        means=sums[:, :OF_OPACITY],
        shapes=response.shapes_of(sums[:, OF_SHAPE : OF_SHAPE + response.n_shape]),
        opacities=sums[:, OF_OPACITY],
        colors=sums[:, OF_COLOR:OF_SHAPE],
        background=np.einsum("p,pk->k", blended.transmittances, v_image),
        origins=v[1][:-1],
        directions=v[2][:-1],
    )


def _blend(
    primitives: InImage, shades: tuple[Floats, Floats], rays: Rays, conventions: Conventions, room: int
) -> tuple[BlendedRays, int]:
    """Return the colours of the rays, with their hits if these fit into ``room``, and the room that they need."""
    n_rays, n = len(rays.near), len(primitives.records)
    image, depths, transmittances = np.empty((n_rays, 3)), np.empty(n_rays), np.empty(n_rays)
    is_seen, n_used = np.zeros(n, bool), np.zeros(1, np.int64)
    starts, n_hits = np.empty((2, n_rays), np.int64)
    room_with_rest = 1 << (room - 1).bit_length() if room > 0 else 0  # so that its memory fits the next image, too
    hits = large_empty((room_with_rest, 4), np.dtype(np.float64))[:room]
    kept = KeptHits(starts, n_hits, hits, n_used)
    limits, wide = limits_of(conventions, n), (_wide(shades[0]), _wide(shades[1]))
    arrays = image, depths, transmittances, is_seen
    response, lists, records = primitives
    _kernels_of(response).blend(lists, records, wide, rays, limits, n_threads(), arrays, kept)
    is_complete, needed = n_used[0] <= room, int(n_used[0])
    return BlendedRays(image, depths, transmittances, n_hits, is_seen, kept if is_complete else None), needed


def _kept_of(primitives: InImage, rays: Rays, conventions: Conventions, blended: BlendedRays) -> KeptHits:
    """Return the hits of rays that were blended; where there was no room for them, by tracing once more."""
    if blended.kept is not None:
        kept: KeptHits = blended.kept
        return kept
    black = np.zeros((len(primitives.records), 3)), np.zeros(3)
    room = _blend(primitives, black, rays, conventions, 0)[1]
    return _kept_of(primitives, rays, conventions, _blend(primitives, black, rays, conventions, room)[0])


def _wide(array: Floats) -> Floats:
    return np.ascontiguousarray(array, np.float64)
