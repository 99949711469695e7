"""The squared change of the image without each Gaussian; see ``reference.removal``.

A block walks down its tile's list as the backward kernel does. Each thread keeps the light from behind the current hit
by channels; squares are summed over each warp, the warps in order into the slot of the pair, and slots in order.
"""

import functools

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.compositing.tile_state import pack_frame
from minisplat_ref.cuda.arrays import beside, empty, to_device
from minisplat_ref.cuda.compositing.records import COLOR, records_of
from minisplat_ref.cuda.compositing.tiles import (
    BLOCK,
    N_WARPS,
    batch_size,
    clear_slots,
    hit,
    pack_lists,
    read_batch,
    thread_pixel,
)
from minisplat_ref.cuda.target import (
    GpuKernel,
    cuda,
    gpu_kernel,
    is_simulated,
    launch,
    launch_rows,
    reduce_warps,
)
from minisplat_ref.jit.literals import HALF, ZERO
from minisplat_ref.scalar.compositing import blend
from minisplat_ref.scalar.removal import odds, removal_change
from minisplat_ref.types import Floats, Projection, RenderOutput, TileBins


@functools.cache
def removal_kernel(dtype: np.dtype, n_channels: int) -> GpuKernel:
    """Return the kernel for a dtype and a number of channels."""
    n_fields, n_colors, real = COLOR + n_channels, max(n_channels, 1), dtype.type
    n_exchanged, n_batch = BLOCK if is_simulated else 1, batch_size(n_fields + N_WARPS, dtype)

    @gpu_kernel
    def remove_from_tiles(
        records,  # [N, 10 + D]
        lists,  # TileLists
        frame,
        image,  # [H, W, D]
        slots,  # [M, 1]
    ):
        offsets, ids, slots_of = lists
        batch = cuda.shared.array((n_batch, n_fields), dtype)
        partial = cuda.shared.array((n_batch, N_WARPS, 1), dtype)
        exchange = cuda.shared.array((n_exchanged, 1), dtype)
        behind = cuda.local.array(n_colors, dtype)
        change = cuda.local.array(1, dtype)
        x, y = thread_pixel(frame)
        is_pixel = x < frame.width and y < frame.height
        center_x, center_y = real(x) + HALF, real(y) + HALF
        T = real(1) if is_pixel else real(-1)
        for k in range(n_channels):
            behind[k] = image[y, x, k] if is_pixel else real(0)
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
                hit_odds = odds(weight, unclamped, frame)
                total = real(0)
                for k in range(n_channels):
                    light = weight * batch[j, COLOR + k]
                    behind[k] -= light
                    q = removal_change(light, hit_odds, behind[k])
                    total += q * q
                change[0] = total
                reduce_warps(change, 1, 1, weight > ZERO, exchange, partial[j])
            cuda.syncthreads()
            if cuda.threadIdx.x < n_listed:
                total = real(0)
                for warp in range(N_WARPS):
                    total += partial[cuda.threadIdx.x, warp, 0]
                slots[slots_of[start + cuda.threadIdx.x], 0] = total
        clear_slots(slots, slots_of, read_end, end)

    return remove_from_tiles


@gpu_kernel
def sum_changes(slots, offsets, changes):
    """Write the change of one Gaussian, the sum over its slots."""
    n = cuda.grid(1)
    if n < changes.shape[0]:
        total = np.float64(0)
        for slot in range(offsets[n], offsets[n + 1]):
            total += slots[slot, 0]
        changes[n] = total


def removal_changes(
    projection: Projection,
    colors: Floats,
    bins: TileBins,
    conventions: Conventions,
    output: RenderOutput,
) -> Floats:
    """Return the squared change of the image without each Gaussian; see ``reference.removal.removal_changes``."""
    (n, n_channels), dtype = colors.shape, colors.dtype
    slots = empty((len(bins.gaussian_ids), 1), dtype)
    launch(
        removal_kernel(dtype, n_channels),
        len(bins.tile_offsets) - 1,
        BLOCK,
        records_of(projection, colors),
        pack_lists(bins),
        pack_frame(bins.grid, conventions, dtype),
        to_device(output.image),
        slots,
    )
    changes = empty(n, np.float64)
    launch_rows(sum_changes, n, slots, to_device(bins.gaussian_offsets), changes)
    return beside(colors, changes)
