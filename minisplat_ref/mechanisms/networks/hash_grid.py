"""Multi-resolution hash grid: features at the vertices of grids (Instant NGP, Mueller et al. 2022, section 3).

Level l has N_l cells per side of the unit cube, from the coarsest to the finest in equal ratios (eqs. 2 and 3)::

    N_l = floor(N_min b^l),   b = exp((ln N_max - ln N_min) / (L - 1))

A table of T rows holds the features of its vertices. A vertex (i, j, k) has the row ``i + (N_l + 1) (j + (N_l + 1) k)``
where the table has room for all of them, and else (eq. 4), with products modulo 2^32,

    h(i, j, k) = (i xor 2654435761 j xor 805459861 k) mod T

so several vertices share a row, and training decides which of them matters. The encoding of a point is, level by level,
the trilinear interpolation of the features at the eight vertices around it. Points outside the cube are moved to its
faces.

Of the paper's encoding, the half cell by which later releases shift the levels is left out.
"""

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.types import Bools, Floats, Ints

PRIMES = (1, 2654435761, 805459861)
CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))  # [8, 3]


class Levels(NamedTuple):
    """The shape of a grid."""

    resolutions: tuple[int, ...]
    """N_l, cells per side, of each level."""
    n_rows: int
    """T, of each level's table; a power of two."""
    n_features: int
    """F, per row."""


def make_levels(n_levels: int, coarsest: int, finest: int, *, n_rows: int, n_features: int) -> Levels:
    """Return levels whose resolutions grow in equal ratios, both ends included."""
    ratio = (finest / coarsest) ** (1 / max(1, n_levels - 1))
    # The finest is a rounding error below its whole number, or above it.
    resolutions = tuple(int(np.floor(coarsest * ratio**level + 1e-9)) for level in range(n_levels))
    return Levels(resolutions, n_rows, n_features)


def make_table(levels: Levels, rng: np.random.Generator) -> Floats:
    """Return a table [L, T, F] of small random features, between -1e-4 and 1e-4 as published."""
    return rng.uniform(-1e-4, 1e-4, size=(len(levels.resolutions), levels.n_rows, levels.n_features))


def encode(table: Floats, x: Floats, levels: Levels) -> Floats:
    """Return the encoding [B, L F] of points.

    Parameters
    ----------
    table : ndarray of shape (L, T, F)
        Features.
    x : ndarray of shape (B, 3)
        Points of the unit cube.
    levels : Levels
    """
    features = []
    for level, n_cells in enumerate(levels.resolutions):
        corners, weights, _, _ = _interpolation(x, n_cells, levels.n_rows)
        features.append(np.sum(weights.prod(axis=2)[..., None] * table[level][corners], axis=1))
    return np.concatenate(features, axis=1)


def encode_vjp(table: Floats, x: Floats, levels: Levels, v_features: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`encode` with respect to the table and to the points.

    A corner c has the weight ``w_c = prod_a w_ca``, where w_ca is f_a or 1 - f_a, and f the place inside the cell::

        v_table[row of c] += w_c v           over points and corners, in this order
        v_x_a = N_l sum_c (v . table[row of c]) s_ca prod_{b != a} w_cb,   s_ca = 1 or -1; 0 outside the cube

    At the faces of cells, where the encoding has a kink, the derivative is that of the upper cell.

    Parameters
    ----------
    table, x, levels
        As in :func:`encode`.
    v_features : ndarray of shape (B, L F)
        Derivative with respect to the encoding.
    """
    v_table, v_x = np.zeros_like(table), np.zeros_like(x)
    for level, (n_cells, v) in enumerate(zip(levels.resolutions, _split_levels(v_features, levels), strict=True)):
        corners, weights, signs, is_inside = _interpolation(x, n_cells, levels.n_rows)
        np.add.at(v_table[level], corners, weights.prod(axis=2)[..., None] * v[:, None, :])
        along = np.sum(v[:, None, :] * table[level][corners], axis=2)  # [B, 8]
        for a in range(3):
            others = np.delete(weights, a, axis=2).prod(axis=2)  # [B, 8]
            v_x[:, a] += n_cells * np.sum(along * signs[:, a] * others, axis=1) * is_inside[:, a]
    return v_table, v_x


def vertex_rows(vertices: Ints, n_cells: int, n_rows: int) -> Ints:
    """Return the rows [...] of vertices [..., 3] of a level in its table."""
    n = n_cells + 1
    if n**3 <= n_rows:
        return vertices[..., 0] + n * (vertices[..., 1] + n * vertices[..., 2])
    hashed = vertices.astype(np.uint32) * np.array(PRIMES, np.uint32)  # modulo 2^32
    mixed: NDArray[np.uint32] = hashed[..., 0] ^ hashed[..., 1] ^ hashed[..., 2]
    return (mixed & np.uint32(n_rows - 1)).astype(np.int64)


def _interpolation(x: Floats, n_cells: int, n_rows: int) -> tuple[Ints, Floats, Ints, Bools]:
    """Return the rows [B, 8] of the corners, their weights and the signs of these by axis, and where x is inside.

    Weights are [B, 8, 3], signs [8, 3], and ``x >= 0 and x <= 1`` is [B, 3].
    """
    scaled = np.clip(x, 0, 1) * x.dtype.type(n_cells)
    cells = np.minimum(scaled.astype(np.int64), n_cells - 1)
    f = scaled - cells.astype(x.dtype)  # [B, 3]
    weights = np.where(CORNERS == 1, f[:, None, :], 1 - f[:, None, :])
    rows = vertex_rows(cells[:, None, :] + CORNERS, n_cells, n_rows)
    return rows, weights, 2 * CORNERS - 1, (x >= 0) & (x <= 1)


def _split_levels(v_features: Floats, levels: Levels) -> list[Floats]:
    return np.split(v_features, len(levels.resolutions), axis=1)
