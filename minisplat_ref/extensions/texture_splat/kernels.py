"""Textures on lanes: a row of eight pixels is hit at once, and then each of them reads its texels by itself.

As in the plain kernels, the backward pass runs from the front once more, and keeps the part of <v, image> that lies
behind the current hit. The texels' gradients have a place in the slots of (tile, surfel), so that no two threads write
to one number.

The records of surfels and the formula of a hit are those of :mod:`minisplat_ref.mechanisms.surfels.kernels`. With its
functions U, V, W of the pixel, ``u = U / W``, ``z = 1 / W``, a derivative with respect to (u, v) is::

    v_U = z v_u,   v_V = z v_v,   v_W = -z (u v_u + v v_v),   each times (x, y, 1)
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.compositing.hits import pack_lists, sum_slots
from minisplat_ref.cpu.compositing.pixel_rows import (
    KernelPrimitives,
    full_transmittance,
    hit_row,
    list_rows,
    row_of_tile,
    row_pixels,
)
from minisplat_ref.cpu.compositing.responses import KernelResponse
from minisplat_ref.cpu.compositing.tile_state import pack_frame
from minisplat_ref.extensions.texture_splat.textures import N_CHANNELS, REACH, TexelGradient
from minisplat_ref.jit.compile import kernel, n_threads, prange, scalar
from minisplat_ref.jit.lanes import WIDTH, accumulate, gather, load, reduce_any, reduce_sum, select, store
from minisplat_ref.jit.literals import HALF, ONE, ZERO
from minisplat_ref.jit.scheduling import dynamic_range, make_shared_counter
from minisplat_ref.mechanisms.surfels.kernels import response_for
from minisplat_ref.mechanisms.surfels.projection import Surfels
from minisplat_ref.mechanisms.surfels.record_kernels import U, V, W
from minisplat_ref.mechanisms.surfels.response import Layout
from minisplat_ref.scalar.compositing import blend, blend_vjp
from minisplat_ref.types import Floats, TileBins

_PER_SIGMA = np.float32(1 / REACH)
AT_U, AT_V, READ, V_U, V_V, N_BUFFER = range(1, 7)  # of a hit's numbers, in units of eight, after the weight


class Sums(NamedTuple):
    """Gradients of the surfels that a tile lists."""

    records: Floats  # [M * n_gradients * 8]
    texels: Floats  # [M, 8 T^2]


class Channels(NamedTuple):
    """The blended values, and the derivative of the loss with respect to them."""

    image: Floats  # [H * W, 8]
    v_image: Floats  # [H * W, 8]


@scalar
def neighbours(u, size):
    """Return two texels along an axis, the weights of both, and the derivatives of these; outside all are 0."""
    half = HALF * (size - ONE)
    x = (u * _PER_SIGMA + ONE) * half
    below = np.floor(x)
    i, share, slope = int(below), x - below, _PER_SIGMA * half
    first, a, slope_a = 0, ZERO * u, ZERO * u
    if 0 <= i and i < size:
        first, a, slope_a = i, ONE - share, -slope
    second, b, slope_b = 0, ZERO * u, ZERO * u
    if -1 <= i and i + 1 < size:
        second, b, slope_b = i + 1, share, slope
    return first, second, a, b, slope_a, slope_b


@functools.cache
def forward_kernel(response: KernelResponse) -> Callable:
    """Compile the forward kernel for a response."""
    hit = response.hit

    @scalar
    def blend_row(sums, buffer, primitives, size, row, frame):
        T, texels = full_transmittance(row, frame, buffer.dtype.type), primitives.colors
        width = int(size)
        for m in row.members:
            n = row.ids[m]
            unclamped, _, place = hit_row(hit, primitives, n, row)
            T, w = blend(T, unclamped, frame)
            store(buffer, 0, w)
            store(buffer, AT_U * WIDTH, place[1])
            store(buffer, AT_V * WIDTH, place[2])
            for lane in range(WIDTH):
                weight = buffer[lane]
                if weight > ZERO:
                    i0, i1, a0, a1, _, _ = neighbours(buffer[AT_U * WIDTH + lane], size)
                    j0, j1, b0, b1, _, _ = neighbours(buffer[AT_V * WIDTH + lane], size)
                    k00, k01 = (j0 * width + i0) * N_CHANNELS, (j0 * width + i1) * N_CHANNELS
                    k10, k11 = (j1 * width + i0) * N_CHANNELS, (j1 * width + i1) * N_CHANNELS
                    for k in range(N_CHANNELS):
                        above = a0 * texels[n, k00 + k] + a1 * texels[n, k01 + k]
                        below = a0 * texels[n, k10 + k] + a1 * texels[n, k11 + k]
                        sums[lane, k] += weight * (b0 * above + b1 * below)
            if not reduce_any(T > ZERO):
                break

    @kernel()
    def blend_tiles(primitives, size, lists, frame, n_threads, out):
        taken = make_shared_counter()
        for _ in prange(n_threads):
            sums, buffer = np.empty((WIDTH, N_CHANNELS), out.dtype), np.empty(N_BUFFER * WIDTH, out.dtype)
            for tile in dynamic_range(taken, lists.offsets.size - 1):
                members, counts = list_rows(primitives.boxes, tile, lists, frame)
                for i in range(counts.size):
                    row = row_of_tile(i, tile, members, counts, lists, frame)
                    if row.x >= frame.width or row.y >= frame.height:
                        continue
                    sums[:] = ZERO
                    blend_row(sums, buffer, primitives, size, row, frame)
                    first = row.y * frame.width + row.x
                    for lane in range(min(WIDTH, frame.width - row.x)):
                        for k in range(N_CHANNELS):
                            out[first + lane, k] = sums[lane, k]

    return blend_tiles


@functools.cache
def backward_kernel(response: KernelResponse) -> Callable:
    """Compile the backward kernel for a response."""
    hit, hit_vjp, n_gradients = response.hit, response.hit_vjp, response.n_gradients

    @scalar
    def read_vjp(buffer, v_texels, texels, n, size, v, lane):
        """Add to the texels' gradients of a surfel; leave X . v and its derivatives v_u and v_v in the buffer."""
        width, weight = int(size), buffer[lane]
        i0, i1, a0, a1, da0, da1 = neighbours(buffer[AT_U * WIDTH + lane], size)
        j0, j1, b0, b1, db0, db1 = neighbours(buffer[AT_V * WIDTH + lane], size)
        k00, k01 = (j0 * width + i0) * N_CHANNELS, (j0 * width + i1) * N_CHANNELS
        k10, k11 = (j1 * width + i0) * N_CHANNELS, (j1 * width + i1) * N_CHANNELS
        read, v_u, v_v = ZERO * weight, ZERO * weight, ZERO * weight
        for k in range(N_CHANNELS):
            x00, x01, x10, x11 = texels[n, k00 + k], texels[n, k01 + k], texels[n, k10 + k], texels[n, k11 + k]
            above, below = a0 * x00 + a1 * x01, a0 * x10 + a1 * x11
            read += v[k] * (b0 * above + b1 * below)
            v_u += v[k] * (b0 * (da0 * x00 + da1 * x01) + b1 * (da0 * x10 + da1 * x11))
            v_v += v[k] * (db0 * above + db1 * below)
            w_v = weight * v[k]
            v_texels[k00 + k] += b0 * a0 * w_v
            v_texels[k01 + k] += b0 * a1 * w_v
            v_texels[k10 + k] += b1 * a0 * w_v
            v_texels[k11 + k] += b1 * a1 * w_v
        buffer[READ * WIDTH + lane], buffer[V_U * WIDTH + lane], buffer[V_V * WIDTH + lane] = (
            read,
            weight * v_u,
            weight * v_v,
        )

    @scalar
    def chain_row(sums, buffer, v_place, primitives, size, row, frame, channels):
        T, pixels = full_transmittance(row, frame, buffer.dtype.type), row_pixels(row, frame)
        first = row.y * frame.width + row.x
        behind = ZERO * T
        for k in range(N_CHANNELS):
            behind = behind + gather(channels.image, pixels, k) * gather(channels.v_image, pixels, k)
        for m in row.members:
            n, before = row.ids[m], T
            unclamped, _, place = hit_row(hit, primitives, n, row)
            at_u, at_v, z, dx, dy = place[1], place[2], place[3], place[4], place[5]
            T, w = blend(before, unclamped, frame)
            store(buffer, 0, w)
            store(buffer, AT_U * WIDTH, at_u)
            store(buffer, AT_V * WIDTH, at_v)
            buffer[READ * WIDTH :] = ZERO
            for lane in range(WIDTH):
                if buffer[lane] > ZERO:
                    v = channels.v_image[first + lane]
                    read_vjp(buffer, sums.texels[m], primitives.colors, n, size, v, lane)
            v_dot_X = load(buffer, READ * WIDTH)
            behind = behind - w * v_dot_X
            v_alpha = blend_vjp(before, w, unclamped, behind, v_dot_X, frame)
            v_mean = select(unclamped <= frame.mean_gradient_max, v_alpha, ZERO)
            v_shape = select(unclamped <= frame.shape_gradient_max, v_alpha, ZERO)
            at = m * n_gradients * WIDTH
            accumulate(sums.records, at, hit_vjp(primitives.records, n, place, v_mean, v_shape, v_place))
            v_u, v_v = load(buffer, V_U * WIDTH), load(buffer, V_V * WIDTH)
            v_U, v_V, v_W = z * v_u, z * v_v, -z * (at_u * v_u + at_v * v_v)
            accumulate(sums.records, at + U * WIDTH, (v_U * dx, v_U * dy, v_U))
            accumulate(sums.records, at + V * WIDTH, (v_V * dx, v_V * dy, v_V))
            accumulate(sums.records, at + W * WIDTH, (v_W * dx, v_W * dy, v_W))
            if not reduce_any(T > ZERO):
                break

    @kernel()
    def blend_tiles_vjp(primitives, size, lists, frame, n_threads, channels, slots):
        taken = make_shared_counter()
        for _ in prange(n_threads):
            buffer, v_place = np.empty(N_BUFFER * WIDTH, slots.dtype), np.zeros(WIDTH, slots.dtype)
            for tile in dynamic_range(taken, lists.offsets.size - 1):
                first, n_listed = lists.offsets[tile], lists.offsets[tile + 1] - lists.offsets[tile]
                sums = Sums(
                    np.zeros(n_listed * n_gradients * WIDTH, slots.dtype),
                    np.zeros((n_listed, primitives.colors.shape[1]), slots.dtype),
                )
                members, counts = list_rows(primitives.boxes, tile, lists, frame)
                for i in range(counts.size):
                    row = row_of_tile(i, tile, members, counts, lists, frame)
                    if row.x < frame.width and row.y < frame.height:
                        chain_row(sums, buffer, v_place, primitives, size, row, frame, channels)
                for m in range(n_listed):
                    slot = lists.slots[first + m]
                    for j in range(n_gradients):
                        slots[slot, j] = reduce_sum(load(sums.records, (m * n_gradients + j) * WIDTH))
                    for j in range(sums.texels.shape[1]):
                        slots[slot, n_gradients + j] = sums.texels[m, j]

    return blend_tiles_vjp


def blend_texels(surfels: Surfels, texels: Floats, bins: TileBins, conventions: Conventions) -> Floats:
    """Return sums over the hits, [H, W, 8]; see :func:`minisplat_ref.extensions.texture_splat.textures.blend_texels`.

    In the dtype of the texels.
    """
    dtype, grid = texels.dtype, bins.grid
    response = response_for(dtype, surfels, Layout())
    out = np.empty((grid.height * grid.width, N_CHANNELS), dtype)
    forward_kernel(response)(
        _primitives(response, surfels, texels),
        dtype.type(round(texels.shape[1] ** 0.5)),
        pack_lists(bins, response),
        pack_frame(bins, conventions, dtype),
        n_threads(),
        out,
    )
    return out.reshape(grid.height, grid.width, N_CHANNELS)


def blend_texels_vjp(
    surfels: Surfels, texels: Floats, bins: TileBins, conventions: Conventions, image: Floats, v_image: Floats
) -> TexelGradient:
    """Gradient of :func:`blend_texels`; see the reference's."""
    dtype = texels.dtype
    response = response_for(dtype, surfels, Layout())
    n_gradients = response.n_gradients
    slots = np.empty((len(bins.gaussian_ids), n_gradients + texels.shape[1] * N_CHANNELS), dtype)
    backward_kernel(response)(
        _primitives(response, surfels, texels),
        dtype.type(round(texels.shape[1] ** 0.5)),
        pack_lists(bins, response),
        pack_frame(bins, conventions, dtype),
        n_threads(),
        Channels(*(np.ascontiguousarray(array, dtype).reshape(-1, N_CHANNELS) for array in (image, v_image))),
        slots,
    )
    totals = np.zeros((len(texels), slots.shape[1]))
    sum_slots(slots, bins.gaussian_offsets, totals)
    v_T, v_c, v_o, _ = response.records_vjp(surfels, totals[:, :n_gradients])
    return TexelGradient(v_T, v_c, v_o, totals[:, n_gradients:].reshape(texels.shape).astype(dtype))


def _primitives(response: KernelResponse, surfels: Surfels, texels: Floats) -> KernelPrimitives:
    flat = np.ascontiguousarray(texels).reshape(len(texels), texels.shape[1] * N_CHANNELS)
    return KernelPrimitives(response.records(surfels, texels.dtype), flat, response.boxes(surfels))
