"""The backward kernel: loop over every tile's Gaussians, front to back once more, and sum each Gaussian's gradient.

The loop runs front to back with the forward pass's arithmetic, so that every threshold test has the same result. A
pixel needs only one number besides its transmittance, the part S of <v, image> that lies behind the current hit: it
starts as the whole, and each hit subtracts its share.

With d = mean - pixel, e = dx + slope dy, sigma = (a e^2 + pivot dy^2) / 2 and q = dL/dsigma, all gradients of a
footprint are moments of q over its pixels:

    dL/dmean = (a sum q e, slope a sum q e + pivot sum q dy)      dL/do = -(sum q) / o
    dL/da = (sum q e^2) / 2      dL/dslope = a sum q e dy      dL/dpivot = (sum q dy^2) / 2

Moments in e rather than dx keep a needle's gradient accurate: in dx they grow with its length squared and cancel later.
The conversion to derivatives with respect to the conic's entries is done in float64.

A pair (tile, Gaussian) has its own slot for its moments, which are summed afterwards: see
:mod:`minisplat_ref.cpu.compositing.pair_sums`. The background lies behind all Gaussians; each tile returns its share of
the background's gradient.
"""

import functools
from collections.abc import Callable

import numpy as np

from minisplat_ref.cpu.compositing.pair_sums import N_MOMENTS, slot_size
from minisplat_ref.cpu.compositing.records import COLOR, N_FUSED
from minisplat_ref.cpu.compositing.tile_rows import (
    ALPHAS,
    SCRATCH_SIZE,
    alpha_writer,
    find_reached_rows,
    mean_offset_y,
    ridge_offsets,
    start_scratch,
)
from minisplat_ref.cpu.compositing.tile_state import (
    CHECK_EVERY,
    N_ROWS,
    Tile,
    corner,
    marked_rows,
    open_rows,
    row_in_image,
    start_tile,
    take_tiles,
)
from minisplat_ref.cpu.gaussian_rows import eight_rows
from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.jit.lanes import WIDTH, broadcast, gather, iota, load, reduce_sum, reduce_sums, select, store
from minisplat_ref.jit.literals import ONE, ZERO
from minisplat_ref.jit.scheduling import make_shared_counter
from minisplat_ref.scalar.compositing import blend, sigma_vjp


@functools.cache
def backward_kernel(exp: Callable, n_channels: int) -> Callable:
    """Compile the backward kernel for an exponential and a number of channels."""
    behind_place = WIDTH  # fields after the transmittance: the part of <v, image> that lies behind the current hit
    channels = 2 * WIDTH  # v
    n_fields = 2 + n_channels
    slot_width = slot_size(n_channels)
    row_size = n_fields * WIDTH
    write_alphas = alpha_writer(exp)

    @scalar
    def start_vjp(state, x0, y0, frame, image, alpha, v_image, v_alpha):
        as_data = state.dtype.type
        for row in range(N_ROWS):
            x, y, n_pixels = row_in_image(row, x0, y0, frame)
            if n_pixels == 0:
                continue  # as start_tile left it
            first = y * frame.width + x
            rows, is_inside = eight_rows(first, first + n_pixels), iota(as_data(0)) < as_data(n_pixels)
            behind = gather(v_alpha, rows, 0) * (gather(alpha, rows, 0) - ONE)  # alpha = 1 - T_final
            place = row * row_size
            for k in range(n_channels):
                v = gather(v_image, rows, k)
                store(state, place + channels + k * WIDTH, select(is_inside, v, ZERO))
                behind = behind + v * gather(image, rows, k)
            store(state, place + behind_place, behind)

    @scalar
    def background_vjp(state, sums):
        """Compute one tile's share of the background's gradient: its pixels' transmittances times v."""
        for k in range(n_channels):
            total = broadcast(state.dtype.type(0))
            for i in range(0, N_ROWS * row_size, row_size):
                total = total + abs(load(state, i)) * load(state, i + channels + k * WIDTH)
            sums[k] = reduce_sum(total)

    @scalar
    def v_channel(s, k, i):
        return load(s, i + channels + k * WIDTH) if k < n_channels else broadcast(s.dtype.type(0))

    @scalar
    def tile_vjp(s, scratch, further, records, tile, frame, slots):
        x0, y0, ids, slots_of = tile
        as_data = s.dtype.type
        zero = broadcast(as_data(0))
        is_open = open_rows(s, n_fields)
        next_rows = find_reached_rows(records, ids, 0, x0, y0)
        for m in range(ids.size):
            place = np.int64(slots_of[m]) * slot_width
            if m % CHECK_EVERY == CHECK_EVERY - 1 and is_open != np.uint64(0):
                is_open = open_rows(s, n_fields)
            if is_open == np.uint64(0):
                slots[place : place + slot_width] = ZERO
                continue
            rows = next_rows & is_open
            next_rows = find_reached_rows(records, ids, m + 1, x0, y0)
            n = ids[m]
            write_alphas(scratch, rows, records, n, x0, y0)
            red, green, blue = records[n, COLOR], records[n, COLOR + 1], records[n, COLOR + 2]
            q_sum = qe = qy = qee = qey = qyy = v_red = v_green = v_blue = zero
            further[:] = ZERO
            for row in marked_rows(rows):
                i = row * row_size
                unclamped = load(scratch, ALPHAS + row * WIDTH)
                e, dy = ridge_offsets(scratch, row), mean_offset_y(scratch, row)
                transmittance = load(s, i)
                after, weight = blend(transmittance, unclamped, frame)
                store(s, i, after)
                v_0, v_1, v_2 = v_channel(s, 0, i), v_channel(s, 1, i), v_channel(s, 2, i)
                v_red = v_red + weight * v_0
                v_green = v_green + weight * v_1
                v_blue = v_blue + weight * v_2
                v_dot_c = v_0 * red + v_1 * green + v_2 * blue
                for k in range(N_FUSED, n_channels):
                    v, at = v_channel(s, k, i), (k - N_FUSED) * WIDTH
                    v_dot_c = v_dot_c + v * records[n, COLOR + k]
                    store(further, at, load(further, at) + weight * v)
                behind = load(s, i + behind_place) - weight * v_dot_c
                store(s, i + behind_place, behind)
                q = sigma_vjp(transmittance, weight, unclamped, behind, v_dot_c, frame)
                q_mean = select(unclamped <= frame.mean_gradient_max, q, ZERO)
                q_shape = select(unclamped <= frame.shape_gradient_max, q, ZERO)
                shape_e, shape_y = q_shape * e, q_shape * dy
                q_sum = q_sum + q_shape
                qe = qe + q_mean * e
                qy = qy + q_mean * dy
                qee = qee + shape_e * e
                qey = qey + shape_e * dy
                qyy = qyy + shape_y * dy
            store(slots, place, reduce_sums((q_sum, qe, qy, qee, qey, qyy, v_red, v_green)))
            slots[place + N_MOMENTS + 2] = reduce_sum(v_blue)
            for k in range(N_FUSED, n_channels):
                slots[place + N_MOMENTS + k] = reduce_sum(load(further, (k - N_FUSED) * WIDTH))

    @kernel()
    def composite_tiles_vjp(
        records,  # [N, 13 + D]
        lists,  # TileLists
        n_threads,
        frame,
        pixels,  # Pixels
        v_pixels,  # Pixels
        slots,  # [M * slot_width]
        v_backgrounds,  # [n_tiles, D]
    ):
        # Unpacked here: bundles that parallel loops read take longer to compile.
        offsets, ids, slots_of = lists
        image, alpha = pixels
        v_image, v_alpha = v_pixels
        taken = make_shared_counter()
        for _ in prange(n_threads):
            state = np.empty(N_ROWS * row_size, image.dtype)
            scratch = np.empty(SCRATCH_SIZE, image.dtype)
            start_scratch(scratch)
            further = np.empty((slot_width - N_MOMENTS - N_FUSED) * WIDTH, image.dtype)  # further channels
            for i in take_tiles(taken, n_threads, offsets):
                x0, y0 = corner(i, frame)
                tile = Tile(x0, y0, ids[offsets[i] : offsets[i + 1]], slots_of[offsets[i] :])
                start_tile(state, x0, y0, frame, n_fields)
                start_vjp(state, x0, y0, frame, image, alpha, v_image, v_alpha)
                tile_vjp(state, scratch, further, records, tile, frame, slots)
                background_vjp(state, v_backgrounds[i])

    return composite_tiles_vjp
