"""The difference of two Gaussian densities, when it is a density, and the coefficients of a negated colour.

``f_c = (N(m0, S0) - c N(m1, S1)) / (1 - c)`` integrates to one for every c below one. It is not negative anywhere
exactly if c is at most the minimum of the quotient of the two densities, for which there is a closed form.
"""

import numpy as np

from minisplat_ref.constants import SH_C0
from minisplat_ref.types import Floats

ROUNDING = 1e-12  # eigenvalues of a difference of covariances below this part of the largest count as zero


def density(points: Floats, mean: Floats, covariance: Floats) -> Floats:
    """Return the normal density N(m, S) at points.

    Parameters
    ----------
    points : ndarray of shape (P, n)
        x, in any unit.
    mean : ndarray of shape (n,)
        m.
    covariance : ndarray of shape (n, n)
        S, symmetric and positive definite.

    Returns
    -------
    ndarray of shape (P,)
        Per unit of volume.
    """
    offsets = points - mean  # [P, n]
    squared_radii = np.sum(offsets * np.linalg.solve(covariance, offsets.T).T, axis=1)  # [P]
    return np.exp(-0.5 * squared_radii) / np.sqrt(np.linalg.det(2 * np.pi * covariance))


def difference(
    points: Floats, mean0: Floats, covariance0: Floats, mean1: Floats, covariance1: Floats, c: float
) -> Floats:
    """Return ``f_c = (N(m0, S0) - c N(m1, S1)) / (1 - c)`` at points.

    Parameters
    ----------
    points : ndarray of shape (P, n)
        x, in any unit.
    mean0, mean1 : ndarray of shape (n,)
        Means of the positive and of the negative Gaussian.
    covariance0, covariance1 : ndarray of shape (n, n)
        Their covariances.
    c : float
        In [0, 1).

    Returns
    -------
    ndarray of shape (P,)
        Per unit of volume; negative somewhere if c exceeds :func:`largest_weight`.
    """
    return (density(points, mean0, covariance0) - c * density(points, mean1, covariance1)) / (1 - c)


def largest_weight(mean0: Floats, covariance0: Floats, mean1: Floats, covariance1: Floats) -> float:
    """Return the largest c for which :func:`difference` is a density: ``min_x N(m0, S0) / N(m1, S1)``.

    The logarithm of the quotient is quadratic in x, with the Hessian ``S1^-1 - S0^-1``. It has a minimum if that is
    positive semidefinite, that is, if ``S0 - S1`` is, so that the negative Gaussian is wider in no direction. With
    d = m1 - m0, completing the square gives

        min = sqrt(det S1 / det S0) exp(-d^T (S0 - S1)^-1 d / 2)

    In a direction in which both are equally wide, the quotient is constant where the means agree, and falls to zero
    where they do not.

    Parameters
    ----------
    mean0, mean1 : ndarray of shape (n,)
        Means of the positive and of the negative Gaussian.
    covariance0, covariance1 : ndarray of shape (n, n)
        Their covariances.

    Returns
    -------
    float
        In [0, 1]; 0 if the difference is a density for no c above zero.
    """
    widths, axes = np.linalg.eigh(covariance0 - covariance1)  # [n], [n, n]
    d = axes.T @ (mean1 - mean0)  # [n]
    scale = np.trace(covariance0)
    if widths.min() < -ROUNDING * scale:
        return 0.0
    is_equal = widths <= ROUNDING * scale  # [n]
    if np.any(d[is_equal] ** 2 > ROUNDING * scale):
        return 0.0
    exponent = np.sum(d[~is_equal] ** 2 / widths[~is_equal])
    return float(np.sqrt(np.linalg.det(covariance1) / np.linalg.det(covariance0)) * np.exp(-0.5 * exponent))


def negate(sh_dc: Floats, sh_rest: Floats) -> tuple[Floats, Floats]:
    """Return the coefficients of the colour -c, where ``c(d) = 0.5 + sum_k c_k Y_k(d)``.

    ::

        -c = 0.5 + (-c_0 - 1 / Y_0) Y_0 - sum_{k>0} c_k Y_k

    Parameters
    ----------
    sh_dc : ndarray of shape (N, 3)
        c_0.
    sh_rest : ndarray of shape (N, K-1, 3)
        c_1 and above.
    """
    return -sh_dc - sh_dc.dtype.type(1 / SH_C0), -sh_rest
