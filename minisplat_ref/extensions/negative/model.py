"""Colours of either sign: the difference of two densities, the renderer, and the recipe.

``f_c = (N(m0, S0) - c N(m1, S1)) / (1 - c)`` integrates to one for every c below one. It is not negative anywhere
exactly if c is at most the minimum of the quotient of the two densities, for which there is a closed form.

In a scene no stage is written again. The backends compute ``u = max(0, c)``; with all coefficients negated, which
reflects the colour at mid-grey, 0.5, they compute ``l = max(0, 1 - c)``; and

    c = u  where u > 0,   1 - l  elsewhere

because 1 - c is above zero wherever u is zero. So no channel is ever clamped on both sides, a colour of exactly zero
has a gradient, and a Gaussian whose channels are all positive is shaded by the first call alone, as in 3DGS.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from minisplat_ref.constants import SH_C0
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Camera, Floats, Gaussians, Ints, Model, RenderOutput, SHGradient, View

ROUNDING = 1e-12  # eigenvalues of a difference of covariances below this part of the largest count as zero
FRACTION = 0.2  # of the Gaussians start negative: reported as best for the paper's scenes


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


def compute_signed_colors(
    backend: Backend, means: Floats, sh_dc: Floats, sh_rest: Floats, camera: Camera, degree: int, radii: Ints
) -> Floats:
    """Return colours towards the camera without a clamp, ``c = 0.5 + sum_k c_k Y_k(d)``.

    Parameters
    ----------
    backend : Backend
        Its stage is called once or twice.
    means, sh_dc, sh_rest, camera, degree, radii
        As for :func:`minisplat_ref.reference.spherical_harmonics.sh_colors`.

    Returns
    -------
    ndarray of shape (N, 3)
        RGB of either sign; zero for culled rows.
    """
    colors = backend.sh_colors(means, sh_dc, sh_rest, camera, degree, radii)  # u [N, 3]
    rows = _find_clamped(colors, radii)
    if len(rows) > 0:
        upper = colors[rows]  # [M, 3]
        own = np.broadcast_to(degree, len(means))[rows]  # [M]
        lower = backend.sh_colors(means[rows], -sh_dc[rows], -sh_rest[rows], camera, own, radii[rows])  # l [M, 3]
        colors[rows] = np.where(upper == 0, 1 - lower, upper)
    return colors


def compute_signed_colors_vjp(
    backend: Backend,
    means: Floats,
    sh_dc: Floats,
    sh_rest: Floats,
    camera: Camera,
    degree: int | Ints,
    radii: Ints,
    v_colors: Floats,
) -> SHGradient:
    """Gradient of :func:`compute_signed_colors`.

    ::

        v_u = v where u > 0, else 0;   v_l = -v where u = 0, else 0
        the coefficients of l are the negated ones, so theirs is v_c_k(u) - v_c_k(l)

    Parameters
    ----------
    backend, means, sh_dc, sh_rest, camera, degree, radii
        As for :func:`compute_signed_colors`.
    v_colors : ndarray of shape (N, 3)
        Derivative with respect to the colours.
    """
    v = backend.sh_colors_vjp(means, sh_dc, sh_rest, camera, degree, radii, v_colors)  # zero where u = 0
    colors = backend.sh_colors(means, sh_dc, sh_rest, camera, degree, radii)  # u [N, 3]
    rows = _find_clamped(colors, radii)
    if len(rows) == 0:
        return v
    v_lower = np.where(colors[rows] == 0, -v_colors[rows], v_colors.dtype.type(0))  # [M, 3]
    own = np.broadcast_to(degree, len(means))[rows]  # [M]
    v_l = backend.sh_colors_vjp(means[rows], -sh_dc[rows], -sh_rest[rows], camera, own, radii[rows], v_lower)
    v.means[rows] += v_l.means
    v.sh_dc[rows] -= v_l.sh_dc
    v.sh_rest[rows] -= v_l.sh_rest
    return v._replace(
        cam_from_world_R=v.cam_from_world_R + v_l.cam_from_world_R,
        cam_from_world_t=v.cam_from_world_t + v_l.cam_from_world_t,
    )


def _find_clamped(upper: Floats, radii: Ints) -> Ints:
    """Return the rows [M] of visible Gaussians with a channel of u [N, 3] at zero; the others need no second call."""
    return np.flatnonzero((radii[:, 0] > 0) & (upper == 0).any(axis=1))


def sign_colors(backend: Backend) -> Backend:
    """Return the backend with colours of either sign."""
    return replace(
        backend,
        name=f"{backend.name} with signed colours",
        sh_colors=partial(compute_signed_colors, backend),
        sh_colors_vjp=partial(compute_signed_colors_vjp, backend),
    )


def render_signed(model: Model, view: View, request: Request) -> tuple[RenderOutput, Any]:
    """Render the view as 3DGS does, with colours of either sign; the tape keeps the backend for the gradient."""
    return SPLATTING.render(model, view, request._replace(backend=sign_colors(request.backend)))


def with_negatives(gaussians: Gaussians, rng: np.random.Generator, *, fraction: float) -> Gaussians:
    """Return the Gaussians with the colours of a fraction of them negated.

    Parameters
    ----------
    gaussians : Gaussians
        N Gaussians; they are not changed.
    rng : numpy.random.Generator
        Chooses the rows, without replacement.
    fraction : float
        In [0, 1]; the number of rows is rounded.
    """
    n = len(gaussians.means)
    rows = rng.choice(n, size=round(fraction * n), replace=False)
    sh_dc, sh_rest = gaussians.sh_dc.copy(), gaussians.sh_rest.copy()
    sh_dc[rows], sh_rest[rows] = negate(sh_dc[rows], sh_rest[rows])
    return gaussians._replace(sh_dc=sh_dc, sh_rest=sh_rest)


SIGNED = Representation(
    "gaussians of either sign",
    extend=partial(with_negatives, fraction=FRACTION),
    renderer=SPLATTING._replace(name="negative", render=render_signed),
)

NEGATIVE = GS_ACCEL._replace(name="negative")
"""The recipe ``negative``: 3DGS with negative Gaussians."""
