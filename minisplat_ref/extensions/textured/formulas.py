"""Vectors of lanes: tuples of 3, 5 or 7, the numbers of harmonics of degree 1, 2 and 3."""

from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import WIDTH, load


@scalar
def row_3(table, n, k):
    """Return three numbers of row n from column k on."""
    return table[n, k], table[n, k + 1], table[n, k + 2]


@scalar
def row_5(table, n, k):
    """Return five."""
    return table[n, k], table[n, k + 1], table[n, k + 2], table[n, k + 3], table[n, k + 4]


@scalar
def row_7(table, n, k):
    """Return seven."""
    return row_3(table, n, k) + (table[n, k + 3], table[n, k + 4], table[n, k + 5], table[n, k + 6])  # noqa: RUF005


@scalar
def load_3(array, k):
    """Return three lanes of a 1-d array from the k-th on."""
    return load(array, k * WIDTH), load(array, (k + 1) * WIDTH), load(array, (k + 2) * WIDTH)


@scalar
def load_5(array, k):
    """Return five."""
    return load_3(array, k) + (load(array, (k + 3) * WIDTH), load(array, (k + 4) * WIDTH))  # noqa: RUF005


@scalar
def load_7(array, k):
    """Return seven."""
    return load_5(array, k) + (load(array, (k + 5) * WIDTH), load(array, (k + 6) * WIDTH))  # noqa: RUF005


@scalar
def times_3(s, u):
    """Return ``s u``."""
    return s * u[0], s * u[1], s * u[2]


@scalar
def times_5(s, u):
    """Return ``s u``."""
    return s * u[0], s * u[1], s * u[2], s * u[3], s * u[4]


@scalar
def times_7(s, u):
    """Return ``s u``."""
    return s * u[0], s * u[1], s * u[2], s * u[3], s * u[4], s * u[5], s * u[6]


@scalar
def plus_3(u, v):
    """Return ``u + v``."""
    return u[0] + v[0], u[1] + v[1], u[2] + v[2]


@scalar
def plus_5(u, v):
    """Return ``u + v``."""
    return u[0] + v[0], u[1] + v[1], u[2] + v[2], u[3] + v[3], u[4] + v[4]


@scalar
def plus_7(u, v):
    """Return ``u + v``."""
    return u[0] + v[0], u[1] + v[1], u[2] + v[2], u[3] + v[3], u[4] + v[4], u[5] + v[5], u[6] + v[6]


@scalar
def dot_5(u, v):
    """Return ``u . v``."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2] + u[3] * v[3] + u[4] * v[4]


@scalar
def dot_7(u, v):
    """Return ``u . v``."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2] + u[3] * v[3] + u[4] * v[4] + u[5] * v[5] + u[6] * v[6]
