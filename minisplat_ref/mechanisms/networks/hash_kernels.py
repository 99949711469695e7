"""The hash grid of :mod:`.hash_grid` as kernels: the same functions, compiled.

Points are independent in the forward pass and in the gradient with respect to them. In the gradient with respect to the
table, points meet: there each level is one thread's, and adds its points in their order.
"""

from typing import Any

import numpy as np

from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.types import Floats

PRIME_Y, PRIME_Z = np.uint32(2654435761), np.uint32(805459861)


@scalar
def _row_of(i, j, k, n_cells, n_rows):
    """Return the row of a vertex in the table of its level."""
    n = n_cells + 1
    if n * n * n <= n_rows:
        return i + n * (j + n * k)
    mixed = np.uint32(i) ^ np.uint32(np.uint32(j) * PRIME_Y) ^ np.uint32(np.uint32(k) * PRIME_Z)
    return np.int64(mixed & np.uint32(n_rows - 1))


@scalar
def _cell_of(number, n_cells, one):
    """Return the cell of a coordinate along its axis, and the place in it from 0 to 1."""
    scaled = min(max(number, 0 * one), one) * (n_cells * one)
    cell = min(np.int64(scaled), n_cells - 1)
    return cell, scaled - cell * one


@scalar
def _corner(cells, place, corner, one):
    """Return the vertex of a corner, and its weight along each axis."""
    i, j, k = corner >> 2, (corner >> 1) & 1, corner & 1
    wx = place[0] if i == 1 else one - place[0]
    wy = place[1] if j == 1 else one - place[1]
    wz = place[2] if k == 1 else one - place[2]
    return (cells[0] + i, cells[1] + j, cells[2] + k), (wx, wy, wz)


@scalar
def _locate(x, row, n_cells, one):
    """Return the cell of a point, and the place in it."""
    i, fx = _cell_of(x[row, 0], n_cells, one)
    j, fy = _cell_of(x[row, 1], n_cells, one)
    k, fz = _cell_of(x[row, 2], n_cells, one)
    return (i, j, k), (fx, fy, fz)


@kernel()
def _encode_rows(
    table,  # [L, T, F]
    x,  # [B, 3]
    resolutions,  # [L]
    features,  # [B, L, F], zeros
    one,
):
    for row in prange(x.shape[0]):
        for level in range(resolutions.size):
            cells, place = _locate(x, row, resolutions[level], one)
            for corner in range(8):
                vertex, (wx, wy, wz) = _corner(cells, place, corner, one)
                at = _row_of(vertex[0], vertex[1], vertex[2], resolutions[level], table.shape[1])
                for f in range(table.shape[2]):
                    features[row, level, f] += wx * wy * wz * table[level, at, f]


@kernel()
def _table_gradient(
    v_table,  # [L, T, F], zeros
    x,  # [B, 3]
    resolutions,  # [L]
    v,  # [B, L, F]
    one,
):
    for level in prange(resolutions.size):
        for row in range(x.shape[0]):
            cells, place = _locate(x, row, resolutions[level], one)
            for corner in range(8):
                vertex, (wx, wy, wz) = _corner(cells, place, corner, one)
                at = _row_of(vertex[0], vertex[1], vertex[2], resolutions[level], v_table.shape[1])
                for f in range(v_table.shape[2]):
                    v_table[level, at, f] += wx * wy * wz * v[row, level, f]


@scalar
def _add_slopes(v_x, row, along, corner, weights):
    """Add the derivative of a corner's weight, times ``along``, to that of the point."""
    wx, wy, wz = weights
    v_x[row, 0] += along * wy * wz if corner >> 2 == 1 else -along * wy * wz
    v_x[row, 1] += along * wx * wz if (corner >> 1) & 1 == 1 else -along * wx * wz
    v_x[row, 2] += along * wx * wy if corner & 1 == 1 else -along * wx * wy


@kernel()
def _point_gradient(
    table,  # [L, T, F]
    x,  # [B, 3]
    resolutions,  # [L]
    v,  # [B, L, F]
    v_x,  # [B, 3], zeros
    one,
):
    for row in prange(x.shape[0]):
        for level in range(resolutions.size):
            cells, place = _locate(x, row, resolutions[level], one)
            for corner in range(8):
                vertex, weights = _corner(cells, place, corner, one)
                at = _row_of(vertex[0], vertex[1], vertex[2], resolutions[level], table.shape[1])
                along = 0 * one
                for f in range(table.shape[2]):
                    along += v[row, level, f] * table[level, at, f]
                _add_slopes(v_x, row, along * (resolutions[level] * one), corner, weights)
        for a in range(3):
            if not 0 <= x[row, a] <= 1:
                v_x[row, a] = 0


def encode(table: Floats, x: Floats, levels: Any) -> Floats:
    """Return the encoding [B, L F]; see :func:`minisplat_ref.mechanisms.networks.hash_grid.encode`."""
    n_levels, _, n_features = table.shape
    features = np.zeros((len(x), n_levels, n_features), x.dtype)
    _encode_rows(table, x, np.array(levels.resolutions), features, x.dtype.type(1))
    return features.reshape(len(x), n_levels * n_features)


def encode_vjp(table: Floats, x: Floats, levels: Any, v_features: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`encode`; see :func:`minisplat_ref.mechanisms.networks.hash_grid.encode_vjp`."""
    n_levels, _, n_features = table.shape
    v, one = np.ascontiguousarray(v_features).reshape(len(x), n_levels, n_features), x.dtype.type(1)
    resolutions = np.array(levels.resolutions)
    v_table, v_x = np.zeros_like(table), np.zeros_like(x)
    _table_gradient(v_table, x, resolutions, v, one)
    _point_gradient(table, x, resolutions, v, v_x, one)
    return v_table, v_x
