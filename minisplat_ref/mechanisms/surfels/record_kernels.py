"""The record of a surfel that the plain kernels read, and its gradient: the loops over :mod:`.formulas`.

It holds three linear functions of the pixel, the rows U, V and W of ``P = T^-1``, by their slopes and their values at a
pixel r near the centre. They are computed in float64 from T with its rows moved to r, so that differences of large
numbers are not rounded to the dtype of the record.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.cpu.gaussian_rows import contiguous, eight_rows, gather_wide, matrix
from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.jit.lanes import WIDTH, maximum, minimum, rint, scatter, select
from minisplat_ref.jit.literals import ZERO
from minisplat_ref.mechanisms.surfels.formulas import invert, invert_vjp, move_map, move_map_vjp
from minisplat_ref.mechanisms.surfels.projection import Surfels
from minisplat_ref.types import Floats

# Columns of a record; those before REF_X have a derivative.
U, V, W, CENTER_X, CENTER_Y, OPACITY, DEPTH = 0, 3, 6, 9, 10, 11, 12
N_GRADIENTS = DEPTH + 1
REF_X, REF_Y, NEAR, PIVOT, SIZE = range(N_GRADIENTS, N_GRADIENTS + 5)
PLANE_MAX = 1e12  # largest entry of P: discs seen more edge-on than that are their low-pass alone
_PIXEL_MAX = 1e9  # of r: far outside every image


class _Fields(NamedTuple):
    """The fields of :class:`.projection.Surfels` that records hold, or the gradient with respect to them, float64."""

    transforms: Floats  # [N, 3, 3]
    means2d: Floats  # [N, 2]
    opacities: Floats  # [N]
    depths: Floats  # [N]


@scalar
def _pixel_near(means2d, rows):
    """Return r."""
    x, y = rint(gather_wide(means2d, rows, 0)), rint(gather_wide(means2d, rows, 1))
    return minimum(maximum(x, -_PIXEL_MAX), _PIXEL_MAX), minimum(maximum(y, -_PIXEL_MAX), _PIXEL_MAX)


@scalar
def _is_moderate(row):
    return (abs(row[0]) < PLANE_MAX) & (abs(row[1]) < PLANE_MAX) & (abs(row[2]) < PLANE_MAX)


@scalar
def _keep(condition, row):
    return select(condition, row[0], ZERO), select(condition, row[1], ZERO), select(condition, row[2], ZERO)


@scalar
def _planes(fields, rows, x, y):
    """Return P at (x, y); 0 where a disc is seen from its edge, which then is met nowhere."""
    P = invert(move_map(matrix(fields.transforms, rows), x, y))
    is_open = _is_moderate(P[0]) & _is_moderate(P[1]) & _is_moderate(P[2])
    return _keep(is_open, P[0]), _keep(is_open, P[1]), _keep(is_open, P[2])


@scalar
def _write_eight(rows, fields, near, pivot, records):
    x, y = _pixel_near(fields.means2d, rows)
    P = _planes(fields, rows, x, y)
    center_x, center_y = gather_wide(fields.means2d, rows, 0) - x, gather_wide(fields.means2d, rows, 1) - y
    opacity, depth = gather_wide(fields.opacities, rows, 0), gather_wide(fields.depths, rows, 0)
    scatter(records, rows, U, (*P[0], *P[1], P[2][0], P[2][1]))
    scatter(records, rows, U + WIDTH, (P[2][2], center_x, center_y, opacity, depth, x, y, ZERO * x + near))
    scatter(records, rows, PIVOT, ZERO * x + pivot)


@kernel()
def _write_records(
    fields,  # _Fields
    near,
    pivot,
    records,  # [N, SIZE]
):
    n_surfels = records.shape[0]
    for block in prange((n_surfels + WIDTH - 1) // WIDTH):
        _write_eight(eight_rows(block * WIDTH, n_surfels), fields, near, pivot, records)


def records_of(surfels: Surfels, dtype: np.dtype) -> Floats:
    """Return the records [N, SIZE] of surfels."""
    records = np.empty((len(surfels.depths), SIZE), dtype)
    _write_records(_pack_fields(surfels), np.float64(surfels.near_plane), np.float64(surfels.pivot), records)
    return records


def _pack_fields(surfels: Surfels) -> _Fields:
    return _Fields(*contiguous(*(np.asarray(getattr(surfels, name), np.float64) for name in _Fields._fields)))


@scalar
def _write_eight_vjp(rows, fields, v_records, has_hit_depths, out):
    x, y = _pixel_near(fields.means2d, rows)
    v_P = matrix(v_records, rows)
    v_T = move_map_vjp(x, y, invert_vjp(_planes(fields, rows, x, y), v_P))
    v_depth = gather_wide(v_records, rows, DEPTH)
    v_corner, v_center = v_T[2][2], v_depth
    if has_hit_depths:  # then the depth of the centre is the corner of T
        v_corner, v_center = v_corner + v_depth, ZERO * v_depth
    scatter(out.transforms, rows, 0, (*v_T[0], *v_T[1], v_T[2][0], v_T[2][1]))
    scatter(out.transforms, rows, WIDTH, v_corner)
    scatter(out.means2d, rows, 0, gather_wide(v_records, rows, CENTER_X))
    scatter(out.means2d, rows, 1, gather_wide(v_records, rows, CENTER_Y))
    scatter(out.opacities, rows, 0, gather_wide(v_records, rows, OPACITY))
    scatter(out.depths, rows, 0, v_center)


@kernel()
def _write_records_vjp(
    fields,  # _Fields
    v_records,  # [N, 13]
    has_hit_depths,
    out,  # _Fields
):
    n_surfels = v_records.shape[0]
    for block in prange((n_surfels + WIDTH - 1) // WIDTH):
        _write_eight_vjp(eight_rows(block * WIDTH, n_surfels), fields, v_records, has_hit_depths, out)


def records_of_vjp(surfels: Surfels, v_records: Floats) -> tuple[Floats, ...]:
    """Gradient of :func:`records_of` with respect to transforms, means2d, opacities and depths.

    Parameters
    ----------
    surfels : Surfels
        As for the forward function.
    v_records : ndarray of shape (N, 13)
        Derivative with respect to the first columns, float64.
    """
    fields = _pack_fields(surfels)
    out = _Fields(*(np.empty_like(field) for field in fields))
    _write_records_vjp(fields, np.asarray(v_records, np.float64), surfels.rules.has_hit_depths, out)
    return tuple(out)
