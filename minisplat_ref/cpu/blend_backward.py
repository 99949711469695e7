"""The backward kernel: every tile's Gaussians front to back once more, and the sum of each Gaussian's shares.

Front to back with the forward's arithmetic, so that every threshold falls the same way. A pixel needs only one number
besides its transmittance, the part S of <v, image> that lies behind the current hit: it starts as the whole and shrinks
hit by hit.

With d = mean - pixel and q = dL/dsigma, all gradients of a footprint are moments of q over its pixels:

    dL/dmean = conic (sum q d)      dL/dconic = (sum q dx^2 / 2, sum q dx dy, sum q dy^2 / 2)      dL/do = -(sum q) / o

A pair (tile, Gaussian) has a slot of its own for its moments, and afterwards each Gaussian adds up its slots in order.
No two threads write the same number, and the sums have the same bytes at any number of threads. Cost: 6 + D numbers a
pair.
"""

import functools
from collections.abc import Callable

import numpy as np

from minisplat_ref.cpu.tile_state import (
    BEHIND,
    CHANNELS,
    CHECK_EVERY,
    PIXELS,
    SHADE,
    TILE_WIDTH,
    WEIGHT,
    T,
    X,
    Y,
    is_finished,
    pixel_run,
    start_tile,
)
from minisplat_ref.scalar._jit import REASSOCIATE, kernel, prange, scalar
from minisplat_ref.scalar.compositing import alpha_vjp, blend, mahalanobis
from minisplat_ref.scalar.literals import HALF, ONE, ZERO

N_MOMENTS = 6  # sums of q, q dx, q dy, q dx^2, q dx dy, q dy^2


@scalar
def _sum_slots(n, slots, offsets, projection, out):
    """Gradient of one Gaussian from the moments in its slots."""
    first, last = offsets[n], offsets[n + 1]
    total = np.zeros(slots.shape[1], slots.dtype)
    for slot in range(first, last):
        for j in range(total.size):
            total[j] += slots[slot, j]
    a, b, c = projection.conics[n, 0], projection.conics[n, 1], projection.conics[n, 2]
    out.means2d[n, 0] = a * total[1] + b * total[2]
    out.means2d[n, 1] = b * total[1] + c * total[2]
    out.conics[n, 0] = HALF * total[3]
    out.conics[n, 1] = total[4]
    out.conics[n, 2] = HALF * total[5]
    out.opacities[n] = -total[0] / projection.opacities[n]
    for k in range(out.colors.shape[1]):
        out.colors[n, k] = total[N_MOMENTS + k]


@kernel()
def sum_slots(slots, offsets, projection, out):
    """Gradients of all Gaussians; those without a pair keep their zeros."""
    for n in prange(offsets.size - 1):
        if offsets[n] < offsets[n + 1]:
            _sum_slots(n, slots, offsets, projection, out)


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
    def hit_vjp(s, n_pixels, n, projection, color, frame, sums):
        mx, my = projection.means2d[n, 0], projection.means2d[n, 1]
        a, b, c = projection.conics[n, 0], projection.conics[n, 1], projection.conics[n, 2]
        opacity = projection.opacities[n]
        for i in range(n_pixels):
            s[SHADE + i] = ZERO
        for k in range(n_channels):
            value = color[k]
            for i in range(n_pixels):
                s[SHADE + i] += s[CHANNELS + k * PIXELS + i] * value
        q_sum = qx = qy = qxx = qxy = qyy = ZERO * a
        for i in range(n_pixels):
            dx = mx - s[X + i]
            dy = my - s[Y + i]
            sigma = mahalanobis(dx, dy, a, b, c)
            unclamped = opacity * exp(-sigma)
            transmittance = s[T + i]
            after, weight = blend(transmittance, sigma, unclamped, frame)
            behind = s[BEHIND + i] - weight * s[SHADE + i]
            q = -unclamped * alpha_vjp(transmittance, weight, unclamped, behind, s[SHADE + i], frame)
            q_mean = q if unclamped <= frame.mean_gradient_max else ZERO * q
            q_shape = q if unclamped <= frame.shape_gradient_max else ZERO * q
            q_sum += q_shape
            qx += q_mean * dx
            qy += q_mean * dy
            qxx += q_shape * dx * dx
            qxy += q_shape * dx * dy
            qyy += q_shape * dy * dy
            s[T + i] = after
            s[BEHIND + i] = behind
            s[WEIGHT + i] = weight
        sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = q_sum, qx, qy, qxx, qxy, qyy
        for k in range(n_channels):
            total = ZERO * a
            for i in range(n_pixels):
                total += s[WEIGHT + i] * s[CHANNELS + k * PIXELS + i]
            sums[N_MOMENTS + k] = total

    @kernel(REASSOCIATE)
    def composite_tiles_vjp(
        projection, colors, offsets, ids, places, tiles, n_threads, frame, image, alpha, v_image, v_alpha, slots
    ):
        for thread in prange(n_threads):
            state = np.zeros(CHANNELS + n_channels * PIXELS, image.dtype)
            for turn in range(thread, tiles.size, n_threads):
                tile = tiles[turn]
                x0, y0 = start_tile(state, tile, frame)
                start(state, x0, y0, frame, image, alpha, v_image, v_alpha)
                finished = False
                for m in range(offsets[tile], offsets[tile + 1]):
                    finished = finished or (m % CHECK_EVERY == 0 and is_finished(state))
                    if finished:
                        slots[places[m]] = ZERO
                        continue
                    n = ids[m]
                    first, n_pixels = pixel_run(projection.boxes, n, y0)
                    hit_vjp(state[first:], n_pixels, n, projection, colors[n], frame, slots[places[m]])

    return composite_tiles_vjp
