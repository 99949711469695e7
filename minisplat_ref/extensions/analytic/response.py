"""The integral of a projected Gaussian over a pixel, and its gradient, in NumPy (Analytic-Splatting, 2403.11056).

The axes e_k of a footprint diagonalise its conic, ``Q = sum_k r_k^2 e_k e_k^T``, where ``r_k = 1 / l_k`` and l_k is the
standard deviation along e_k. If the pixel's square (side 1) is rotated into these axes, the integral is a product::

    u_k   = e_k . d,   d = p - pixel centre
    I_k   = F((u_k + 1/2) r_k) - F((u_k - 1/2) r_k)
    alpha = o (2 pi / (r_1 r_2)) I_1 I_2

F is the distribution function of the normal distribution. Where the axes are the image's, this is the exact mean of
``o exp(-d^T Q d / 2)`` over the pixel. Elsewhere the true square is not rotated, and the product is an approximation.

A round footprint has no axes. There the angle counts as fixed, which is one derivative of the formula but not the only
one: with l_1 = l_2 the formula itself depends slightly on the choice of the axes.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.special import expit, ndtr

from minisplat_ref.reference.hits import Hit, Response, conic_boxes
from minisplat_ref.types import Floats, Ints, Projection

Curve = Callable[[Floats], Floats]

# F(x) ~ 1 / (1 + exp(-(1.6 x + 0.07 x^3))) as in Analytic-Splatting; rounded, so that both precisions hold them
# exactly.
LINEAR, CUBIC = float(np.float32(1.6)), float(np.float32(0.07))
# 1/px. A longer footprint counts as 10,000 px long, or float32 would round its integrals to zero; a thinner one counts
# as thin as 1e-6 px, which stops no light.
RATE_MIN, RATE_MAX = 1e-4, 1e6


class Distribution(NamedTuple):
    """A distribution function and its derivative."""

    cdf: Curve
    """F(x)."""
    pdf: Curve
    """F'(x)."""


def normal_pdf(x: Floats) -> Floats:
    """Return ``exp(-x^2 / 2) / sqrt(2 pi)``."""
    return np.exp(-x * x / 2) / x.dtype.type(np.sqrt(2 * np.pi))


def logistic_cdf(x: Floats) -> Floats:
    """Return ``1 / (1 + exp(-y))`` with ``y = 1.6 x + 0.07 x^3``: within 4e-4 of the normal distribution's."""
    cdf: Floats = expit(x * (LINEAR + CUBIC * x * x))
    return cdf


def logistic_pdf(x: Floats) -> Floats:
    """Derivative of :func:`logistic_cdf`: ``F (1 - F) (1.6 + 0.21 x^2)``."""
    cdf = logistic_cdf(x)
    return cdf * logistic_cdf(-x) * (LINEAR + 3 * CUBIC * x * x)


NORMAL = Distribution(ndtr, normal_pdf)
LOGISTIC = Distribution(logistic_cdf, logistic_pdf)


class Axes(NamedTuple):
    """The principal axes of footprints."""

    rates: Floats
    """[N, 2] r_1 >= r_2, 1/px."""
    angles: Floats
    """[N] radians: e_1 = (cos, sin) and e_2 = (-sin, cos) of this angle."""


def axes_of(conics: Floats) -> Axes:
    """Return the principal axes of ``conics`` (a, b, c) [N, 3], 1/px^2.

    ::

        m = (a + c) / 2,  x = (a - c) / 2,  h = sqrt(x^2 + b^2)
        r_1^2 = m + h,    r_2^2 = (a c - b^2) / (m + h),    angle = atan2(b, x) / 2
    """
    a, b, c = conics.T
    x = (a - c) / 2
    larger = (a + c) / 2 + np.hypot(x, b)
    smaller = (a * c - b * b) / np.where(larger > 0, larger, 1)  # conics of culled Gaussians are 0
    squares = np.clip(np.column_stack([larger, smaller]), RATE_MIN**2, RATE_MAX**2)
    return Axes(np.sqrt(squares), np.arctan2(b, x) / 2)


def axes_of_vjp(conics: Floats, axes: Axes, v_axes: Axes) -> Floats:
    """Gradient of :func:`axes_of`.

    With ``mu_k = r_k^2`` and ``d mu_k = e_k^T dQ e_k``; 0 for a rate at its bound, and for the angle of a round
    footprint::

        v_mu_k  = v_r_k / (2 r_k)
        d angle = (x db - b dx) / (2 h^2)

    Parameters
    ----------
    conics : ndarray of shape (N, 3)
    axes : Axes
        The result of :func:`axes_of`.
    v_axes : Axes
        Derivatives with respect to its fields.

    Returns
    -------
    ndarray of shape (N, 3)
        Derivative with respect to a, b and c, where b occurs twice in Q.
    """
    a, b, c = conics.T
    cos, sin = np.cos(axes.angles), np.sin(axes.angles)
    is_free = (axes.rates > RATE_MIN) & (axes.rates < RATE_MAX)  # [N, 2]
    v_mu_1, v_mu_2 = np.where(is_free, v_axes.rates / (2 * axes.rates), 0).T
    x = (a - c) / 2
    squared = x * x + b * b
    v_turn = np.where(squared > 0, v_axes.angles / np.where(squared > 0, 2 * squared, 1), 0)
    return np.column_stack(
        [
            v_mu_1 * cos * cos + v_mu_2 * sin * sin - v_turn * b / 2,
            2 * (v_mu_1 - v_mu_2) * sin * cos + v_turn * x,
            v_mu_1 * sin * sin + v_mu_2 * cos * cos + v_turn * b / 2,
        ]
    )


def integrals(u: Floats, rates: Floats, distribution: Distribution) -> Floats:
    """Return ``I = F((u + 1/2) r) - F((u - 1/2) r)``, computed in the tail where both values are small.

    Parameters
    ----------
    u : ndarray of shape (...)
        Offsets, px; I is even in u.
    rates : ndarray
        r, 1/px, broadcast against ``u``.
    distribution : Distribution
        F and its derivative.
    """
    u = np.abs(u)
    return distribution.cdf((0.5 - u) * rates) - distribution.cdf(-(0.5 + u) * rates)


def integrals_vjp(u: Floats, rates: Floats, distribution: Distribution, v: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`integrals` with respect to u and r, before the sum over broadcast axes.

    ::

        v_u = v r (F'((u + 1/2) r) - F'((u - 1/2) r))
        v_r = v ((u + 1/2) F'((u + 1/2) r) - (u - 1/2) F'((u - 1/2) r))
    """
    high, low = distribution.pdf((u + 0.5) * rates), distribution.pdf((u - 0.5) * rates)
    return v * rates * (high - low), v * ((u + 0.5) * high - (u - 0.5) * low)


class Place(NamedTuple):
    """The position of P pixels in the footprints of G Gaussians."""

    u: Floats  # [G, P, 2] along the axes, px
    integrals: Floats  # [G, P, 2] I_1 and I_2


def pixel_response(distribution: Distribution) -> Response:
    """Return the response of projected Gaussians whose alpha is a mean over the pixel."""

    def hit(projection: Projection, ids: Ints, centers: Floats) -> Hit:
        axes = axes_of(projection.conics[ids])
        dtype = projection.means2d.dtype
        offsets = projection.means2d[ids, None] - centers.astype(dtype)  # [G, P, 2]
        u = _rotate(offsets, axes.angles.astype(dtype))
        rates = axes.rates.astype(dtype)[:, None, :]  # [G, 1, 2]
        parts = integrals(u, rates, distribution)  # [G, P, 2] I_1 and I_2
        unclamped = _masses(projection, ids, rates) * parts[..., 0] * parts[..., 1]
        depths = np.broadcast_to(projection.depths[ids, None], unclamped.shape)
        return Hit(unclamped, depths, Place(u, parts))

    def hit_vjp(
        projection: Projection, ids: Ints, hit: Hit, v_mean: Floats, v_shape: Floats, v_place: None
    ) -> tuple[Floats, ...]:
        """With ``M = 2 pi o / (r_1 r_2)``: v_I_1 = v M I_2, v_r_k -= v alpha / r_k, v_angle = v_u_1 u_2 - v_u_2 u_1."""
        axes, (u, parts) = axes_of(projection.conics[ids]), hit.place
        dtype = projection.means2d.dtype
        angles, rates = axes.angles.astype(dtype), axes.rates.astype(dtype)[:, None, :]
        M = _masses(projection, ids, rates)  # [G, 1]
        others = parts[..., ::-1] * M[..., None]  # [G, P, 2] dalpha / dI_k
        v_u_mean, _ = integrals_vjp(u, rates, distribution, v_mean[..., None] * others)
        v_u, v_r = integrals_vjp(u, rates, distribution, v_shape[..., None] * others)
        v_rates = v_r.sum(axis=1) - np.sum(v_shape * hit.unclamped, axis=1)[:, None] / rates[:, 0]  # [G, 2]
        v_angles = np.sum(v_u[..., 0] * u[..., 1] - v_u[..., 1] * u[..., 0], axis=1)
        v_conics = axes_of_vjp(projection.conics[ids], axes, Axes(v_rates, v_angles))
        v_opacities = np.sum(v_shape * parts[..., 0] * parts[..., 1], axis=1) * (2 * np.pi / rates.prod(axis=2)[:, 0])
        return _rotate(v_u_mean.sum(axis=1, keepdims=True), -angles)[:, 0], v_conics, v_opacities

    return Response(conic_boxes, hit, hit_vjp, ("means2d", "conics", "opacities"))


def _rotate(offsets: Floats, angles: Floats) -> Floats:
    """Return the components of vectors [G, P, 2] along axes at ``angles`` [G]."""
    cos, sin = np.cos(angles)[:, None], np.sin(angles)[:, None]
    x, y = offsets[..., 0], offsets[..., 1]
    return np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1)


def _masses(projection: Projection, ids: Ints, rates: Floats) -> Floats:
    """Return ``2 pi o / (r_1 r_2)`` [G, 1], the integral of a Gaussian over the image, px^2."""
    return 2 * np.pi * projection.opacities[ids, None] / rates.prod(axis=2)


EXACT_RESPONSE, RESPONSE = pixel_response(NORMAL), pixel_response(LOGISTIC)
