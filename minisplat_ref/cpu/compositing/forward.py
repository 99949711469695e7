"""The forward kernel: blend every tile's Gaussians front to back, eight pixels at a time, and collect statistics.

The number of channels, the exponential and whether statistics are collected are compile-time constants: each
combination is its own compiled kernel.

The sums of one Gaussian's weights in one tile go into the slot of this pair, see
:mod:`minisplat_ref.cpu.compositing.pair_sums`.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import MEDIAN_TRANSMITTANCE
from minisplat_ref.cpu.compositing.records import COLOR, N_FUSED
from minisplat_ref.cpu.compositing.tile_rows import ALPHAS, SCRATCH_SIZE, alpha_writer, find_reached_rows, start_scratch
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
from minisplat_ref.jit.lanes import (
    WIDTH,
    broadcast,
    gather,
    load,
    maximum,
    reduce_max,
    reduce_sum,
    scatter,
    select,
    store,
)
from minisplat_ref.jit.literals import ONE, ZERO
from minisplat_ref.jit.scheduling import make_shared_counter
from minisplat_ref.scalar.compositing import blend
from minisplat_ref.types import Floats, Ints

MEDIAN = np.float32(MEDIAN_TRANSMITTANCE)  # one half: exact in float32


class HitStats(NamedTuple):
    """Output about the hits; arrays that are not requested are empty."""

    slots: Floats
    """[M, 3] sum of the weights, largest weight and number of hits of each pair, by slots."""
    median_depth: Floats
    """[H, W]."""
    dominant_ids: Ints
    """[H, W]."""


@functools.cache
def forward_kernel(exp: Callable, n_channels: int, has_stats: bool) -> Callable:
    """Compile the forward kernel for an exponential, a number of channels, with or without statistics."""
    channels = WIDTH  # fields after the transmittance: the image so far
    best = channels + n_channels * WIDTH  # largest weight so far
    best_place = best + WIDTH  # index of its Gaussian in the tile's list, counted from 1, 0 for none
    crossing = best_place + WIDTH  # depth of the hit that took the transmittance below one half, or 0
    n_fields = 1 + n_channels + (3 if has_stats else 0)
    row_size = n_fields * WIDTH
    write_alphas = alpha_writer(exp)

    @scalar
    def record_hit(s, i, weight, place, depth):
        is_best = weight > load(s, i + best)
        store(s, i + best, select(is_best, weight, load(s, i + best)))
        store(s, i + best_place, select(is_best, place, load(s, i + best_place)))
        after = abs(load(s, i))
        is_crossing = (after < MEDIAN) & (after + weight >= MEDIAN)
        store(s, i + crossing, select(is_crossing, depth, load(s, i + crossing)))

    @scalar
    def load_pixels(state, place, n_pixels):
        """Load a field of a row; where the image ends within the row, its last pixel is repeated."""
        return load(state, place) if n_pixels == WIDTH else gather(state, eight_rows(place, place + n_pixels), 0)

    @scalar
    def store_tile(state, x0, y0, background, frame, image, alpha):
        for row in range(N_ROWS):
            x, y, n_pixels = row_in_image(row, x0, y0, frame)
            if n_pixels == 0:
                continue
            first, place = y * frame.width + x, row * row_size
            rows = eight_rows(first, first + n_pixels)
            left = abs(load_pixels(state, place, n_pixels))
            scatter(alpha, rows, 0, ONE - left)
            for k in range(n_channels):
                color = load_pixels(state, place + channels + k * WIDTH, n_pixels)
                scatter(image, rows, k, color + left * background[k])

    @scalar
    def store_stats(state, x0, y0, frame, ids, median_depth, dominant_ids):
        for row in range(N_ROWS):
            x, y, n_pixels = row_in_image(row, x0, y0, frame)
            for i in range(n_pixels):
                place = row * row_size + i
                best_hit = np.int64(state[place + best_place])
                dominant_ids[y, x + i] = ids[best_hit - 1] if best_hit > 0 else -1
                median_depth[y, x + i] = state[place + crossing]

    @scalar
    def blend_tile(s, scratch, records, depths, tile, frame, slots):
        x0, y0, ids, slots_of = tile
        as_data = s.dtype.type
        zero = broadcast(as_data(0))
        is_open = open_rows(s, n_fields)
        next_rows = find_reached_rows(records, ids, 0, x0, y0)
        for m in range(ids.size):
            if m % CHECK_EVERY == CHECK_EVERY - 1:
                is_open = open_rows(s, n_fields)
                if is_open == np.uint64(0):
                    break
            rows = next_rows & is_open
            next_rows = find_reached_rows(records, ids, m + 1, x0, y0)
            n = ids[m]
            write_alphas(scratch, rows, records, n, x0, y0)
            fused = records[n, COLOR], records[n, COLOR + 1], records[n, COLOR + 2]
            total = largest = hits = zero
            for row in marked_rows(rows):
                i = row * row_size
                after, weight = blend(load(s, i), load(scratch, ALPHAS + row * WIDTH), frame)
                store(s, i, after)
                for k in range(n_channels):
                    field = i + channels + k * WIDTH
                    store(s, field, load(s, field) + weight * (fused[k] if k < N_FUSED else records[n, COLOR + k]))
                if has_stats:
                    record_hit(s, i, weight, as_data(m + 1), depths[n])  # exact in float32 up to 16 million
                    total = total + weight
                    largest = maximum(largest, weight)
                    hits = hits + select(weight > ZERO, broadcast(as_data(1)), ZERO)
            if has_stats:
                slot = slots_of[m]
                slots[slot, 0], slots[slot, 1], slots[slot, 2] = (
                    reduce_sum(total),
                    reduce_max(largest),
                    reduce_sum(hits),
                )

    @kernel()
    def composite_tiles(
        records,  # [N, 13 + D]
        depths,  # [N]
        background,  # [D]
        lists,  # TileLists
        n_threads,
        frame,
        pixels,  # Pixels
        stats,  # HitStats
    ):
        # Unpacked here: bundles that parallel loops read take a quarter longer to compile.
        offsets, ids, slots_of = lists
        image, alpha = pixels
        slots, median_depth, dominant_ids = stats
        taken = make_shared_counter()
        for _ in prange(n_threads):
            state = np.empty(N_ROWS * row_size, image.dtype)
            scratch = np.empty(SCRATCH_SIZE, image.dtype)
            start_scratch(scratch)
            for i in take_tiles(taken, n_threads, offsets):
                x0, y0 = corner(i, frame)
                tile = Tile(x0, y0, ids[offsets[i] : offsets[i + 1]], slots_of[offsets[i] :])
                start_tile(state, x0, y0, frame, n_fields)
                blend_tile(state, scratch, records, depths, tile, frame, slots)
                store_tile(state, x0, y0, background, frame, image, alpha)
                if has_stats:
                    store_stats(state, x0, y0, frame, tile.ids, median_depth, dominant_ids)

    return composite_tiles
