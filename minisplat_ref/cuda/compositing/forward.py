"""The forward kernel: blend every tile's Gaussians front to back, and collect statistics.

The number of channels, the dtype and whether statistics are collected are compile-time constants. A thread keeps its
pixel's transmittance, negative once the pixel is finished, and its colour; the block stops when no pixel is open.

The statistics of one Gaussian in one tile go into the slot of this pair: reduced over each warp, then over the warps in
order.
"""

import functools

import numpy as np

from minisplat_ref.constants import MEDIAN_TRANSMITTANCE
from minisplat_ref.cuda.compositing.pair_sums import HIT_COUNT, N_PAIR_STATS, N_PAIR_SUMS, WEIGHT_MAX, WEIGHT_SUM
from minisplat_ref.cuda.compositing.records import COLOR
from minisplat_ref.cuda.compositing.tiles import (
    BLOCK,
    N_WARPS,
    batch_size,
    clear_slots,
    hit,
    read_batch,
    thread_pixel,
)
from minisplat_ref.cuda.target import GpuKernel, cuda, gpu_kernel, is_simulated, reduce_warps
from minisplat_ref.jit.lanes import maximum, select
from minisplat_ref.jit.literals import HALF, ONE, ZERO
from minisplat_ref.scalar.compositing import blend

MEDIAN = np.float32(MEDIAN_TRANSMITTANCE)  # one half: exact in float32


@functools.cache
def forward_kernel(dtype: np.dtype, n_channels: int, has_stats: bool) -> GpuKernel:
    """Return the forward kernel for a dtype, a number of channels, with or without statistics."""
    n_fields, n_colors, real = COLOR + n_channels, max(n_channels, 1), dtype.type
    n_exchanged = BLOCK if has_stats and is_simulated else 1
    n_batch = batch_size(n_fields + (N_WARPS * N_PAIR_STATS if has_stats else 0), dtype)
    n_partial = n_batch if has_stats else 1

    @gpu_kernel
    def composite_tiles(
        records,  # [N, 10 + D]
        depths,  # [N]
        background,  # D numbers
        lists,  # TileLists
        frame,
        pixels,  # Pixels
        stats,  # slots [M, 3] of pairs, median depth [H, W], dominant ids [H, W]
    ):
        offsets, ids, slots_of = lists
        image, alpha = pixels
        slots, median_depth, dominant_ids = stats
        batch = cuda.shared.array((n_batch, n_fields), dtype)
        partial = cuda.shared.array((n_partial, N_WARPS, N_PAIR_STATS), dtype)
        exchange = cuda.shared.array((n_exchanged, N_PAIR_STATS), dtype)
        color = cuda.local.array(n_colors, dtype)
        values = cuda.local.array(N_PAIR_STATS, dtype)
        x, y = thread_pixel(frame)
        is_pixel = x < frame.width and y < frame.height
        center_x, center_y = real(x) + HALF, real(y) + HALF
        T = real(1) if is_pixel else real(-1)
        for k in range(n_channels):
            color[k] = ZERO
        best, crossing, best_id = real(0), real(0), np.int32(-1)
        first, end = offsets[cuda.blockIdx.x], offsets[cuda.blockIdx.x + 1]
        read_end = first
        for start in range(first, end, n_batch):
            if cuda.syncthreads_count(np.int32(1) if T > ZERO else np.int32(0)) == 0:
                break
            n_listed = min(n_batch, end - start)
            read_end = start + n_listed
            read_batch(records, ids, start, n_listed, n_fields, batch)
            for j in range(n_listed):
                unclamped, _, _ = hit(batch, j, center_x, center_y)
                T, weight = blend(T, unclamped, frame)
                for k in range(n_channels):
                    color[k] += weight * batch[j, COLOR + k]
                if has_stats:
                    n = ids[start + j]
                    if weight > best:
                        best, best_id = weight, np.int32(n)
                    after = abs(T)
                    if after < MEDIAN and after + weight >= MEDIAN:
                        crossing = depths[n]
                    values[WEIGHT_SUM], values[HIT_COUNT], values[WEIGHT_MAX] = (
                        weight,
                        select(weight > ZERO, ONE, ZERO),
                        weight,
                    )
                    reduce_warps(values, N_PAIR_SUMS, N_PAIR_STATS, weight > ZERO, exchange, partial[j])
            if has_stats:
                cuda.syncthreads()
                if cuda.threadIdx.x < n_listed:
                    j = cuda.threadIdx.x
                    slot = slots_of[start + j]
                    total, hits, largest = real(0), real(0), real(0)
                    for warp in range(N_WARPS):
                        total += partial[j, warp, WEIGHT_SUM]
                        hits += partial[j, warp, HIT_COUNT]
                        largest = maximum(largest, partial[j, warp, WEIGHT_MAX])
                    slots[slot, WEIGHT_SUM], slots[slot, HIT_COUNT], slots[slot, WEIGHT_MAX] = total, hits, largest
        if has_stats:
            clear_slots(slots, slots_of, read_end, end)
        if is_pixel:
            left = abs(T)
            alpha[y, x] = ONE - left
            for k in range(n_channels):
                image[y, x, k] = color[k] + left * background[k]
            if has_stats:
                dominant_ids[y, x] = best_id
                median_depth[y, x] = crossing

    return composite_tiles
