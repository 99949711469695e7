"""Sum a Gaussian's contributions over tiles: a thread for each Gaussian adds its slots in order, in float64."""

import numpy as np

from minisplat_ref.cuda.target import cuda, device_function, gpu_kernel
from minisplat_ref.jit.lanes import maximum
from minisplat_ref.jit.literals import ZERO
from minisplat_ref.scalar.compositing import conic_vjp_of_moments, factors, mean_vjp_of_moments

N_MOMENTS = 6  # sums of q, q e, q dy, q e^2, q e dy, q dy^2
WEIGHT_SUM, HIT_COUNT, WEIGHT_MAX = range(3)  # of a pair
N_PAIR_SUMS, N_PAIR_STATS = 2, 3


@device_function
def slots_of_row(offsets, n, slots):
    """Return the first slot of a Gaussian and the one past its last; none where all pairs together have no room."""
    if offsets[offsets.shape[0] - 1] > slots.shape[0]:
        return np.int64(0), np.int64(0)
    return offsets[n], offsets[n + 1]


@device_function
def sum_column(slots, k, first, end):
    """Return the sum of one column of some slots, in float64."""
    total = np.float64(0)
    for slot in range(first, end):
        total += slots[slot, k]
    return total


@device_function
def footprint_vjp(slots, first, end, conic, opacity):
    """Return the gradient with respect to centre, conic and opacity of one footprint from the moments in its slots.

    Parameters
    ----------
    slots : array of shape (M, 6 + D)
    first, end : int
        The Gaussian's slots.
    conic : tuple of float64
    opacity : float
        Of the footprint.
    """
    if first == end or opacity == ZERO:  # no pair, or culled
        zero = np.float64(0)
        return (zero, zero), (zero, zero, zero), zero
    a, slope, pivot = factors(conic[0], conic[1], conic[2])
    by_dx, by_dy = sum_column(slots, 1, first, end), sum_column(slots, 2, first, end)
    v_center = mean_vjp_of_moments(a, slope, pivot, by_dx, by_dy)
    ee, ey = sum_column(slots, 3, first, end), sum_column(slots, 4, first, end)
    v_conic = conic_vjp_of_moments(slope, ee, ey, sum_column(slots, 5, first, end))
    return v_center, v_conic, -sum_column(slots, 0, first, end) / opacity


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
    first, end = offsets[n], offsets[n + 1]
    for k in range(v_colors.shape[1]):
        v_colors[n, k] = sum_column(slots, N_MOMENTS + k, first, end)
    conic = conics[n, 0], conics[n, 1], conics[n, 2]
    v_center, v_conic, v_opacity = footprint_vjp(slots, first, end, conic, opacities[n])
    v_means2d[n, 0], v_means2d[n, 1] = v_center
    v_conics[n, 0], v_conics[n, 1], v_conics[n, 2] = v_conic
    v_opacities[n] = v_opacity


@gpu_kernel
def sum_pair_stats(slots, offsets, weight_sums, weight_maxima, hit_counts):
    """Write the statistics of one Gaussian from those of its pairs [M, 3]."""
    n = cuda.grid(1)
    if n >= weight_sums.shape[0]:
        return
    total, largest, n_hits = np.float64(0), slots.dtype.type(0), 0
    first, end = slots_of_row(offsets, n, slots)
    for slot in range(first, end):
        total += slots[slot, WEIGHT_SUM]
        largest = maximum(largest, slots[slot, WEIGHT_MAX])
        n_hits += int(slots[slot, HIT_COUNT])
    weight_sums[n], weight_maxima[n], hit_counts[n] = total, largest, n_hits
