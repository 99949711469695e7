"""The backward kernel: loop over every tile's Gaussians, front to back once more, and sum each Gaussian's gradient.

The arithmetic is that of the CPU's kernel, see :mod:`minisplat_ref.cpu.compositing.backward`. A thread keeps its
pixel's transmittance and the part of <v, image> behind the current hit; the gradient of a Gaussian is made of six
moments of q = dL/dsigma and the sums of its colours. Moments are summed over each warp, the warps' sums are added in
order into the slot of the pair (tile, Gaussian), and slots are summed in order afterwards: the same bytes in every run.

The atomic version adds a tile's sums to those of the Gaussian at once, in whatever order the tiles finish. It needs no
slots, which saves memory and a pass over them, but every run rounds differently.
"""

import functools

import numpy as np

from minisplat_ref.cuda.compositing.pair_sums import N_MOMENTS
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
from minisplat_ref.jit.lanes import select
from minisplat_ref.jit.literals import HALF, ONE, ZERO
from minisplat_ref.scalar.compositing import blend, sigma_vjp


@functools.cache
def backward_kernel(dtype: np.dtype, n_channels: int, is_atomic: bool = False) -> GpuKernel:
    """Return the backward kernel for a dtype and a number of channels, deterministic or atomic."""
    n_fields, n_colors, n_sums, real = COLOR + n_channels, max(n_channels, 1), N_MOMENTS + n_channels, dtype.type
    n_exchanged, n_batch = BLOCK if is_simulated else 1, batch_size(n_fields + N_WARPS * n_sums, dtype)

    @gpu_kernel
    def composite_tiles_vjp(
        records,  # [N, 10 + D]
        lists,  # TileLists
        frame,
        pixels,  # Pixels
        v_pixels,  # Pixels
        slots,  # [M, 6 + D] of pairs; if atomic [N, 6 + D] zeros, sums of each Gaussian
        v_backgrounds,  # [n_tiles, D]
    ):
        offsets, ids, slots_of = lists
        image, alpha = pixels
        v_image, v_alpha = v_pixels
        batch = cuda.shared.array((n_batch, n_fields), dtype)
        partial = cuda.shared.array((n_batch, N_WARPS, n_sums), dtype)
        exchange = cuda.shared.array((n_exchanged, n_sums), dtype)
        v = cuda.local.array(n_colors, dtype)
        summed = cuda.local.array(n_sums, dtype)
        thread = cuda.threadIdx.x
        x, y = thread_pixel(frame)
        is_pixel = x < frame.width and y < frame.height
        center_x, center_y = real(x) + HALF, real(y) + HALF
        T, behind = real(-1), real(0)
        for k in range(n_channels):
            v[k] = ZERO
        if is_pixel:
            T, behind = real(1), v_alpha[y, x] * (alpha[y, x] - ONE)
            for k in range(n_channels):
                v[k] = v_image[y, x, k]
                behind += v[k] * image[y, x, k]
        first, end = offsets[cuda.blockIdx.x], offsets[cuda.blockIdx.x + 1]
        read_end = first
        for start in range(first, end, n_batch):
            if cuda.syncthreads_count(np.int32(1) if T > ZERO else np.int32(0)) == 0:
                break
            n_listed = min(n_batch, end - start)
            read_end = start + n_listed
            read_batch(records, ids, start, n_listed, n_fields, batch)
            for j in range(n_listed):
                unclamped, e, dy = hit(batch, j, center_x, center_y)
                before = T
                T, weight = blend(before, unclamped, frame)
                v_dot_c = real(0)
                for k in range(n_channels):
                    v_dot_c += v[k] * batch[j, COLOR + k]
                    summed[N_MOMENTS + k] = weight * v[k]
                behind -= weight * v_dot_c
                q = sigma_vjp(before, weight, unclamped, behind, v_dot_c, frame)
                q_mean = select(unclamped <= frame.mean_gradient_max, q, ZERO)
                q_shape = select(unclamped <= frame.shape_gradient_max, q, ZERO)
                summed[0], summed[1], summed[2] = q_shape, q_mean * e, q_mean * dy
                summed[3], summed[4], summed[5] = q_shape * e * e, q_shape * e * dy, q_shape * dy * dy
                reduce_warps(summed, n_sums, n_sums, weight > ZERO, exchange, partial[j])
            cuda.syncthreads()
            for i in range(thread, n_listed * n_sums, BLOCK):
                j = i // n_sums
                k = i - j * n_sums
                total = partial[j, 0, k]
                for warp in range(1, N_WARPS):
                    total += partial[j, warp, k]
                if is_atomic:
                    cuda.atomic.add(slots, (ids[start + j], k), total)
                else:
                    slots[slots_of[start + j], k] = total
        if not is_atomic:
            clear_slots(slots, slots_of, read_end, end)
        cuda.syncthreads()
        for k in range(n_channels):
            summed[k] = abs(T) * v[k]
        reduce_warps(summed, n_channels, n_channels, True, exchange, partial[0])
        cuda.syncthreads()
        if thread < n_channels:
            total = partial[0, 0, thread]
            for warp in range(1, N_WARPS):
                total += partial[0, warp, thread]
            v_backgrounds[cuda.blockIdx.x, thread] = total

    return composite_tiles_vjp
