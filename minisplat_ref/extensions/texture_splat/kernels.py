"""Textures on lanes: a row of eight pixels is hit at once, and then each of them reads its four texels by itself.

There the eight channels of a texel are lanes. As in the plain kernels, the backward pass runs from the front once more,
and keeps the part of <v, image> that lies behind the current hit. The texels' gradients have a place in the slots of
(tile, surfel), so that no two threads write to one number; a slot without a hit is neither written nor read.

The records of surfels and the formula of a hit are those of :mod:`minisplat_ref.mechanisms.surfels.kernels`. With its
functions U, V, W of the pixel, ``u = U / W``, ``z = 1 / W``, a derivative with respect to (u, v) is::

    v_U = z v_u,   v_V = z v_v,   v_W = -z (u v_u + v v_v),   each times (x, y, 1)
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.compositing.hits import N_CHUNKS, pack_lists, sum_slots
from minisplat_ref.cpu.compositing.pixel_rows import (
    full_transmittance,
    hit_row,
    list_rows,
    row_of_tile,
    row_pixels,
)
from minisplat_ref.cpu.compositing.responses import KernelResponse
from minisplat_ref.cpu.compositing.tile_state import pack_frame
from minisplat_ref.cpu.gaussian_rows import DOUBLE
from minisplat_ref.extensions.texture_splat.textures import N_CHANNELS, REACH, TexelGradient
from minisplat_ref.jit.compile import kernel, n_threads, prange, scalar
from minisplat_ref.jit.lanes import (
    WIDTH,
    accumulate,
    broadcast,
    cast,
    floor,
    gather,
    load,
    reduce_any,
    reduce_sum,
    select,
    store,
)
from minisplat_ref.jit.literals import HALF, ONE, ZERO
from minisplat_ref.jit.scheduling import dynamic_range, make_shared_counter
from minisplat_ref.mechanisms.surfels.kernels import response_for
from minisplat_ref.mechanisms.surfels.projection import Surfels
from minisplat_ref.mechanisms.surfels.record_kernels import U, V, W
from minisplat_ref.mechanisms.surfels.response import Layout
from minisplat_ref.scalar.compositing import blend, blend_vjp
from minisplat_ref.types import Bools, Floats, Ints, TileBins

_PER_SIGMA, _N_CHANNELS = np.float32(1 / REACH), np.float32(N_CHANNELS)
N_CORNERS = 4
# Numbers of a row's hits, each in units of eight: the weight, and for each corner its offset, its share in the value,
# and the product of its channels with the derivative with respect to the value.
WEIGHT, OFFSETS, SHARES, DOTS, N_BUFFER = 0, 1, 1 + N_CORNERS, 1 + 2 * N_CORNERS, 1 + 3 * N_CORNERS


class Textured(NamedTuple):
    """The surfels, as the kernels read them."""

    records: Floats  # [N, F] of the response
    boxes: Ints  # [N, 4] pixels x0, y0, x1, y1, half-open
    texels: Floats  # [N * T^2 * 8]
    size: np.floating  # T, in the dtype of the texels


class Pixels(NamedTuple):
    """The derivative of the loss with respect to the blended values, and its product with these."""

    v_image: Floats  # [H * W * 8]
    v_dot_image: Floats  # [H * W]


class Sums(NamedTuple):
    """Gradients of the surfels that a tile lists, before they are written to their slots."""

    records: Floats  # [L * n_gradients * 8]
    slots: Ints  # [L]


class Slots(NamedTuple):
    """Gradients of surfels in tiles."""

    records: Floats  # [M, n_gradients]
    texels: Floats  # [M * T^2 * 8] undefined where there is no hit
    is_hit: Bools  # [M]


@scalar
def find_neighbours(u, size):
    """Return pairs: two texels along an axis, their weights, and the derivatives of these; outside all are 0."""
    half = HALF * (size - ONE)
    x = (u * _PER_SIGMA + ONE) * half
    first = floor(x)
    share, slope = x - first, broadcast(_PER_SIGMA * half)
    has_first, has_second = (first >= ZERO) & (first < size), (first >= -ONE) & (first < size - ONE)
    texels = select(has_first, first, ZERO), select(has_second, first + ONE, ZERO)
    weights = select(has_first, ONE - share, ZERO), select(has_second, share, ZERO)
    return texels, weights, (select(has_first, -slope, ZERO), select(has_second, slope, ZERO))


@scalar
def multiply_pairs(b, a):
    """Return the products of pairs, in the order of the corners."""
    return b[0] * a[0], b[0] * a[1], b[1] * a[0], b[1] * a[1]


@scalar
def find_corners(u, v, size):
    """Return offsets in a texture, as floats, weights and slopes of the four texels around each hit; see the reference.

    A float32 holds the offsets of up to 1,448 x 1,448 texels exactly.
    """
    i, a, slope_a = find_neighbours(u, size)
    j, b, slope_b = find_neighbours(v, size)
    upper, lower = j[0] * size, j[1] * size
    offsets = upper + i[0], upper + i[1], lower + i[0], lower + i[1]
    return offsets, multiply_pairs(b, a), multiply_pairs(b, slope_a), multiply_pairs(slope_b, a)


@scalar
def scale(factor, four):
    """Return a factor times each of four."""
    return factor * four[0], factor * four[1], factor * four[2], factor * four[3]


@scalar
def sum_products(a, b):
    """Return the sum of four products."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]


@scalar
def texture_length(surfels):
    """Return how many numbers a texture has."""
    return int(surfels.size) * int(surfels.size) * N_CHANNELS


@functools.cache
def forward_kernel(response: KernelResponse) -> Callable:
    """Compile the forward kernel for a response."""
    hit = response.hit

    @scalar
    def read(sums, buffer, texels, first, lane):
        """Add to the channels of a pixel what its hit reads of a texture that begins at first."""
        total = load(sums, lane * N_CHANNELS)
        for corner in range(N_CORNERS):
            offset = int(buffer[(OFFSETS + corner) * WIDTH + lane])
            total = total + buffer[(SHARES + corner) * WIDTH + lane] * load(texels, first + offset)
        store(sums, lane * N_CHANNELS, total)

    @scalar
    def blend_row(sums, buffer, surfels, row, frame):
        T, length = full_transmittance(row, frame, buffer.dtype.type), texture_length(surfels)
        for m in row.members:
            n = row.ids[m]
            unclamped, _, place = hit_row(hit, surfels, n, row)
            T, w = blend(T, unclamped, frame)
            if reduce_any(w > ZERO):
                offsets, weights, _, _ = find_corners(place[1], place[2], surfels.size)
                store(buffer, 0, (w, *scale(_N_CHANNELS, offsets), *scale(w, weights)))
                for lane in range(WIDTH):
                    if buffer[lane] > ZERO:
                        read(sums, buffer, surfels.texels, n * length, lane)
            if not reduce_any(T > ZERO):
                break

    @kernel()
    def blend_tiles(surfels, lists, frame, n_threads, out):
        taken = make_shared_counter()
        for _ in prange(n_threads):
            sums, buffer = np.empty(WIDTH * N_CHANNELS, out.dtype), np.empty(N_BUFFER * WIDTH, out.dtype)
            for tile in dynamic_range(taken, lists.offsets.size - 1):
                members, counts = list_rows(surfels.boxes, tile, lists, frame)
                for i in range(counts.size):
                    row = row_of_tile(i, tile, members, counts, lists, frame)
                    if row.x >= frame.width or row.y >= frame.height:
                        continue
                    sums[:] = ZERO
                    blend_row(sums, buffer, surfels, row, frame)
                    first = row.y * frame.width + row.x
                    for lane in range(min(WIDTH, frame.width - row.x)):
                        store(out, (first + lane) * N_CHANNELS, load(sums, lane * N_CHANNELS))

    return blend_tiles


@functools.cache
def backward_kernel(response: KernelResponse) -> Callable:
    """Compile the backward kernel for a response."""
    hit, hit_vjp, n_gradients = response.hit, response.hit_vjp, response.n_gradients

    @scalar
    def read_vjp(buffer, lane, v, texels, first, v_texels, slot):
        """Add to the texels from ``slot`` on; leave the products of v with those from ``first`` on in the buffer."""
        w_v = buffer[WEIGHT + lane] * v
        for corner in range(N_CORNERS):
            offset = int(buffer[(OFFSETS + corner) * WIDTH + lane])
            buffer[(DOTS + corner) * WIDTH + lane] = reduce_sum(v * load(texels, first + offset))
            accumulate(v_texels, slot + offset, buffer[(SHARES + corner) * WIDTH + lane] * w_v)

    @scalar
    def load_dots(buffer):
        at = DOTS * WIDTH
        first, second = load(buffer, at), load(buffer, at + WIDTH)
        return first, second, load(buffer, at + 2 * WIDTH), load(buffer, at + 3 * WIDTH)

    @scalar
    def open_slot(slots, slot, length):
        """Set the texels of a slot to 0, unless it has had a hit."""
        if not slots.is_hit[slot]:
            slots.is_hit[slot] = True
            slots.texels[slot * length : (slot + 1) * length] = ZERO

    @scalar
    def chain_row(sums, slots, buffer, v_place, surfels, row, frame, pixels):
        T, length = full_transmittance(row, frame, buffer.dtype.type), texture_length(surfels)
        behind = gather(pixels.v_dot_image, row_pixels(row, frame), 0)
        first = row.y * frame.width + row.x
        for m in row.members:
            n, before = row.ids[m], T
            unclamped, _, place = hit_row(hit, surfels, n, row)
            T, w = blend(before, unclamped, frame)
            if reduce_any(w > ZERO):
                at_u, at_v, z, dx, dy = place[1], place[2], place[3], place[4], place[5]
                offsets, weights, slopes_u, slopes_v = find_corners(at_u, at_v, surfels.size)
                store(buffer, 0, (w, *scale(_N_CHANNELS, offsets), *weights))
                buffer[DOTS * WIDTH :] = ZERO
                open_slot(slots, sums.slots[m], length)
                for lane in range(WIDTH):
                    if buffer[lane] > ZERO:
                        v = load(pixels.v_image, (first + lane) * N_CHANNELS)
                        read_vjp(buffer, lane, v, surfels.texels, n * length, slots.texels, sums.slots[m] * length)
                dots = load_dots(buffer)
                v_dot_X = sum_products(weights, dots)
                behind = behind - w * v_dot_X
                v_alpha = blend_vjp(before, w, unclamped, behind, v_dot_X, frame)
                v_mean = select(unclamped <= frame.mean_gradient_max, v_alpha, ZERO)
                v_shape = select(unclamped <= frame.shape_gradient_max, v_alpha, ZERO)
                at = m * n_gradients * WIDTH
                accumulate(sums.records, at, hit_vjp(surfels.records, n, place, v_mean, v_shape, v_place))
                v_u, v_v = w * sum_products(slopes_u, dots), w * sum_products(slopes_v, dots)
                v_U, v_V, v_W = z * v_u, z * v_v, -z * (at_u * v_u + at_v * v_v)
                accumulate(sums.records, at + U * WIDTH, (v_U * dx, v_U * dy, v_U))
                accumulate(sums.records, at + V * WIDTH, (v_V * dx, v_V * dy, v_V))
                accumulate(sums.records, at + W * WIDTH, (v_W * dx, v_W * dy, v_W))
            if not reduce_any(T > ZERO):
                break

    @scalar
    def write_records(sums, slots):
        """Write the sums of records; a function, because Numba drops such stores from the body of a parallel loop."""
        for m in range(sums.slots.size):
            for j in range(n_gradients):
                slots.records[sums.slots[m], j] = reduce_sum(load(sums.records, (m * n_gradients + j) * WIDTH))

    @kernel()
    def blend_tiles_vjp(surfels, lists, frame, n_threads, pixels, slots):
        taken = make_shared_counter()
        for _ in prange(n_threads):
            dtype = slots.records.dtype
            buffer, v_place = np.empty(N_BUFFER * WIDTH, dtype), np.zeros(WIDTH, dtype)
            for tile in dynamic_range(taken, lists.offsets.size - 1):
                of_tile = lists.slots[lists.offsets[tile] : lists.offsets[tile + 1]]
                sums = Sums(np.zeros(of_tile.size * n_gradients * WIDTH, dtype), of_tile)
                members, counts = list_rows(surfels.boxes, tile, lists, frame)
                for i in range(counts.size):
                    row = row_of_tile(i, tile, members, counts, lists, frame)
                    if row.x < frame.width and row.y < frame.height:
                        chain_row(sums, slots, buffer, v_place, surfels, row, frame, pixels)
                write_records(sums, slots)

    return blend_tiles_vjp


@kernel()
def sum_texels(slots, offsets, v_texels):
    """Sum each surfel's slots with hits, which ``offsets`` [N + 1] delimit, in float64 to [N * T^2 * 8]."""
    n_surfels, zero = offsets.size - 1, v_texels.dtype.type(0)
    length = v_texels.size // max(n_surfels, 1)
    for chunk in prange(N_CHUNKS):
        for n in range(n_surfels * chunk // N_CHUNKS, n_surfels * (chunk + 1) // N_CHUNKS):
            for k in range(0, length, WIDTH):
                total = broadcast(DOUBLE)
                for slot in range(offsets[n], offsets[n + 1]):
                    if slots.is_hit[slot]:
                        total = total + cast(load(slots.texels, slot * length + k), DOUBLE)
                store(v_texels, n * length + k, cast(total, zero))


def blend_texels(surfels: Surfels, texels: Floats, bins: TileBins, conventions: Conventions) -> Floats:
    """Return sums over the hits, [H, W, 8]; see :func:`minisplat_ref.extensions.texture_splat.textures.blend_texels`.

    In the dtype of the texels.
    """
    dtype, grid = texels.dtype, bins.grid
    response = response_for(dtype, surfels, Layout())
    out = np.empty(grid.height * grid.width * N_CHANNELS, dtype)
    forward_kernel(response)(
        _pack_surfels(response, surfels, texels),
        pack_lists(bins, response),
        pack_frame(bins.grid, conventions, dtype),
        n_threads(),
        out,
    )
    return out.reshape(grid.height, grid.width, N_CHANNELS)


def blend_texels_vjp(
    surfels: Surfels, texels: Floats, bins: TileBins, conventions: Conventions, image: Floats, v_image: Floats
) -> TexelGradient:
    """Gradient of :func:`blend_texels`; see the reference's."""
    dtype, n_pairs = texels.dtype, len(bins.gaussian_ids)
    response = response_for(dtype, surfels, Layout())
    slots = Slots(
        np.empty((n_pairs, response.n_gradients), dtype),
        np.empty(n_pairs * texels.shape[1] * N_CHANNELS, dtype),
        np.zeros(n_pairs, bool),
    )
    v_dot_image = np.einsum("yxk,yxk->yx", v_image, image).astype(dtype)
    backward_kernel(response)(
        _pack_surfels(response, surfels, texels),
        pack_lists(bins, response),
        pack_frame(bins.grid, conventions, dtype),
        n_threads(),
        Pixels(np.ascontiguousarray(v_image, dtype).reshape(-1), v_dot_image.reshape(-1)),
        slots,
    )
    v_records, v_texels = np.zeros((len(texels), response.n_gradients)), np.empty(texels.shape, dtype)
    sum_slots(slots.records, bins.gaussian_offsets, v_records)
    sum_texels(slots, bins.gaussian_offsets, v_texels.reshape(-1))
    v_T, v_c, v_o, _ = response.records_vjp(surfels, v_records)
    return TexelGradient(v_T, v_c, v_o, v_texels)


def _pack_surfels(response: KernelResponse, surfels: Surfels, texels: Floats) -> Textured:
    size, flat = texels.dtype.type(round(texels.shape[1] ** 0.5)), np.ascontiguousarray(texels).reshape(-1)
    return Textured(response.records(surfels, texels.dtype), response.boxes(surfels), flat, size)
