"""Sum a Gaussian's contributions over tiles: its gradient and its blend statistics.

A pair (tile, Gaussian) has its own slot, which only the thread that blends the tile writes; afterwards the slots
of each Gaussian are summed in order, in float64. No two threads write the same number, and the sums have the same bytes
at any number of threads. This costs 6 + D numbers per pair.
"""

import numpy as np

from minisplat_ref.cpu.compositing.records import N_FUSED
from minisplat_ref.cpu.gaussian_rows import DOUBLE
from minisplat_ref.cpu.projection import N_CHUNKS
from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.jit.lanes import WIDTH, broadcast, cast, load, store
from minisplat_ref.jit.literals import ZERO
from minisplat_ref.scalar.compositing import conic_vjp_of_moments, factors, mean_vjp_of_moments

N_MOMENTS = 6  # sums of q, q e, q dy, q e^2, q e dy, q dy^2
N_PAIR_STATS = 3  # sum of the weights, largest weight, number of hits


def slot_size(n_channels: int) -> int:
    """Return the size of a pair's slot: its moments and the sums of its channels, at least three."""
    return N_MOMENTS + max(n_channels, N_FUSED)


@scalar
def _sum_slots(n, slots, width, first, end, sums, projection, out):
    """Write the gradient of one Gaussian from the moments in its slots, summing the first eight numbers together."""
    total, blue = broadcast(DOUBLE), DOUBLE
    for slot in range(first, end):
        total = total + cast(load(slots, slot * width), DOUBLE)
        blue += slots[slot * width + WIDTH]
    store(sums, 0, total)
    sums[WIDTH] = blue
    a, slope, pivot = factors(projection.conics[n, 0], projection.conics[n, 1], projection.conics[n, 2])
    out.means2d[n, 0], out.means2d[n, 1] = mean_vjp_of_moments(a, slope, pivot, sums[1], sums[2])
    v_a, v_b, v_c = conic_vjp_of_moments(slope, sums[3], sums[4], sums[5])
    out.conics[n, 0], out.conics[n, 1], out.conics[n, 2] = v_a, v_b, v_c
    out.opacities[n] = -sums[0] / projection.opacities[n]
    for k in range(min(out.colors.shape[1], N_FUSED)):
        out.colors[n, k] = sums[N_MOMENTS + k]
    for k in range(N_FUSED, out.colors.shape[1]):
        color = DOUBLE
        for slot in range(first, end):
            color += slots[slot * width + N_MOMENTS + k]
        out.colors[n, k] = color


@scalar
def _write_zeros(n, out):
    """Write the gradient of a Gaussian without pairs."""
    out.means2d[n, 0] = out.means2d[n, 1] = out.opacities[n] = ZERO
    for k in range(3):
        out.conics[n, k] = ZERO
    for k in range(out.colors.shape[1]):
        out.colors[n, k] = ZERO


@kernel()
def sum_slots(
    slots,  # [M * width] flat
    width,  # of a slot
    offsets,  # [N + 1] Gaussian n owns the slots offsets[n]:offsets[n + 1]
    projection,  # Projection
    out,  # CompositeGradient
):
    """Write the gradients of all Gaussians."""
    n_gaussians = offsets.size - 1
    for chunk in prange(N_CHUNKS):
        sums = np.empty(WIDTH + 1, np.float64)
        for n in range(n_gaussians * chunk // N_CHUNKS, n_gaussians * (chunk + 1) // N_CHUNKS):
            if offsets[n] < offsets[n + 1]:
                _sum_slots(n, slots, width, offsets[n], offsets[n + 1], sums, projection, out)
            else:
                _write_zeros(n, out)


@scalar
def _sum_pair_stats(n, slots, offsets, stats):
    """Write the statistics of one Gaussian from those of its pairs."""
    total = 0.0
    largest = slots.dtype.type(0)
    n_hits = 0
    for slot in range(offsets[n], offsets[n + 1]):
        total += slots[slot, 0]
        largest = max(largest, slots[slot, 1])
        n_hits += int(slots[slot, 2])
    stats.blend_weight_sum[n], stats.blend_weight_max[n], stats.hit_count[n] = total, largest, n_hits


@kernel()
def sum_pair_stats(
    slots,  # [M, 3]
    offsets,  # [N + 1]
    stats,  # BlendStats
):
    """Write the weights' sums and maxima and the hit counts of all Gaussians."""
    n_gaussians = offsets.size - 1
    for chunk in prange(N_CHUNKS):
        for n in range(n_gaussians * chunk // N_CHUNKS, n_gaussians * (chunk + 1) // N_CHUNKS):
            _sum_pair_stats(n, slots, offsets, stats)
