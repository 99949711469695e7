"""The forward kernel: all tiles, every tile's Gaussians front to back, channel by channel, and the blend statistics.

The number of channels and the exponential are compile-time constants: each combination is its own compiled kernel. The
weight of a hit is a field of the tile's state, from which the channels and, if asked for, the statistics are fed.

What the weights of one Gaussian in one tile add up to goes into the slot of this pair, and each Gaussian then goes
through its slots in order, as in :mod:`minisplat_ref.cpu.blend_backward`.
"""

import functools
from collections.abc import Callable

import numpy as np

from minisplat_ref.constants import MEDIAN_TRANSMITTANCE
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
    BEST,
    BEST_PLACE,
    CHANNELS,
    CHECK_EVERY,
    CROSSING,
    PIXELS,
    WEIGHT,
    T,
    X,
    Y,
    is_finished,
    start_tile,
)
from minisplat_ref.cpu.tiling import TILE_WIDTH
from minisplat_ref.scalar._jit import add_in_any_order, kernel, larger_number, prange, scalar
from minisplat_ref.scalar.compositing import blend, mahalanobis
from minisplat_ref.scalar.literals import ONE, ZERO

MEDIAN = np.float32(MEDIAN_TRANSMITTANCE)  # one half: exact in float32


N_PAIR_STATS = 3  # of a pair: sum of the weights, largest weight, number of hits


@scalar
def _collect(s, n_pixels, place, depth, slot):
    """Statistics of the hit whose weights stand in the state: sum, maximum and count, and the pixels' own records.

    Two loops that vectorise; the second is needed only where something was hit.
    """
    total = largest = ZERO * depth
    n_hits = np.int32(0)
    for i in range(n_pixels):
        weight = s[WEIGHT + i]
        total = add_in_any_order(total, weight)
        largest = larger_number(largest, weight)
        n_hits += np.int32(weight > ZERO)
    slot[0], slot[1], slot[2] = total, largest, n_hits
    if n_hits == 0:
        return
    for i in range(n_pixels):
        weight = s[WEIGHT + i]
        is_best = weight > s[BEST + i]
        s[BEST + i] = weight if is_best else s[BEST + i]
        s[BEST_PLACE + i] = place if is_best else s[BEST_PLACE + i]
        after = abs(s[T + i])
        is_crossing = (after < MEDIAN) & (after + weight >= MEDIAN)
        s[CROSSING + i] = depth if is_crossing else s[CROSSING + i]


@scalar
def _sum_pair_stats(n, slots, offsets, stats):
    """Statistics of one Gaussian from those of its pairs, summed in float64."""
    total = 0.0
    largest = slots.dtype.type(0)
    n_hits = 0
    for slot in range(offsets[n], offsets[n + 1]):
        total += slots[slot, 0]
        largest = max(largest, slots[slot, 1])
        n_hits += int(slots[slot, 2])
    stats.blend_weight_sum[n], stats.blend_weight_max[n], stats.hit_count[n] = total, largest, n_hits


@kernel()
def sum_pair_stats(slots, offsets, stats):
    """Write the weights' sums and maxima and the hit counts of all Gaussians."""
    n_gaussians = offsets.size - 1
    for chunk in prange(N_CHUNKS):
        for n in range(n_gaussians * chunk // N_CHUNKS, n_gaussians * (chunk + 1) // N_CHUNKS):
            _sum_pair_stats(n, slots, offsets, stats)


@functools.cache
def forward_kernel(exp: Callable, n_channels: int) -> Callable:
    """Compile the forward kernel for an exponential and a number of channels."""

    @scalar
    def blend_hit(s, n_pixels, record, frame):
        mx, my, opacity = record[MEAN_X], record[MEAN_Y], record[OPACITY]
        half_a, slope, half_pivot = record[HALF_A], record[SLOPE], record[HALF_PIVOT]
        color = fused_colors(record, n_channels)
        for i in range(n_pixels):
            dy = my - s[Y + i]
            sigma = mahalanobis(mx - s[X + i] + slope * dy, dy, half_a, half_pivot)
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
    def store_stats(state, x0, y0, frame, tile_ids, median_depth, dominant_ids):
        for i in range(PIXELS):
            x = x0 + i % TILE_WIDTH
            y = y0 + i // TILE_WIDTH
            if x < frame.width and y < frame.height:
                place = np.int64(state[BEST_PLACE + i])
                dominant_ids[y, x] = tile_ids[place] if place >= 0 else -1
                median_depth[y, x] = state[CROSSING + i]

    @scalar
    def blend_tile(state, tile, records, depths, offsets, ids, places, frame, y0, slots):
        for m in range(offsets[tile], offsets[tile + 1]):
            if m % CHECK_EVERY == 0 and is_finished(state):
                break
            record = records[ids[m]]
            start, n_pixels = pixel_run(record, y0)
            blend_hit(state[start:], n_pixels, record, frame)
            if slots.size > 0:
                place = depths.dtype.type(m - offsets[tile])  # exact in float32 up to 16 million
                _collect(state[start:], n_pixels, place, depths[ids[m]], slots[places[m]])

    @kernel()
    def composite_tiles(
        records, depths, background, offsets, ids, places, ranges, n_threads, frame, image, alpha, slots, images
    ):
        median_depth, dominant_ids = images
        for thread in prange(n_threads):
            state = np.zeros(CHANNELS + max(n_channels, N_FUSED) * PIXELS, image.dtype)
            for turn in range(thread, ranges.size - 1, n_threads):
                for tile in range(ranges[turn], ranges[turn + 1]):
                    x0, y0 = start_tile(state, tile, frame)
                    state[BEST:] = ZERO
                    state[BEST_PLACE : BEST_PLACE + PIXELS] = -ONE
                    blend_tile(state, tile, records, depths, offsets, ids, places, frame, y0, slots)
                    store(state, x0, y0, background, frame, image, alpha)
                    if median_depth.size > 0:
                        store_stats(state, x0, y0, frame, ids[offsets[tile] :], median_depth, dominant_ids)

    return composite_tiles
