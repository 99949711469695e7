"""The plain kernels: blending forward and backward, for any primitive. Read these first, then the tuned ones.

Every splatting method is this loop: for each pixel, loop over the primitives of its tile, nearest first, and add each
one's colour times alpha times the transmittance in front of it. A :class:`KernelResponse` defines the primitive; this
module has only the loop, over eight pixels of a line at a time. A tile's list is distributed to its rows of eight::

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

The backward pass runs over a row's list from the front once more, so that every threshold test has the same result as
in the forward pass. It keeps the part of <v, image> that lies behind the current hit: this starts as the whole, and
each hit subtracts its share. No two threads write to one slot, and slots are summed in order, so that the bytes of a
gradient do not depend on the number of threads.

The functions around these kernels are in :mod:`minisplat_ref.cpu.compositing.hits`. Where pixels sort their hits
(``buffer_size`` above 1), :mod:`minisplat_ref.cpu.compositing.hit_buffer` runs over the list. Left out: the
optimisations of the tuned kernels (``forward``, ``backward``), and blend statistics.
"""

import functools
from collections.abc import Callable

import numpy as np

from minisplat_ref.constants import LIST_ORDER
from minisplat_ref.cpu.compositing.hit_buffer import ALPHA, CHANNELS, V_ALPHA, WEIGHT, hit_buffer, hit_rows, walk_sorted
from minisplat_ref.cpu.compositing.pixel_rows import (
    full_transmittance,
    list_rows,
    load_field,
    row_of_tile,
    row_pixels,
)
from minisplat_ref.cpu.compositing.responses import KernelResponse
from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.jit.lanes import (
    WIDTH,
    accumulate,
    broadcast,
    gather,
    load,
    reduce_any,
    reduce_sum,
    scatter,
    select,
    store,
)
from minisplat_ref.jit.literals import ONE, ZERO
from minisplat_ref.jit.scheduling import dynamic_range, make_shared_counter
from minisplat_ref.scalar.compositing import blend, blend_vjp


@functools.cache
def forward_kernel(response: KernelResponse, n_channels: int) -> Callable:
    """Compile the forward kernel for a response and a number of channels."""
    hit, shade, is_sorted = response.hit, response.shade, response.buffer_size > LIST_ORDER
    hit_row = response.hit_row

    @scalar
    def composite_row(state, primitives, row, frame):
        """Blend the members of a row's list, in its order."""
        T = load(state, 0)
        for m in row.members:
            n = row.ids[m]
            unclamped, _, place = hit_row(hit, primitives, n, row)
            T, weight = blend(T, unclamped, frame)
            for k in range(n_channels):
                accumulate(state, (1 + k) * WIDTH, weight * shade(primitives.colors, n, k, place))
            if not reduce_any(T > ZERO):
                break
        store(state, 0, T)

    @scalar
    def take(state, hits, rows, frame):
        """Blend one hit of a buffer in each pixel."""
        T, weight = blend(load(state, 0), gather(hits, rows, ALPHA), frame)
        store(state, 0, T)
        for k in range(n_channels):
            accumulate(state, (1 + k) * WIDTH, weight * gather(hits, rows, CHANNELS + k))

    composite_sorted_row = walk_sorted(response, n_channels, take)

    @kernel()
    def composite_tiles(primitives, background, lists, frame, n_threads, out):
        taken = make_shared_counter()
        for _ in prange(n_threads):
            state = np.empty((1 + n_channels) * WIDTH, out.image.dtype)
            for tile in dynamic_range(taken, lists.offsets.size - 1):
                n_listed = lists.offsets[tile + 1] - lists.offsets[tile]
                buffer = hit_buffer(n_listed if is_sorted else 0, n_channels, state.dtype)
                members, counts = list_rows(primitives.boxes, tile, lists, frame)
                for i in range(counts.size):
                    row = row_of_tile(i, tile, members, counts, lists, frame)
                    if row.x >= frame.width or row.y >= frame.height:
                        continue
                    state[:] = ZERO
                    store(state, 0, full_transmittance(row, frame, state.dtype.type))
                    if is_sorted:
                        composite_sorted_row(state, buffer, primitives, row, lists.buffer_size, frame)
                    else:
                        composite_row(state, primitives, row, frame)
                    pixels, T_end = row_pixels(row, frame), abs(load_field(state, 0, row, frame))
                    scatter(out.alpha, pixels, 0, ONE - T_end)
                    for k in range(n_channels):
                        scatter(out.image, pixels, k, load_field(state, 1 + k, row, frame) + T_end * background[k])

    return composite_tiles


@functools.cache
def backward_kernel(response: KernelResponse, n_channels: int) -> Callable:
    """Compile the backward kernel for a response and a number of channels."""
    hit, hit_vjp, shade, shade_vjp = response.hit, response.hit_vjp, response.shade, response.shade_vjp
    hit_row = response.hit_row
    n_gradients, n_coefficients, n_places = response.n_gradients, response.n_coefficients, response.n_places
    n_sums, is_sorted = n_gradients + n_channels * n_coefficients, response.buffer_size > LIST_ORDER
    behind_place, v_first = WIDTH, 2 * WIDTH  # of a state, after the transmittance

    @scalar
    def start_row(state, output, v_output, row, frame):
        """Load v for eight pixels, and <v, image> including the term of alpha = 1 - T_end."""
        pixels, T = row_pixels(row, frame), full_transmittance(row, frame, state.dtype.type)
        store(state, 0, T)
        behind = gather(v_output.alpha, pixels, 0) * (gather(output.alpha, pixels, 0) - ONE)
        for k in range(n_channels):
            v = gather(v_output.image, pixels, k)
            behind = behind + v * gather(output.image, pixels, k)
            store(state, v_first + k * WIDTH, select(T > ZERO, v, ZERO))
        store(state, behind_place, behind)

    @scalar
    def blend_again(state, unclamped, v_dot_c, frame):
        """Repeat the blending of a hit with <v, colour> = ``v_dot_c``; return dL/dalpha and the weight."""
        T = load(state, 0)
        after, weight = blend(T, unclamped, frame)
        behind = load(state, behind_place) - weight * v_dot_c
        store(state, 0, after)
        store(state, behind_place, behind)
        return blend_vjp(T, weight, unclamped, behind, v_dot_c, frame), weight

    @scalar
    def chain(sums, v_place, state, primitives, n, place, gradient, frame):
        """Add the contributions of eight pixels to the ``sums`` [(G + S) * 8] of primitive n."""
        unclamped, v_alpha, weight = gradient
        v_place[:] = ZERO
        for k in range(n_channels):
            v_channel = weight * load(state, v_first + k * WIDTH)
            v_coefficients, v_place_k = shade_vjp(primitives.colors, n, k, place, v_channel)
            accumulate(sums, (n_gradients + k * n_coefficients) * WIDTH, v_coefficients)
            accumulate(v_place, 0, v_place_k)
        v_mean = select(unclamped <= frame.mean_gradient_max, v_alpha, ZERO)
        v_shape = select(unclamped <= frame.shape_gradient_max, v_alpha, ZERO)
        accumulate(sums, 0, hit_vjp(primitives.records, n, place, v_mean, v_shape, v_place))

    @scalar
    def chain_row(sums, v_place, state, primitives, row, frame):
        """Loop over the members of a row's list once more and add to their ``sums``."""
        for m in row.members:
            n = row.ids[m]
            unclamped, _, place = hit_row(hit, primitives, n, row)
            v_dot_c = broadcast(state.dtype.type(0))
            for k in range(n_channels):
                v_dot_c = v_dot_c + load(state, v_first + k * WIDTH) * shade(primitives.colors, n, k, place)
            v_alpha, weight = blend_again(state, unclamped, v_dot_c, frame)
            gradient = unclamped, v_alpha, weight
            chain(sums[m * n_sums * WIDTH :], v_place, state, primitives, n, place, gradient, frame)
            if not reduce_any(load(state, 0) > ZERO):
                break

    @scalar
    def take(state, hits, rows, frame):
        """Repeat the blending of one hit of a buffer in each pixel, and store its gradient."""
        v_dot_c = broadcast(state.dtype.type(0))
        for k in range(n_channels):
            v_dot_c = v_dot_c + load(state, v_first + k * WIDTH) * gather(hits, rows, CHANNELS + k)
        v_alpha, weight = blend_again(state, gather(hits, rows, ALPHA), v_dot_c, frame)
        scatter(hits, rows, V_ALPHA, v_alpha)
        scatter(hits, rows, WEIGHT, weight)

    walk = walk_sorted(response, n_channels, take)

    @scalar
    def chain_sorted_row(sums, v_place, buffer, state, primitives, row, buffer_size, frame):
        """Do :func:`chain_row` where pixels sort their hits: dL/dalpha in their order, the rest in the list's order."""
        for h in range(walk(state, buffer, primitives, row, buffer_size, frame)):
            m, rows = buffer.members[h], hit_rows(h)
            unclamped, _, place = hit_row(hit, primitives, row.ids[m], row)
            gradient = unclamped, gather(buffer.hits, rows, V_ALPHA), gather(buffer.hits, rows, WEIGHT)
            chain(sums[m * n_sums * WIDTH :], v_place, state, primitives, row.ids[m], place, gradient, frame)

    @kernel()
    def composite_tiles_vjp(primitives, lists, frame, n_threads, output, v_output, slots, v_backgrounds):
        taken = make_shared_counter()
        for _ in prange(n_threads):
            state = np.empty((2 + n_channels) * WIDTH, slots.dtype)
            v_place = np.empty(n_places * WIDTH, slots.dtype)
            for tile in dynamic_range(taken, lists.offsets.size - 1):
                first, n_listed = lists.offsets[tile], lists.offsets[tile + 1] - lists.offsets[tile]
                sums = np.zeros(n_listed * n_sums * WIDTH, slots.dtype)
                buffer = hit_buffer(n_listed if is_sorted else 0, n_channels, state.dtype)
                members, counts = list_rows(primitives.boxes, tile, lists, frame)
                for i in range(counts.size):
                    row = row_of_tile(i, tile, members, counts, lists, frame)
                    if row.x >= frame.width or row.y >= frame.height:
                        continue
                    start_row(state, output, v_output, row, frame)
                    if is_sorted:
                        chain_sorted_row(sums, v_place, buffer, state, primitives, row, lists.buffer_size, frame)
                    else:
                        chain_row(sums, v_place, state, primitives, row, frame)
                    for k in range(n_channels):
                        v_backgrounds[tile, k] += reduce_sum(abs(load(state, 0)) * load(state, v_first + k * WIDTH))
                for m in range(n_listed):
                    for j in range(n_sums):
                        slots[lists.slots[first + m], j] = reduce_sum(load(sums, (m * n_sums + j) * WIDTH))

    return composite_tiles_vjp
