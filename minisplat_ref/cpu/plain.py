"""The plain kernels: blending forward and backward, for any primitive. Read these first, then the tuned ones.

Every splatting method is this loop: a pixel meets the primitives of its tile, nearest first, and takes from each what
the light in front has left. What a primitive is stands in a :class:`KernelResponse`; here is only the loop, eight
pixels of a line at a time. The list of a tile is dealt out to its rows of eight, and each goes through its own::

    a tile               its list [M]           members of row 0      state of a row, eight numbers each
    +-------+-------+    +---+---+---+---+--    +---+---+---+--       forward            backward
    | row 0 | row 1 |    | 7 | 3 | 9 | 4 |      | 0 | 2 | 3 |         +-------------+    +-------------+
    +-------+-------+    +---+---+---+---+--    +---+---+---+--       | T           |    | T           |
    | row 2 | ...   |      places 0, 1, ...       whose boxes hold    +-------------+    +-------------+
    +-------+-------+      nearest first          a pixel of it       | image so    |    | behind      |
    |       |       |                                                 | far [D]     |    +-------------+
                                                                      +-------------+    | v [D]       |
    T: transmittance, negative once the pixel is finished                                +-------------+

    sums [M, G + S, 8] of a tile, backward:    | record's gradient: G | colours' gradient: S | of every listed primitive
    slots [pairs, G + S] of all tiles:         the same with the eight added up; a primitive's slots lie side by side

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
    def draw_row(state, scene, row, frame):
        """Blend the members of a row's list, in its order."""
        T = load(state, 0)
        for m in row.members:
            n = row.ids[m]
            unclamped, _, place = hit_row(hit, scene, n, row)
            T, weight = blend(T, unclamped, frame)
            for k in range(n_channels):
                accumulate(state, (1 + k) * WIDTH, weight * shade(scene.colors, n, k, place))
            if not any_of(T > ZERO):
                break
        store(state, 0, T)

    @scalar
    def take(state, hits, rows, frame):
        """Blend one hit of a buffer in each pixel."""
        T, weight = blend(load(state, 0), gather(hits, rows, ALPHA), frame)
        store(state, 0, T)
        for k in range(n_channels):
            accumulate(state, (1 + k) * WIDTH, weight * gather(hits, rows, CHANNELS + k))

    draw_sorted_row = walk_sorted(hit, shade, n_channels, take)

    @kernel()
    def composite_tiles(scene, background, lists, frame, n_threads, out):
        taken = no_turns()
        for _ in prange(n_threads):
            state = np.empty((1 + n_channels) * WIDTH, out.image.dtype)
            for tile in turns(taken, lists.offsets.size - 1):
                n_listed = lists.offsets[tile + 1] - lists.offsets[tile]
                buffer = hit_buffer(n_listed if is_sorted else 0, n_channels, state.dtype)
                for row in rows_of_tile(tile, scene, lists, frame):
                    state[:] = ZERO
                    store(state, 0, full_transmittance(row, frame, state.dtype.type))
                    if is_sorted:
                        draw_sorted_row(state, buffer, scene, row, lists.buffer_size, frame)
                    else:
                        draw_row(state, scene, row, frame)
                    pixels, T_end = row_pixels(row, frame), abs(field_of(state, 0, row, frame))
                    scatter(out.alpha, pixels, 0, ONE - T_end)
                    for k in range(n_channels):
                        scatter(out.image, pixels, k, field_of(state, 1 + k, row, frame) + T_end * background[k])

    return composite_tiles


@functools.cache
def backward_kernel(response: KernelResponse, n_channels: int) -> Callable:
    """Compile the backward kernel for a response and a number of channels."""
    hit, hit_vjp, shade, shade_vjp = response.hit, response.hit_vjp, response.shade, response.shade_vjp
    n_gradients, n_coefficients, n_places = response.n_gradients, response.n_coefficients, response.n_places
    n_sums, is_sorted = n_gradients + n_channels * n_coefficients, response.buffer_size > LIST_ORDER
    behind_place, v_first = WIDTH, 2 * WIDTH  # of a state, after the transmittance

    @scalar
    def start_row(state, output, v_output, row, frame):
        """Fetch v for eight pixels, and <v, image> with the share of alpha = 1 - T_end."""
        pixels, T = row_pixels(row, frame), full_transmittance(row, frame, state.dtype.type)
        store(state, 0, T)
        behind = gather(v_output.alpha, pixels, 0) * (gather(output.alpha, pixels, 0) - ONE)
        for k in range(n_channels):
            v = gather(v_output.image, pixels, k)
            behind = behind + v * gather(output.image, pixels, k)
            store(state, v_first + k * WIDTH, select(T > ZERO, v, ZERO))
        store(state, behind_place, behind)

    @scalar
    def blend_again(state, unclamped, light, frame):
        """Blend a hit with <v, colour> = ``light`` once more; return dL/dalpha and the weight."""
        T = load(state, 0)
        after, weight = blend(T, unclamped, frame)
        behind = load(state, behind_place) - weight * light
        store(state, 0, after)
        store(state, behind_place, behind)
        return blend_vjp(T, weight, unclamped, behind, light, frame), weight

    @scalar
    def chain(sums, v_place, state, scene, n, place, gradient, frame):
        """Add what eight pixels contribute to the ``sums`` [(G + S) * 8] of primitive n."""
        unclamped, v_alpha, weight = gradient
        v_place[:] = ZERO
        for k in range(n_channels):
            v_channel = weight * load(state, v_first + k * WIDTH)
            v_coefficients, v_place_k = shade_vjp(scene.colors, n, k, place, v_channel)
            accumulate(sums, (n_gradients + k * n_coefficients) * WIDTH, v_coefficients)
            accumulate(v_place, 0, v_place_k)
        v_mean = select(unclamped <= frame.mean_gradient_max, v_alpha, ZERO)
        v_shape = select(unclamped <= frame.shape_gradient_max, v_alpha, ZERO)
        accumulate(sums, 0, hit_vjp(scene.records, n, place, v_mean, v_shape, v_place))

    @scalar
    def chain_row(sums, v_place, state, scene, row, frame):
        """Go through the members of a row's list once more and add to their ``sums``."""
        for m in row.members:
            n = row.ids[m]
            unclamped, _, place = hit_row(hit, scene, n, row)
            light = filled(state.dtype.type(0))
            for k in range(n_channels):
                light = light + load(state, v_first + k * WIDTH) * shade(scene.colors, n, k, place)
            v_alpha, weight = blend_again(state, unclamped, light, frame)
            gradient = unclamped, v_alpha, weight
            chain(sums[m * n_sums * WIDTH :], v_place, state, scene, n, place, gradient, frame)
            if not any_of(load(state, 0) > ZERO):
                break

    @scalar
    def take(state, hits, rows, frame):
        """Blend one hit of a buffer in each pixel once more, and write its gradient down."""
        light = filled(state.dtype.type(0))
        for k in range(n_channels):
            light = light + load(state, v_first + k * WIDTH) * gather(hits, rows, CHANNELS + k)
        v_alpha, weight = blend_again(state, gather(hits, rows, ALPHA), light, frame)
        scatter(hits, rows, V_ALPHA, v_alpha)
        scatter(hits, rows, WEIGHT, weight)

    walk = walk_sorted(hit, shade, n_channels, take)

    @scalar
    def chain_sorted_row(sums, v_place, buffer, state, scene, row, buffer_size, frame):
        """Do the same where pixels sort their hits: in their order for dL/dalpha, then in the list's for the rest."""
        for h in range(walk(state, buffer, scene, row, buffer_size, frame)):
            m, rows = buffer.members[h], hit_rows(h)
            unclamped, _, place = hit_row(hit, scene, row.ids[m], row)
            gradient = unclamped, gather(buffer.hits, rows, V_ALPHA), gather(buffer.hits, rows, WEIGHT)
            chain(sums[m * n_sums * WIDTH :], v_place, state, scene, row.ids[m], place, gradient, frame)

    @kernel()
    def composite_tiles_vjp(scene, lists, frame, n_threads, output, v_output, slots, v_backgrounds):
        taken = no_turns()
        for _ in prange(n_threads):
            state = np.empty((2 + n_channels) * WIDTH, slots.dtype)
            v_place = np.empty(n_places * WIDTH, slots.dtype)
            for tile in turns(taken, lists.offsets.size - 1):
                first, n_listed = lists.offsets[tile], lists.offsets[tile + 1] - lists.offsets[tile]
                sums = np.zeros(n_listed * n_sums * WIDTH, slots.dtype)
                buffer = hit_buffer(n_listed if is_sorted else 0, n_channels, state.dtype)
                for row in rows_of_tile(tile, scene, lists, frame):
                    start_row(state, output, v_output, row, frame)
                    if is_sorted:
                        chain_sorted_row(sums, v_place, buffer, state, scene, row, lists.buffer_size, frame)
                    else:
                        chain_row(sums, v_place, state, scene, row, frame)
                    for k in range(n_channels):
                        v_backgrounds[tile, k] += sum_of(abs(load(state, 0)) * load(state, v_first + k * WIDTH))
                for m in range(n_listed):
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
