"""Rotation of real spherical harmonics: the colour that a Gaussian showed towards d is shown towards Q d afterwards.

A function f(d) = sum_k c_k Y_k(d) rotated by an orthogonal Q is f'(d) = f(Q^T d). Each degree l is closed under
rotations, so there are matrices D_l(Q) with c'_l = D_l c_l, and since the Y are orthonormal,

    D_l[i, j] = integral over the sphere of Y_li(d) Y_lj(Q^T d).

The integrand is a polynomial of degree 2 l <= 6, which the quadrature below integrates exactly (Gauss-Legendre in z
with four nodes, equal steps of the azimuth), so that D_l is exact up to rounding. This replaces the usual recursions
over l and tables of Wigner matrices; the only convention that could be wrong is that of
:func:`~minisplat_ref.reference.spherical_harmonics.sh_basis`, whose functions are integrated.
"""

import math

import numpy as np

from minisplat_ref.constants import SH_DEGREE_MAX
from minisplat_ref.reference.spherical_harmonics import sh_basis
from minisplat_ref.types import Floats, Ints


def _sphere_quadrature() -> tuple[Floats, Floats]:
    """Return directions [P, 3] and weights [P] that integrate polynomials of degree up to 7 on the sphere exactly."""
    z, weights = np.polynomial.legendre.leggauss(SH_DEGREE_MAX + 1)  # exact up to degree 7
    n = 2 * SH_DEGREE_MAX + 2  # steps of the azimuth; exact up to degree n - 1 = 7
    angles = 2 * np.pi * np.arange(n) / n
    r = np.sqrt(1 - z * z)[:, None]
    directions = np.stack([r * np.cos(angles), r * np.sin(angles), np.broadcast_to(z[:, None], (len(z), n))], axis=2)
    return directions.reshape(-1, 3), np.repeat(weights * 2 * np.pi / n, n)


_DIRECTIONS, _WEIGHTS = _sphere_quadrature()


def sh_rotations(Q: Floats, degree: int) -> list[Floats]:
    """Return the matrices that rotate spherical harmonics, one for each degree from 1 on.

    ::

        D_l = sum_p w_p Y_l(d_p) Y_l(Q^T d_p)^T

    Parameters
    ----------
    Q : ndarray of shape (M, 3, 3)
        Orthogonal, to_from: rotations, or reflections with the determinant -1.
    degree : int
        Highest degree, 0 to 3.

    Returns
    -------
    list of ndarray of shape (M, 2 l + 1, 2 l + 1)
        D_1 to D_degree, orthogonal; none for degree 0, which no rotation changes.
    """
    rotated = (_DIRECTIONS @ Q).reshape(-1, 3)  # rows (Q^T d_p)^T, [M P, 3]
    there = sh_basis(_DIRECTIONS, degree) * _WEIGHTS[:, None]  # [P, K]
    before = sh_basis(rotated, degree).reshape(len(Q), len(_DIRECTIONS), -1)  # [M, P, K]
    blocks = [slice(n * n, (n + 1) ** 2) for n in range(1, degree + 1)]
    return [there[:, block].T @ before[:, :, block] for block in blocks]


def rotate_sh(sh_rest: Floats, Q: Floats, rows: Ints) -> Floats:
    """Return coefficients rotated by the matrix of each row: ``c'_l = D_l(Q) c_l`` for every degree and channel.

    Parameters
    ----------
    sh_rest : ndarray of shape (N, K-1, 3)
        Coefficients of degree 1 and above.
    Q : ndarray of shape (M, 3, 3)
        Orthogonal matrices.
    rows : ndarray of shape (N,) of integers
        Index of the matrix that rotates each Gaussian; many Gaussians share one triangle.

    Returns
    -------
    ndarray of shape (N, K-1, 3)
        Float64.
    """
    degree = math.isqrt(sh_rest.shape[1] + 1) - 1
    rotated, start = np.empty(sh_rest.shape), 0
    used, rows = np.unique(rows, return_inverse=True)
    for D in sh_rotations(Q[used], degree):
        part = slice(start, start + D.shape[1])
        rotated[:, part] = D[rows] @ sh_rest[:, part].astype(np.float64)
        start = part.stop
    return rotated
