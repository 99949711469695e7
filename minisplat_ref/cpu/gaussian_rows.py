"""Process eight Gaussians together: their rows in the tables, and their numbers as lanes.

The forward pass loops over all Gaussians in order; the backward pass, and colours, over a list of those that the camera
sees. Copies of the last row of a range pad the last eight. Writing the same values to it several times is harmless;
only sums over Gaussians have to exclude the copies.
"""

import numpy as np

from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import WIDTH, broadcast, cast, gather, load, reduce_sum, scatter, select, store
from minisplat_ref.jit.literals import ZERO
from minisplat_ref.scalar.projection import dot
from minisplat_ref.types import Floats

DOUBLE = np.float64(0)  # names the dtype


def contiguous(*tables: Floats) -> tuple[Floats, ...]:
    """Return tables [N, ...] as the kernels are compiled for, C-contiguous; those that are so are not copied.

    For another layout Numba would compile them once more, some ten seconds for a view and its gradient.
    """
    return tuple(np.ascontiguousarray(table) for table in tables)


@scalar
def eight_rows(n, end):
    """Return eight rows from ``n`` on, below ``end``."""
    last = end - 1
    near = n, min(n + 1, last), min(n + 2, last), min(n + 3, last)
    return (*near, min(n + 4, last), min(n + 5, last), min(n + 6, last), min(n + 7, last))


@scalar
def load_rows(rows, i):
    """Return the eight rows of a list from ``i`` on."""
    return rows[i], rows[i + 1], rows[i + 2], rows[i + 3], rows[i + 4], rows[i + 5], rows[i + 6], rows[i + 7]


@scalar
def list_visible(radii, first, end, rows):
    """List the visible Gaussians of a range, padded with the last of them; return their number.

    There is no branch, which would be unpredictable.
    """
    count = 0
    for n in range(first, end):
        rows[count] = n
        count += int(radii[n, 0] > 0)
    return pad_rows(rows, count)


@scalar
def list_visible_degree(radii, degrees, degree, first, end, rows):
    """List those of the visible Gaussians of a range whose colours have a degree; otherwise as ``list_visible``."""
    count = 0
    for n in range(first, end):
        rows[count] = n
        count += int(radii[n, 0] > 0) & int(degrees[n] == degree)
    return pad_rows(rows, count)


@scalar
def pad_rows(rows, count):
    """Pad a list with copies of its last row; return the number without these."""
    for i in range(count, count + WIDTH):
        rows[i] = rows[max(count - 1, 0)]
    return count


@scalar
def gather_wide(table, rows, column):
    """Return a column of eight rows in float64."""
    return cast(gather(table, rows, column), DOUBLE)


@scalar
def triple(table, rows):
    """Return the first three columns of eight rows in float64."""
    return gather_wide(table, rows, 0), gather_wide(table, rows, 1), gather_wide(table, rows, 2)


@scalar
def matrix(table, rows):
    """Return the first nine columns of eight rows in float64, as a matrix."""
    return (
        (gather_wide(table, rows, 0), gather_wide(table, rows, 1), gather_wide(table, rows, 2)),
        (gather_wide(table, rows, 3), gather_wide(table, rows, 4), gather_wide(table, rows, 5)),
        (gather_wide(table, rows, 6), gather_wide(table, rows, 7), gather_wide(table, rows, 8)),
    )


@scalar
def quaternion(quats, rows):
    """Return the quaternions wxyz of eight rows in float64."""
    return (*triple(quats, rows), gather_wide(quats, rows, 3))


@scalar
def zero_if_finite(a):
    """Return 0 for three finite numbers, NaN otherwise."""
    return ZERO * a[0] + ZERO * a[1] + ZERO * a[2]


@scalar
def round_lanes(lanes, zero):
    """Return three lanes in the dtype of a number."""
    return cast(lanes[0], zero), cast(lanes[1], zero), cast(lanes[2], zero)


@scalar
def scatter_visible(is_drawn, table, rows, column, lanes):
    """Write lanes to a column, with zeros where a Gaussian is culled."""
    scatter(table, rows, column, select(is_drawn, lanes, ZERO))


@scalar
def scatter_visible_triple(is_drawn, table, rows, first, lanes):
    """Write three columns from the first on, with zeros where a Gaussian is culled."""
    scatter_visible(is_drawn, table, rows, first, lanes[0])
    scatter_visible(is_drawn, table, rows, first + 1, lanes[1])
    scatter_visible(is_drawn, table, rows, first + 2, lanes[2])


@scalar
def scatter_triple(table, rows, lanes):
    """Write the first three columns of eight rows."""
    scatter(table, rows, 0, lanes[0])
    scatter(table, rows, 1, lanes[1])
    scatter(table, rows, 2, lanes[2])


@scalar
def clear_culled(radii, first, end, out):
    """Write zeros to the culled Gaussians of a range of a ``PrimitiveGradient``."""
    for n in range(first, end):
        if radii[n, 0] == 0:
            out.opacities[n] = ZERO
            for i in range(3):
                out.means[n, i] = ZERO
                out.scales[n, i] = ZERO
            for i in range(4):
                out.quats[n, i] = ZERO


@scalar
def add(sums, k, is_counted, lanes):
    """Add lanes to the ``k``-th eight sums of a buffer."""
    store(sums, k * WIDTH, load(sums, k * WIDTH) + select(is_counted, lanes, ZERO))


@scalar
def add_pose_row(v_pose, first, is_counted, v_p, v_V, mean, M):
    """Add to the gradient with respect to a row of R, and then of t: p = R x + t and V = R M."""
    add(v_pose, first, is_counted, v_p * mean[0] + dot(v_V, M[0]))
    add(v_pose, first + 1, is_counted, v_p * mean[1] + dot(v_V, M[1]))
    add(v_pose, first + 2, is_counted, v_p * mean[2] + dot(v_V, M[2]))
    add(v_pose, first + 3, is_counted, v_p)


@scalar
def sum_parts(parts):
    """Return the sums [K] over all parts [n, K * 8], added in the order of the parts."""
    totals = np.empty(parts.shape[1] // WIDTH, np.float64)
    for k in range(totals.size):
        total = broadcast(DOUBLE)
        for part in range(parts.shape[0]):
            total = total + load(parts[part], k * WIDTH)
        totals[k] = reduce_sum(total)
    return totals
