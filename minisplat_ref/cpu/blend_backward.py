"""The backward kernel: every tile's Gaussians front to back once more, and the sum of each Gaussian's shares.

Front to back with the forward's arithmetic, so that every threshold falls the same way. A pixel needs only one number
besides its transmittance, the part S of <v, image> that lies behind the current hit: it starts as the whole and shrinks
hit by hit.

With d = mean - pixel, e = dx + slope dy, sigma = (a e^2 + pivot dy^2) / 2 and q = dL/dsigma, all gradients of a
footprint are moments of q over its pixels:

    dL/dmean = (a sum q e, slope a sum q e + pivot sum q dy)      dL/do = -(sum q) / o
    dL/da = (sum q e^2) / 2      dL/dslope = a sum q e dy      dL/dpivot = (sum q dy^2) / 2

The moments over e rather than over dx keep a needle's gradient: over dx they grow with its length squared and cancel
later. They are changed to those by the conic's entries in float64.

A pair (tile, Gaussian) has a slot of its own for its moments, and afterwards each Gaussian adds up its slots in order.
No two threads write the same number, and the sums have the same bytes at any number of threads. Cost: 6 + D numbers a
pair.
"""

import functools
from collections.abc import Callable

import numpy as np

from minisplat_ref.cpu.projection import N_CHUNKS
from minisplat_ref.cpu.records import (
    COLOR,
    HALF_A,
    HALF_PIVOT,
    MEAN_X,
    MEAN_Y,
    N_FUSED,
    OPACITY,
    SLOPE,
    fused_colors,
    pixel_run,
)
from minisplat_ref.cpu.tile_state import (
    BEHIND,
    CHANNELS,
    CHECK_EVERY,
    PIXELS,
    SHADE,
    WEIGHT,
    T,
    X,
    Y,
    is_finished,
    start_tile,
)
from minisplat_ref.cpu.tiling import TILE_WIDTH
from minisplat_ref.scalar._jit import add_in_any_order, kernel, prange, scalar
from minisplat_ref.scalar.compositing import alpha_vjp, blend, conic_vjp_of_moments, factors, mahalanobis
from minisplat_ref.scalar.literals import ONE, ZERO

N_MOMENTS = 6  # sums of q, q e, q dy, q e^2, q e dy, q dy^2


@scalar
def _sum_slots(n, slots, offsets, projection, total, out):
    """Gradient of one Gaussian from the moments in its slots; ``total`` is scratch in float64."""
    total[:] = ZERO
    for slot in range(offsets[n], offsets[n + 1]):
        for j in range(total.size):
            total[j] += slots[slot, j]
    a, slope, pivot = factors(projection.conics[n, 0], projection.conics[n, 1], projection.conics[n, 2])
    out.means2d[n, 0] = a * total[1]
    out.means2d[n, 1] = slope * a * total[1] + pivot * total[2]
    v_a, v_b, v_c = conic_vjp_of_moments(slope, total[3], total[4], total[5])
    out.conics[n, 0], out.conics[n, 1], out.conics[n, 2] = v_a, v_b, v_c
    out.opacities[n] = -total[0] / projection.opacities[n]
    for k in range(out.colors.shape[1]):
        out.colors[n, k] = total[N_MOMENTS + k]


@kernel()
def sum_slots(slots, offsets, projection, out):
    """Gradients of all Gaussians; those without a pair keep their zeros."""
    n_gaussians = offsets.size - 1
    for chunk in prange(N_CHUNKS):
        total = np.empty(slots.shape[1], np.float64)
        for n in range(n_gaussians * chunk // N_CHUNKS, n_gaussians * (chunk + 1) // N_CHUNKS):
            if offsets[n] < offsets[n + 1]:
                _sum_slots(n, slots, offsets, projection, total, out)


@functools.cache
def backward_kernel(exp: Callable, n_channels: int) -> Callable:
    """Compile the backward kernel for an exponential and a number of channels."""

    @scalar
    def start(state, x0, y0, frame, image, alpha, v_image, v_alpha):
        for i in range(PIXELS):
            x = min(x0 + i % TILE_WIDTH, frame.width - 1)
            y = min(y0 + i // TILE_WIDTH, frame.height - 1)
            behind = -v_alpha[y, x] * (ONE - alpha[y, x])  # alpha = 1 - T_final
            for k in range(n_channels):
                state[CHANNELS + k * PIXELS + i] = v_image[y, x, k]
                behind += v_image[y, x, k] * image[y, x, k]
            state[BEHIND + i] = behind

    @scalar
    def hit_vjp(s, n_pixels, record, frame, sums):
        mx, my, opacity = record[MEAN_X], record[MEAN_Y], record[OPACITY]
        half_a, slope, half_pivot = record[HALF_A], record[SLOPE], record[HALF_PIVOT]
        color = fused_colors(record, n_channels)
        if n_channels > N_FUSED:
            s[SHADE : SHADE + n_pixels] = ZERO
        for k in range(N_FUSED, n_channels):
            value = record[COLOR + k]
            for i in range(n_pixels):
                s[SHADE + i] += s[CHANNELS + k * PIXELS + i] * value
        q_sum = qe = qy = qee = qey = qyy = v_red = v_green = v_blue = ZERO * half_a
        for i in range(n_pixels):
            dy = my - s[Y + i]
            e = mx - s[X + i] + slope * dy
            sigma = mahalanobis(e, dy, half_a, half_pivot)
            unclamped = opacity * exp(-sigma)
            transmittance = s[T + i]
            s[T + i], weight = blend(transmittance, sigma, unclamped, frame)
            if n_channels > N_FUSED:
                s[WEIGHT + i] = weight
            v_0, v_1, v_2 = s[CHANNELS + i], s[CHANNELS + PIXELS + i], s[CHANNELS + 2 * PIXELS + i]
            shade = v_0 * color[0] + v_1 * color[1] + v_2 * color[2]
            if n_channels > N_FUSED:
                shade += s[SHADE + i]
            behind = s[BEHIND + i] - weight * shade
            s[BEHIND + i] = behind
            q = -unclamped * alpha_vjp(transmittance, weight, unclamped, behind, shade, frame)
            q_mean = q if unclamped <= frame.mean_gradient_max else ZERO
            q_shape = q if unclamped <= frame.shape_gradient_max else ZERO
            q_sum = add_in_any_order(q_sum, q_shape)
            qe = add_in_any_order(qe, q_mean * e)
            qy = add_in_any_order(qy, q_mean * dy)
            qee = add_in_any_order(qee, q_shape * e * e)
            qey = add_in_any_order(qey, q_shape * e * dy)
            qyy = add_in_any_order(qyy, q_shape * dy * dy)
            v_red = add_in_any_order(v_red, weight * v_0)
            v_green = add_in_any_order(v_green, weight * v_1)
            v_blue = add_in_any_order(v_blue, weight * v_2)
        sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = q_sum, qe, qy, qee, qey, qyy
        fused = (v_red, v_green, v_blue)
        for k in range(min(n_channels, N_FUSED)):
            sums[N_MOMENTS + k] = fused[k]
        for k in range(N_FUSED, n_channels):
            total = ZERO * half_a
            for i in range(n_pixels):
                total = add_in_any_order(total, s[WEIGHT + i] * s[CHANNELS + k * PIXELS + i])
            sums[N_MOMENTS + k] = total

    @scalar
    def tile_vjp(state, tile, records, offsets, ids, places, frame, y0, slots):
        is_over = False
        for m in range(offsets[tile], offsets[tile + 1]):
            is_over = is_over or (m % CHECK_EVERY == 0 and is_finished(state))
            if is_over:
                slots[places[m]] = ZERO
                continue
            record = records[ids[m]]
            first, n_pixels = pixel_run(record, y0)
            hit_vjp(state[first:], n_pixels, record, frame, slots[places[m]])

    @kernel()
    def composite_tiles_vjp(
        records, offsets, ids, places, ranges, n_threads, frame, image, alpha, v_image, v_alpha, slots
    ):
        for thread in prange(n_threads):
            state = np.zeros(CHANNELS + max(n_channels, N_FUSED) * PIXELS, image.dtype)
            for turn in range(thread, ranges.size - 1, n_threads):
                for tile in range(ranges[turn], ranges[turn + 1]):
                    x0, y0 = start_tile(state, tile, frame)
                    start(state, x0, y0, frame, image, alpha, v_image, v_alpha)
                    tile_vjp(state, tile, records, offsets, ids, places, frame, y0, slots)

    return composite_tiles_vjp
