"""A field over space and time: radial basis functions with coefficients that are polynomials of time.

::

    f(x, t) = sum_b phi_b(x) sum_p tau_p(t) a_bp,   phi_b(x) = exp(-|x - c_b|^2 / (2 h^2)),   tau_p(t) = t^p, p = 1 .. P

so that f is zero at time 0, and everywhere if all a are. Anything linear in f needs no further formula: the time
derivative has the powers' derivatives instead of tau, and an integral over time has their integrals. All functions take
these numbers as ``tau``.

Here are N places, B basis functions, P powers, and values of D numbers each.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from minisplat_ref.types import Floats

WIDTH = 2.0  # h by the mean distance of a centre to its nearest: below 1.5, affine motions have ripples of 5 %


def powers(time: float, n: int) -> Floats:
    """Return ``tau_p = t^p`` for p = 1 .. n, [n] float64."""
    return np.power(float(time), np.arange(1, n + 1))


def power_rates(time: float, n: int) -> Floats:
    """Return ``dtau_p / dt = p t^(p - 1)`` for p = 1 .. n, [n] float64."""
    p = np.arange(1.0, n + 1)
    rates: Floats = p * np.power(float(time), p - 1)
    return rates


def basis(places: Floats, centers: Floats, width: float) -> Floats:
    """Return ``phi_b(x_n)``.

    Parameters
    ----------
    places : ndarray of shape (N, 3)
        x, world frame.
    centers : ndarray of shape (B, 3)
        c.
    width : float
        h, world units.

    Returns
    -------
    ndarray of shape (N, B)
        In the dtype of the places.
    """
    phi: Floats = np.exp(_squared_distances(places, centers) * places.dtype.type(-0.5 / width**2))
    return phi


def _squared_distances(places: Floats, centers: Floats) -> Floats:
    squared: Floats = sum((places[:, i, None] - centers[None, :, i]) ** 2 for i in range(3))  # type: ignore[assignment]
    return squared  # [N, B]


def field(phi: Floats, coefficients: Floats, tau: Floats) -> Floats:
    """Return ``f_n = sum_b phi_nb sum_p tau_p a_bp``.

    Parameters
    ----------
    phi : ndarray of shape (N, B)
        From :func:`basis`.
    coefficients : ndarray of shape (B, P, D)
        a.
    tau : ndarray of shape (P,)
        :func:`powers`, their derivatives or integrals.

    Returns
    -------
    ndarray of shape (N, D)
    """
    values: Floats = phi @ _evaluate(coefficients, tau)
    return values


class FieldGradient(NamedTuple):
    """Gradient of the loss with respect to everything on which :func:`field` depends but time."""

    places: Floats
    """[N, 3]."""
    centers: Floats
    """[B, 3]."""
    log_width: float
    """With respect to ln h."""
    coefficients: Floats
    """[B, P, D]."""


def field_vjp(
    places: Floats, centers: Floats, width: float, phi: Floats, coefficients: Floats, tau: Floats, v: Floats
) -> FieldGradient:
    """Gradient of :func:`field` over :func:`basis`.

    With ``A_b = sum_p tau_p a_bp`` and ``s_nb = phi_nb (v_n . A_b)``::

        v_a_bp  = tau_p sum_n phi_nb v_n
        v_x_n   = sum_b s_nb (c_b - x_n) / h^2
        v_c_b   = sum_n s_nb (x_n - c_b) / h^2
        v_ln_h  = sum_nb s_nb |x_n - c_b|^2 / h^2

    Parameters
    ----------
    places, centers, width, phi, coefficients, tau
        As for the forward functions.
    v : ndarray of shape (N, D)
        Derivative with respect to the values.
    """
    s = phi * (v @ _evaluate(coefficients, tau).T)  # [N, B]
    scale = places.dtype.type(1 / width**2)
    squared = _squared_distances(places, centers)
    return FieldGradient(
        places=(s @ centers - s.sum(axis=1, keepdims=True) * places) * scale,
        centers=(s.T @ places - s.sum(axis=0)[:, None] * centers) * scale,
        log_width=float(np.vdot(s, squared)) / width**2,
        coefficients=tau.astype(v.dtype)[None, :, None] * (phi.T @ v)[:, None, :],
    )


def field_jacobians(
    places: Floats, centers: Floats, width: float, phi: Floats, coefficients: Floats, tau: Floats
) -> Floats:
    """Return ``df_n / dx_n = sum_b A_b (phi_nb (c_b - x_n) / h^2)^T``, [N, D, 3]; arguments as for the gradient."""
    slopes = phi[..., None] * (centers - places[:, None, :]) / width**2  # [N, B, 3]
    jacobians: Floats = np.einsum("bd,nbj->ndj", _evaluate(coefficients, tau), slopes)
    return jacobians


def _evaluate(coefficients: Floats, tau: Floats) -> Floats:
    """Return the polynomials' values A, [B, D] in the dtype of the coefficients."""
    return np.tensordot(tau.astype(coefficients.dtype), coefficients, axes=(0, 1))


def choose_centers(points: Floats, n: int, rng: np.random.Generator) -> tuple[Floats, float]:
    """Return centres among points, far from each other, and the width.

    The first is drawn at random; each of the others is the point that is farthest from those before. Points more than
    twice as far from the median as half of them are left out: a few distant points would take all centres.

    Parameters
    ----------
    points : ndarray of shape (Q, 3)
        World frame; Q is at least 1.
    n : int
        Number of centres; fewer if there are fewer different points.
    rng : numpy.random.Generator
        Draws the first.

    Returns
    -------
    centers : ndarray of shape (B, 3)
        float64.
    width : float
        h, world units: WIDTH times the mean distance of a centre to its nearest, 1 if there is but one centre.
    """
    points = np.asarray(points, np.float64)
    away = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    points = points[away <= 2 * np.median(away)]
    chosen = [int(rng.integers(len(points)))]
    distances = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < n and distances.max() > 0:
        chosen.append(int(np.argmax(distances)))
        distances = np.minimum(distances, np.linalg.norm(points - points[chosen[-1]], axis=1))
    centers = points[chosen]
    if len(centers) == 1:
        return centers, 1.0
    return centers, WIDTH * float(cKDTree(centers).query(centers, k=2)[0][:, 1].mean())
