"""Sum a Gaussian's contributions over tiles: a thread for each Gaussian adds its slots in order, in float64."""

import numpy as np

from minisplat_ref.cuda.target import cuda, gpu_kernel
from minisplat_ref.jit.lanes import maximum
from minisplat_ref.jit.literals import ZERO
from minisplat_ref.scalar.compositing import conic_vjp_of_moments, factors, mean_vjp_of_moments

N_MOMENTS = 6  # sums of q, q e, q dy, q e^2, q e dy, q dy^2
WEIGHT_SUM, HIT_COUNT, WEIGHT_MAX = range(3)  # of a pair
N_PAIR_SUMS, N_PAIR_STATS = 2, 3


@gpu_kernel
def sum_slots(
    slots,  # [M, 6 + D]
    offsets,  # [N + 1] Gaussian n owns the slots offsets[n]:offsets[n + 1]
    conics,  # [N, 3]
    opacities,  # [N]
    out,  # means2d, conics, opacities and colors of the gradient
):
    """Write the gradient of one Gaussian from the moments in its slots."""
    n = cuda.grid(1)
    v_means2d, v_conics, v_opacities, v_colors = out
    if n >= opacities.shape[0]:
        return
    sums = cuda.local.array(N_MOMENTS, np.float64)
    first, end = offsets[n], offsets[n + 1]
    for k in range(N_MOMENTS):
        sums[k] = ZERO
        for slot in range(first, end):
            sums[k] += slots[slot, k]
    for k in range(v_colors.shape[1]):
        total = np.float64(0)
        for slot in range(first, end):
            total += slots[slot, N_MOMENTS + k]
        v_colors[n, k] = total
    if first == end or opacities[n] == ZERO:  # no pair, or culled
        v_means2d[n, 0] = v_means2d[n, 1] = v_opacities[n] = ZERO
        v_conics[n, 0] = v_conics[n, 1] = v_conics[n, 2] = ZERO
        return
    a, slope, pivot = factors(conics[n, 0], conics[n, 1], conics[n, 2])
    v_means2d[n, 0], v_means2d[n, 1] = mean_vjp_of_moments(a, slope, pivot, sums[1], sums[2])
    v_conics[n, 0], v_conics[n, 1], v_conics[n, 2] = conic_vjp_of_moments(slope, sums[3], sums[4], sums[5])
    v_opacities[n] = -sums[0] / opacities[n]


@gpu_kernel
def sum_pair_stats(slots, offsets, weight_sums, weight_maxima, hit_counts):
    """Write the statistics of one Gaussian from those of its pairs [M, 3]."""
    n = cuda.grid(1)
    if n >= weight_sums.shape[0]:
        return
    total, largest, n_hits = np.float64(0), slots.dtype.type(0), 0
    for slot in range(offsets[n], offsets[n + 1]):
        total += slots[slot, WEIGHT_SUM]
        largest = maximum(largest, slots[slot, WEIGHT_MAX])
        n_hits += int(slots[slot, HIT_COUNT])
    weight_sums[n], weight_maxima[n], hit_counts[n] = total, largest, n_hits
