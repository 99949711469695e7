"""Colours of either sign from the stages of any backend, and the recipe that trains them.

No stage is written again. The backends compute ``u = max(0, c)``; with all coefficients negated, which reflects the
colour at mid-grey, 0.5, they compute ``l = max(0, 1 - c)``; and

    c = u  where u > 0,   1 - l  elsewhere

because 1 - c is above zero wherever u is zero. So no channel is ever clamped on both sides, a colour of exactly zero
has a gradient, and a Gaussian whose channels are all positive is shaded by the first call alone, as in 3DGS.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from minisplat_ref.extensions.negative.reference import negate
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.rendering import SPLATTING, Renderer, Request
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Camera, Floats, Gaussians, Ints, Model, RenderOutput, SHGradient, View

FRACTION = 0.2  # of the Gaussians start negative: reported as best for the paper's scenes


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


def with_signed_colors(backend: Backend) -> Backend:
    """Return the backend with colours of either sign."""
    return replace(
        backend,
        name=f"{backend.name} with signed colours",
        sh_colors=partial(compute_signed_colors, backend),
        sh_colors_vjp=partial(compute_signed_colors_vjp, backend),
    )


def render(model: Model, view: View, request: Request) -> tuple[RenderOutput, Any]:
    """Render the view as 3DGS does, with colours of either sign; the tape keeps the backend for the gradient."""
    return SPLATTING.render(model, view, request._replace(backend=with_signed_colors(request.backend)))


def with_negatives(gaussians: Gaussians, rng: np.random.Generator, *, fraction: float) -> Gaussians:
    """Return the Gaussians with the colours of a fraction of them negated.

    Parameters
    ----------
    gaussians : Gaussians
        N Gaussians; they are not changed.
    rng : numpy.random.Generator
        Draws the rows, without replacement.
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
    renderer=Renderer("negative", render, SPLATTING.render_vjp, SPLATTING.channels),
)

NEGATIVE = GS_ACCEL._replace(name="negative")
"""The recipe ``negative``: 3DGS with negative Gaussians."""
