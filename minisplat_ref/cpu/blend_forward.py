"""The forward kernel: all tiles, every tile's Gaussians front to back, channel by channel, and the blend statistics.

The number of channels and the exponential are compile-time constants: each combination is its own compiled kernel. The
weight of a hit is a field of the tile's state, from which the channels and, if asked for, the statistics are fed.
"""

import functools
from collections.abc import Callable

import numpy as np

from minisplat_ref.constants import MEDIAN_TRANSMITTANCE
from minisplat_ref.cpu.records import (
    COLOR,
    CONIC_A,
    CONIC_B,
    CONIC_C,
    MEAN_X,
    MEAN_Y,
    N_FUSED,
    OPACITY,
    fused_colors,
    pixel_run,
)
from minisplat_ref.cpu.tile_state import (
    CHANNELS,
    CHECK_EVERY,
    PIXELS,
    WEIGHT,
    T,
    X,
    Y,
    is_finished,
    start_tile,
)
from minisplat_ref.cpu.tiling import TILE_WIDTH
from minisplat_ref.scalar._jit import kernel, prange, scalar
from minisplat_ref.scalar.compositing import blend, mahalanobis
from minisplat_ref.scalar.literals import ONE, ZERO

MEDIAN = np.float32(MEDIAN_TRANSMITTANCE)  # one half: exact in float32


@scalar
def _collect(s, n_pixels, n, depth, best, best_ids, median):
    """Statistics of the hit whose weights stand in the state: its weight sum and hit count, and the pixels' maxima."""
    weight_sum = ZERO
    hit_count = 0
    for i in range(n_pixels):
        weight = s[WEIGHT + i]
        if weight > ZERO:
            weight_sum += weight
            hit_count += 1
            if weight > best[i]:
                best[i] = weight
                best_ids[i] = n
            if abs(s[T + i]) < MEDIAN <= abs(s[T + i]) + weight:  # T after and before the hit
                median[i] = depth
    return weight_sum, hit_count


@functools.cache
def forward_kernel(exp: Callable, n_channels: int) -> Callable:
    """Compile the forward kernel for an exponential and a number of channels."""

    @scalar
    def blend_hit(s, n_pixels, record, frame):
        mx, my, opacity = record[MEAN_X], record[MEAN_Y], record[OPACITY]
        a, b, c = record[CONIC_A], record[CONIC_B], record[CONIC_C]
        color = fused_colors(record, n_channels)
        for i in range(n_pixels):
            sigma = mahalanobis(mx - s[X + i], my - s[Y + i], a, b, c)
            s[T + i], weight = blend(s[T + i], sigma, opacity * exp(-sigma), frame)
            s[WEIGHT + i] = weight
            s[CHANNELS + i] += weight * color[0]
            s[CHANNELS + PIXELS + i] += weight * color[1]
            s[CHANNELS + 2 * PIXELS + i] += weight * color[2]
        for k in range(N_FUSED, n_channels):
            value = record[COLOR + k]
            for i in range(n_pixels):
                s[CHANNELS + k * PIXELS + i] += s[WEIGHT + i] * value

    @scalar
    def store(state, x0, y0, background, frame, image, alpha):
        for i in range(PIXELS):
            x = x0 + i % TILE_WIDTH
            y = y0 + i // TILE_WIDTH
            if x < frame.width and y < frame.height:
                left = abs(state[T + i])
                alpha[y, x] = ONE - left
                for k in range(n_channels):
                    image[y, x, k] = state[CHANNELS + k * PIXELS + i] + left * background[k]

    @scalar
    def store_stats(x0, y0, frame, median, best_ids, median_depth, dominant_ids):
        for i in range(PIXELS):
            x = x0 + i % TILE_WIDTH
            y = y0 + i // TILE_WIDTH
            if x < frame.width and y < frame.height:
                median_depth[y, x] = median[i]
                dominant_ids[y, x] = best_ids[i]

    @scalar
    def blend_tile(state, tile, records, depths, offsets, ids, frame, y0, pixel_stats, pair_stats):
        best, best_ids, median = pixel_stats
        weight_sums, hit_counts = pair_stats
        for m in range(offsets[tile], offsets[tile + 1]):
            if m % CHECK_EVERY == 0 and is_finished(state):
                break
            record = records[ids[m]]
            start, n_pixels = pixel_run(record, y0)
            blend_hit(state[start:], n_pixels, record, frame)
            if weight_sums.size > 0:
                weight_sums[m], hit_counts[m] = _collect(
                    state[start:], n_pixels, ids[m], depths[ids[m]], best[start:], best_ids[start:], median[start:]
                )

    @kernel()
    def composite_tiles(
        records, depths, background, offsets, ids, ranges, n_threads, frame, image, alpha, pair_stats, images
    ):
        median_depth, dominant_ids = images
        for thread in prange(n_threads):
            state = np.zeros(CHANNELS + max(n_channels, N_FUSED) * PIXELS, image.dtype)
            best = np.empty(PIXELS, image.dtype)
            median = np.empty(PIXELS, image.dtype)
            best_ids = np.empty(PIXELS, np.int32)
            for turn in range(thread, ranges.size - 1, n_threads):
                for tile in range(ranges[turn], ranges[turn + 1]):
                    x0, y0 = start_tile(state, tile, frame)
                    state[CHANNELS:] = ZERO
                    best[:] = ZERO
                    median[:] = ZERO
                    best_ids[:] = -1
                    blend_tile(
                        state, tile, records, depths, offsets, ids, frame, y0, (best, best_ids, median), pair_stats
                    )
                    store(state, x0, y0, background, frame, image, alpha)
                    if median_depth.size > 0:
                        store_stats(x0, y0, frame, median, best_ids, median_depth, dominant_ids)

    return composite_tiles
