"""The plain kernels: blending forward and backward, for any primitive. Read these first, then the tuned ones.

Every splatting method is this loop: a pixel meets the primitives of its tile, nearest first, and takes from each what
the light in front has left. What a primitive is stands in a :class:`KernelResponse`; here is only the loop, eight
pixels of a line at a time. Each row of eight goes through the tile's list by itself::

    a tile                       its list [M]                  what a row keeps, eight numbers each
    +--------+--------+ - -
    | row 0  | row 1  |          ids  | 7 | 3 | 9 | 4 | ...    forward    T         transmittance, negative once the
    +--------+--------+ - -            does the box of 7                            pixel is finished
    | row 2  | ...    |                hold a pixel of row 0?             image[k]  so far, D channels
    +--------+--------+ - -            then hit, shade, blend  backward   T
    |        |                                                            behind    part of <v, image> to come
                                                                          v[k]      dL/dimage, D channels

    sums [M, G + S, 8]   of this tile, backward: | gradient of the record: G | gradient of the colours: S |
    slots [M_all, G + S] the same of all tiles, with the eight added up; a primitive's slots lie side by side

Backward, a row goes through the list from the front once more, so that every threshold falls as it did forward. Of
<v, image> it keeps the part that lies behind the current hit: it starts as the whole and shrinks hit by hit. No two
threads write to one slot, and slots are added up in their order, so that the bytes of a gradient do not depend on the
number of threads.

Where pixels sort their hits (``buffer_size`` above 1), :mod:`minisplat_ref.cpu.hit_buffer` goes through the list.
Left out: what the tuned kernels (``blend_forward``, ``blend_backward``) do to be faster, and blend statistics.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from minisplat_ref.constants import LIST_ORDER, Conventions
from minisplat_ref.cpu.hit_buffer import ALPHA, CHANNELS, V_ALPHA, WEIGHT, hit_buffer, hit_rows, walk_sorted
from minisplat_ref.cpu.pixel_rows import (
    Lists,
    Pixels,
    Scene,
    field_of,
    full_transmittance,
    hit_row,
    list_rows,
    row_pixels,
    rows_of_tile,
)
from minisplat_ref.cpu.responses import KernelResponse
from minisplat_ref.cpu.tile_state import frame_of
from minisplat_ref.scalar._jit import kernel, n_threads, prange, scalar
from minisplat_ref.scalar.compositing import blend, blend_vjp
from minisplat_ref.scalar.lanes import (
    WIDTH,
    accumulate,
    any_of,
    filled,
    gather,
    load,
    scatter,
    select,
    store,
    sum_of,
)
from minisplat_ref.scalar.literals import ONE, ZERO
from minisplat_ref.scalar.turns import no_turns, turns
from minisplat_ref.types import BlendGradient, Floats, RenderOutput, TileBins

N_CHUNKS = 64  # of the primitives, when their slots are added up


@functools.cache
def forward_kernel(response: KernelResponse, n_channels: int) -> Callable:
    """Compile the forward kernel for a response and a number of channels."""
    hit, shade, is_sorted = response.hit, response.shade, response.buffer_size > LIST_ORDER

    @scalar
    def take(row, hits, rows, frame):
        """Blend hits of a buffer into a row."""
        after, weight = blend(load(row, 0), gather(hits, rows, ALPHA), frame)
        store(row, 0, after)
        for k in range(n_channels):
            accumulate(row, (1 + k) * WIDTH, weight * gather(hits, rows, CHANNELS + k))

    walk = walk_sorted(hit, shade, n_channels, take)

    @scalar
    def draw_row(row, scene, ids, members, x, y, frame):
        """Blend the ``members`` of the list ``ids`` [M] into ``row`` [(1 + D) * 8]."""
        T = load(row, 0)
        for m in members:
            n = ids[m]
            unclamped, _, place = hit_row(hit, scene, n, x, y)
            T, weight = blend(T, unclamped, frame)
            for k in range(n_channels):
                accumulate(row, (1 + k) * WIDTH, weight * shade(scene.colors, n, k, place))
            if not any_of(T > ZERO):
                break
        store(row, 0, T)

    @kernel()
    def composite_tiles(scene, background, lists, frame, n_threads, out):
        taken = no_turns()
        for _ in prange(n_threads):
            row = np.empty((1 + n_channels) * WIDTH, out.image.dtype)
            for tile in turns(taken, lists.offsets.size - 1):
                ids = lists.ids[lists.offsets[tile] : lists.offsets[tile + 1]]
                buffer = hit_buffer(ids.size if is_sorted else 0, n_channels, row.dtype)
                members, counts = list_rows(scene.boxes, ids, tile, lists, frame)
                for i, x, y in rows_of_tile(tile, lists, frame):
                    row[:] = ZERO
                    store(row, 0, full_transmittance(x, frame, row.dtype.type))
                    if is_sorted:
                        walk(row, buffer, scene, ids, members[i, : counts[i]], lists.buffer_size, x, y, frame)
                    else:
                        draw_row(row, scene, ids, members[i, : counts[i]], x, y, frame)
                    pixels, T_end = row_pixels(x, y, frame), abs(field_of(row, 0, x, frame))
                    scatter(out.alpha, pixels, 0, ONE - T_end)
                    for k in range(n_channels):
                        scatter(out.image, pixels, k, field_of(row, 1 + k, x, frame) + T_end * background[k])

    return composite_tiles


@functools.cache
def backward_kernel(response: KernelResponse, n_channels: int) -> Callable:
    """Compile the backward kernel for a response and a number of channels."""
    hit, hit_vjp, shade, shade_vjp = response.hit, response.hit_vjp, response.shade, response.shade_vjp
    n_gradients, n_coefficients, n_places = response.n_gradients, response.n_coefficients, response.n_places
    n_sums, is_sorted = n_gradients + n_channels * n_coefficients, response.buffer_size > LIST_ORDER
    behind_place, v_first = WIDTH, 2 * WIDTH  # of a row, after the transmittance

    @scalar
    def start_row(row, output, v_output, x, y, frame):
        """Fetch v for eight pixels, and <v, image> with the share of alpha = 1 - T_end."""
        pixels, T = row_pixels(x, y, frame), full_transmittance(x, frame, row.dtype.type)
        store(row, 0, T)
        behind = gather(v_output.alpha, pixels, 0) * (gather(output.alpha, pixels, 0) - ONE)
        for k in range(n_channels):
            v = gather(v_output.image, pixels, k)
            behind = behind + v * gather(output.image, pixels, k)
            store(row, v_first + k * WIDTH, select(T > ZERO, v, ZERO))
        store(row, behind_place, behind)

    @scalar
    def take_vjp(row, unclamped, light, frame):
        """Blend one hit of <v, colour> ``light`` once more; return dL/dalpha and its weight."""
        T = load(row, 0)
        after, weight = blend(T, unclamped, frame)
        behind = load(row, behind_place) - weight * light
        store(row, 0, after)
        store(row, behind_place, behind)
        return blend_vjp(T, weight, unclamped, behind, light, frame), weight

    @scalar
    def take(row, hits, rows, frame):
        """Blend hits of a buffer once more, and write down what they get."""
        unclamped, light = gather(hits, rows, ALPHA), filled(row.dtype.type(0))
        for k in range(n_channels):
            light = light + load(row, v_first + k * WIDTH) * gather(hits, rows, CHANNELS + k)
        v_alpha, weight = take_vjp(row, unclamped, light, frame)
        scatter(hits, rows, V_ALPHA, v_alpha)
        scatter(hits, rows, WEIGHT, weight)

    walk = walk_sorted(hit, shade, n_channels, take)

    @scalar
    def chain(sums, v_place, row, scene, n, place, gradient, frame):
        """Add what eight pixels contribute to the ``sums`` [(G + S) * 8] of primitive n."""
        unclamped, v_alpha, weight = gradient
        v_place[:] = ZERO
        for k in range(n_channels):
            v_channel = weight * load(row, v_first + k * WIDTH)
            v_coefficients, v_place_k = shade_vjp(scene.colors, n, k, place, v_channel)
            accumulate(sums, (n_gradients + k * n_coefficients) * WIDTH, v_coefficients)
            accumulate(v_place, 0, v_place_k)
        v_mean = select(unclamped <= frame.mean_gradient_max, v_alpha, ZERO)
        v_shape = select(unclamped <= frame.shape_gradient_max, v_alpha, ZERO)
        accumulate(sums, 0, hit_vjp(scene.records, n, place, v_mean, v_shape, v_place))

    @scalar
    def chain_row(row, sums, v_place, scene, ids, members, x, y, frame):
        """Go through the ``members`` of the list ``ids`` [M] once more and add to their ``sums``."""
        for m in members:
            n = ids[m]
            unclamped, _, place = hit_row(hit, scene, n, x, y)
            light = filled(row.dtype.type(0))
            for k in range(n_channels):
                light = light + load(row, v_first + k * WIDTH) * shade(scene.colors, n, k, place)
            v_alpha, weight = take_vjp(row, unclamped, light, frame)
            gradient = unclamped, v_alpha, weight
            chain(sums[m * n_sums * WIDTH :], v_place, row, scene, n, place, gradient, frame)
            if not any_of(load(row, 0) > ZERO):
                break

    @scalar
    def chain_sorted_row(row, sums, v_place, buffer, scene, ids, members, lists, x, y, frame):
        """Do the same where pixels sort their hits: in their order for dL/dalpha, then in the list's."""
        for h in range(walk(row, buffer, scene, ids, members, lists.buffer_size, x, y, frame)):
            m, rows = buffer.members[h], hit_rows(h)
            unclamped, _, place = hit_row(hit, scene, ids[m], x, y)
            gradient = unclamped, gather(buffer.hits, rows, V_ALPHA), gather(buffer.hits, rows, WEIGHT)
            chain(sums[m * n_sums * WIDTH :], v_place, row, scene, ids[m], place, gradient, frame)

    @kernel()
    def composite_tiles_vjp(scene, lists, frame, n_threads, output, v_output, slots, v_backgrounds):
        taken = no_turns()
        for _ in prange(n_threads):
            row = np.empty((2 + n_channels) * WIDTH, slots.dtype)
            v_place = np.empty(n_places * WIDTH, slots.dtype)
            for tile in turns(taken, lists.offsets.size - 1):
                first, end = lists.offsets[tile], lists.offsets[tile + 1]
                ids, sums = lists.ids[first:end], np.zeros((end - first) * n_sums * WIDTH, slots.dtype)
                buffer = hit_buffer(ids.size if is_sorted else 0, n_channels, row.dtype)
                members, counts = list_rows(scene.boxes, ids, tile, lists, frame)
                for i, x, y in rows_of_tile(tile, lists, frame):
                    start_row(row, output, v_output, x, y, frame)
                    if is_sorted:
                        chain_sorted_row(row, sums, v_place, buffer, scene, ids, members[i, : counts[i]], lists, x, y, frame)
                    else:
                        chain_row(row, sums, v_place, scene, ids, members[i, : counts[i]], x, y, frame)
                    for k in range(n_channels):
                        v_backgrounds[tile, k] += sum_of(abs(load(row, 0)) * load(row, v_first + k * WIDTH))
                for m in range(ids.size):
                    for j in range(n_sums):
                        slots[lists.slots[first + m], j] = sum_of(load(sums, (m * n_sums + j) * WIDTH))

    return composite_tiles_vjp


@kernel()
def sum_slots(slots, offsets, totals):
    """Add the slots [M, G + S] of each Gaussian, which lie from ``offsets`` [N + 1] on, up in float64 [N, G + S]."""
    for chunk in prange(N_CHUNKS):
        for n in range(totals.shape[0] * chunk // N_CHUNKS, totals.shape[0] * (chunk + 1) // N_CHUNKS):
            for slot in range(offsets[n], offsets[n + 1]):
                for j in range(slots.shape[1]):
                    totals[n, j] += slots[slot, j]


def composite_hits(
    response: KernelResponse,
    primitives: Any,
    colors: Floats,
    background: Floats,
    bins: TileBins,
    conventions: Conventions,
) -> RenderOutput:
    """Blend the primitives of every tile, front to back; see ``reference.compositing.composite_hits``."""
    height, width, dtype, n_channels = bins.grid.height, bins.grid.width, colors.dtype, len(background)
    image, alpha = np.empty((height, width, n_channels), dtype), np.empty((height, width), dtype)
    forward_kernel(_compiled_for(response), n_channels)(
        Scene(response.records(primitives, dtype), colors, response.boxes(primitives)),
        background,
        _lists(bins, response),
        frame_of(bins, conventions, dtype),
        n_threads(),
        _pixels(image, alpha, dtype),
    )
    return RenderOutput(image, alpha, None, None)


def composite_hits_vjp(
    response: KernelResponse,
    primitives: Any,
    colors: Floats,
    background: Floats,
    bins: TileBins,
    conventions: Conventions,
    output: RenderOutput,
    v_output: tuple[Floats, Floats],
) -> BlendGradient:
    """Chain the gradient of the image to its inputs; see ``reference.compositing.composite_hits_vjp``."""
    dtype, n_channels = colors.dtype, len(background)
    slots = np.empty((len(bins.gaussian_ids), response.n_gradients + n_channels * response.n_coefficients), dtype)
    v_backgrounds = np.zeros((len(bins.tile_offsets) - 1, n_channels))  # by tiles
    backward_kernel(_compiled_for(response), n_channels)(
        Scene(response.records(primitives, dtype), colors, response.boxes(primitives)),
        _lists(bins, response),
        frame_of(bins, conventions, dtype),
        n_threads(),
        _pixels(output.image, output.alpha, dtype),
        _pixels(*v_output, dtype),
        slots,
        v_backgrounds,
    )
    totals = np.zeros((len(colors), slots.shape[1]))
    sum_slots(slots, bins.gaussian_offsets, totals)
    v_records, v_colors = totals[:, : response.n_gradients], totals[:, response.n_gradients :]
    v_background = v_backgrounds.sum(axis=0)
    return BlendGradient(
        response.records_vjp(primitives, v_records), v_colors.astype(dtype), v_background.astype(dtype)
    )


def _lists(bins: TileBins, response: KernelResponse) -> Lists:
    size = bins.grid.tile_width, bins.grid.tile_height
    return Lists(bins.tile_offsets, bins.gaussian_ids, bins.slots, *size, response.buffer_size)


def _compiled_for(response: KernelResponse) -> KernelResponse:
    """The response that stands for those whose buffers are of other sizes: they share a kernel."""
    return response._replace(buffer_size=min(response.buffer_size, LIST_ORDER + 1))


def _pixels(image: Floats, alpha: Floats, dtype: np.dtype) -> Pixels:
    image, alpha = np.ascontiguousarray(image, dtype), np.ascontiguousarray(alpha, dtype)
    return Pixels(image.reshape(alpha.size, image.shape[2]), alpha.reshape(-1, 1))
