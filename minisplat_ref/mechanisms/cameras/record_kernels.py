"""The record of a Gaussian that :mod:`.kernels` compares with rays, and its gradient.

With the distance ``r = |x|`` it holds the direction ``n = x / r``, rounded to the dtype of the record, ``G = r M``, and
``h = G n`` of the rounded direction, in float64 until it is stored: the ray passes exactly where its difference from
that direction says.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.cpu.gaussian_rows import (
    DOUBLE,
    contiguous,
    eight_rows,
    gather_wide,
    matrix,
    round_lanes,
    scatter_triple,
    triple,
)
from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.jit.lanes import WIDTH, scatter, select, sqrt
from minisplat_ref.jit.literals import ONE, ZERO
from minisplat_ref.mechanisms.cameras.ray_footprints import LensFootprints
from minisplat_ref.scalar.projection import dot, transpose3
from minisplat_ref.types import Floats

# Columns of a record, and of its gradient.
OPACITY, NORMAL, WHITE, AHEAD, DEPTH, SIZE = 0, 1, 4, 13, 16, 17
V_OPACITY, V_WHITE_MEAN, V_WHITE, N_GRADIENTS = 0, 1, 4, 13


class _Fields(NamedTuple):
    """The fields of :class:`.ray_footprints.LensFootprints` that records hold, float64."""

    positions: Floats  # [N, 3]
    whitenings: Floats  # [N, 3, 3]
    opacities: Floats  # [N]
    depths: Floats  # [N]


class _Gradient(NamedTuple):
    """The gradient with respect to the first three of them, float64."""

    positions: Floats
    whitenings: Floats
    opacities: Floats


def _pack_fields(footprints: LensFootprints) -> _Fields:
    return _Fields(*contiguous(*(np.asarray(getattr(footprints, name), np.float64) for name in _Fields._fields)))


@scalar
def _distance(x):
    """Return r; 1 where culled."""
    r = sqrt(dot(x, x))
    return select(r > ZERO, r, ONE)


@scalar
def _multiply(row, r):
    return row[0] * r, row[1] * r, row[2] * r


@scalar
def _write_eight(rows, fields, records):
    x, M = triple(fields.positions, rows), matrix(fields.whitenings, rows)
    r = _distance(x)
    n = round_lanes(round_lanes((x[0] / r, x[1] / r, x[2] / r), records.dtype.type(0)), DOUBLE)
    G = _multiply(M[0], r), _multiply(M[1], r), _multiply(M[2], r)
    scatter(records, rows, OPACITY, (gather_wide(fields.opacities, rows, 0), *n, *G[0], G[1][0]))
    scatter(records, rows, WIDTH, (G[1][1], G[1][2], *G[2], dot(G[0], n), dot(G[1], n), dot(G[2], n)))
    scatter(records, rows, DEPTH, gather_wide(fields.depths, rows, 0))


@kernel()
def _write_records(
    fields,  # _Fields
    records,  # [N, SIZE]
):
    n_gaussians = records.shape[0]
    for block in prange((n_gaussians + WIDTH - 1) // WIDTH):
        _write_eight(eight_rows(block * WIDTH, n_gaussians), fields, records)


def records_of(footprints: LensFootprints, dtype: np.dtype) -> Floats:
    """Return the records [N, SIZE] of Gaussians."""
    records = np.empty((len(footprints.depths), SIZE), dtype)
    _write_records(_pack_fields(footprints), records)
    return records


@scalar
def _write_eight_vjp(rows, fields, v_records, out):
    """With the sums ``p`` and ``P`` of ``q p`` and ``q p (x - t d)^T / r``: ``v_x = M^T p``, ``v_M = r P``."""
    x, M = triple(fields.positions, rows), transpose3(matrix(fields.whitenings, rows))
    r = _distance(x)
    p = (
        gather_wide(v_records, rows, V_WHITE_MEAN),
        gather_wide(v_records, rows, V_WHITE_MEAN + 1),
        gather_wide(v_records, rows, V_WHITE_MEAN + 2),
    )
    scatter_triple(out.positions, rows, (dot(M[0], p), dot(M[1], p), dot(M[2], p)))
    scatter(out.opacities, rows, 0, gather_wide(v_records, rows, V_OPACITY))
    for k in range(9):
        scatter(out.whitenings, rows, k, gather_wide(v_records, rows, V_WHITE + k) * r)


@kernel()
def _write_records_vjp(
    fields,  # _Fields
    v_records,  # [N, 13]
    out,  # _Gradient
):
    n_gaussians = v_records.shape[0]
    for block in prange((n_gaussians + WIDTH - 1) // WIDTH):
        _write_eight_vjp(eight_rows(block * WIDTH, n_gaussians), fields, v_records, out)


def records_of_vjp(footprints: LensFootprints, v_records: Floats) -> tuple[Floats, ...]:
    """Gradient of :func:`records_of` with respect to positions, whitenings and opacities.

    Parameters
    ----------
    footprints : LensFootprints
        As for the forward function.
    v_records : ndarray of shape (N, 13)
        The sums that the response gives: of the opacity, and of p and P of the hits, float64.
    """
    fields = _pack_fields(footprints)
    out = _Gradient(*(np.empty_like(field) for field in fields[:3]))
    _write_records_vjp(fields, np.asarray(v_records, np.float64), out)
    return tuple(out)
