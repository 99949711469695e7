"""A sky: light from behind the scene, infinitely far away, with a colour for each direction.

Gaussians have positions, and a sky has none: without this, training imitates it by large veils in front of the cameras,
which other views see from the side. A pixel whose ray has the unit direction d, in the world frame, and the
transmittance T shows

    c' = c + T s(d),   s(d) = sum_k s_k Y_k(d)        c: the scene with its background

with the real spherical harmonics Y_k up to degree 3, like the colours of a Gaussian, but neither offset nor clamped.
The coefficients s_k are a shared parameter of the model, ``sky`` [16, 3], which starts at zero. Pixels whose
transmittance is below a quarter of a step of an 8-bit image, which are most pixels, are left as they are: their sky
would not be seen. The renderer wraps any other one. A PLY file cannot store a sky: other viewers show the scene alone.
"""

from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import SH_DEGREE_MAX
from minisplat_ref.reference.pinhole import pinhole_rays, with_principal_point
from minisplat_ref.reference.spherical_harmonics import sh_basis, sh_basis_jacobian
from minisplat_ref.rendering import Renderer, RenderGradient, Request
from minisplat_ref.strategy.removal import CHANGES
from minisplat_ref.types import Camera, Floats, Ints, Model, RenderOutput, View

SKY = "sky"  # name of the shared parameter
N_BASIS = (SH_DEGREE_MAX + 1) ** 2
TRANSMITTANCE_MIN = 0.25 / 255.0  # below it the sky is not seen


def clear_sky(n_views: int) -> dict[str, Floats]:
    """Return coefficients of zero, [16, 3] float32, which change no rendering; ``n_views`` does not matter."""
    return {SKY: np.zeros((N_BASIS, 3), np.float32)}


def unit_rays(camera: Camera, pixels: Ints, dtype: np.dtype) -> Floats:
    """Return the unit directions [P, 3], camera frame, through the centres of pixels, given as y W + x."""
    rays = pinhole_rays(pixels % camera.width + 0.5, pixels // camera.width + 0.5, camera)
    return (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(dtype)


def sky_colors(rays: Floats, R: Floats, sky: Floats) -> Floats:
    """Return the colours of the sky along rays: ``s(d) = sum_k s_k Y_k(d)`` with ``d = R^T u``.

    Parameters
    ----------
    rays : ndarray of shape (P, 3)
        u, unit vectors, camera frame.
    R : ndarray of shape (3, 3)
        cam_from_world.
    sky : ndarray of shape (16, 3)
        s_k.

    Returns
    -------
    ndarray of shape (P, 3)
        RGB, not clamped.
    """
    return sh_basis(rays @ R, SH_DEGREE_MAX) @ sky


def sky_colors_vjp(rays: Floats, R: Floats, sky: Floats, v_colors: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`sky_colors` with respect to the coefficients and the rotation.

    ::

        v_s_k = sum Y_k v_s                        sums over the rays
        v_d   = sum_k (s_k . v_s) dY_k/dd
        v_R   = sum u v_d^T

    Parameters
    ----------
    rays, R, sky
        As for :func:`sky_colors`.
    v_colors : ndarray of shape (P, 3)
        Derivative with respect to the colours.

    Returns
    -------
    v_sky : ndarray of shape (16, 3)
    v_R : ndarray of shape (3, 3)
        With respect to the nine entries, unconstrained; both are float64, because they sum over many pixels.
    """
    directions = rays @ R
    v_sky = _summed_products(sh_basis(directions, SH_DEGREE_MAX), v_colors)
    v_d = (v_colors @ sky.T)[:, None, :] @ sh_basis_jacobian(directions, SH_DEGREE_MAX)  # [P, 1, 3]
    return v_sky, _summed_products(rays, v_d[:, 0])


def _summed_products(a: Floats, b: Floats) -> Floats:
    """Return ``sum_p a_pi b_pj`` in float64: not by BLAS, whose order of summation depends on its threads."""
    return np.einsum("ip,jp->ij", *(np.ascontiguousarray(each.T, dtype=np.float64) for each in (a, b)))


def sky_image(camera: Camera, sky: Floats, dtype: np.dtype) -> Floats:
    """Return the colours [H, W, 3] of the sky alone."""
    rays = unit_rays(camera, np.arange(camera.height * camera.width), dtype)
    colors = sky_colors(rays, camera.cam_from_world_R.astype(dtype), sky.astype(dtype, copy=False))
    return colors.reshape(camera.height, camera.width, 3)


class _Tape(NamedTuple):
    inner: Any  # tape of the wrapped renderer
    sky: Floats  # [16, 3] in the dtype of the image
    dtype: np.dtype  # of the parameter
    R: Floats  # [3, 3] in the dtype of the image
    pixels: Ints  # [P] that see the sky
    rays: Floats  # [P, 3]
    transmittances: Floats  # [P]
    colors: Floats  # [P, 3] of the sky
    rgb: slice  # their channels in the image


def with_sky(inner: Renderer) -> Renderer:
    """Return a renderer that renders the sky behind everything, if the model has one; other channels stay."""

    def render_over_sky(model: Model, view: View, request: Request) -> tuple[RenderOutput, Any]:
        if SKY not in model.shared:
            return inner.render(model, view, request)
        camera = with_principal_point(view.camera, request.conventions)
        if CHANGES in request.wants:
            request = request._replace(behind=sky_image(camera, model.shared[SKY], model.gaussians.means.dtype))
        output, tape = inner.render(model, view, request)
        image, dtype = output.image.copy(), output.image.dtype  # the inner tape may refer to the original
        transmittance = 1 - output.alpha.ravel()
        pixels = np.flatnonzero(transmittance >= TRANSMITTANCE_MIN)
        sky, R = model.shared[SKY].astype(dtype, copy=False), camera.cam_from_world_R.astype(dtype)
        rays, transmittances = unit_rays(camera, pixels, dtype), transmittance[pixels]
        colors = sky_colors(rays, R, sky)
        rgb = inner.channels(request.wants)["rgb"]
        image.reshape(-1, image.shape[2])[pixels, rgb] += transmittances[:, None] * colors
        own = _Tape(tape, sky, model.shared[SKY].dtype, R, pixels, rays, transmittances, colors, rgb)
        return output._replace(image=image), own

    def render_over_sky_vjp(tape: Any, v_image: Floats, v_alpha: Floats | None) -> RenderGradient:
        if not isinstance(tape, _Tape):
            return inner.render_vjp(tape, v_image, v_alpha)
        v_pixels = v_image.reshape(-1, v_image.shape[2])[tape.pixels, tape.rgb]  # [P, 3]
        v_sky, v_R = sky_colors_vjp(tape.rays, tape.R, tape.sky, tape.transmittances[:, None] * v_pixels)
        v_alphas = np.zeros(v_image.shape[:2], v_image.dtype) if v_alpha is None else v_alpha.copy()
        v_alphas.ravel()[tape.pixels] -= np.sum(tape.colors * v_pixels, axis=1)  # T = 1 - alpha
        v = inner.render_vjp(tape.inner, v_image, v_alphas)
        shared = {**v.shared, SKY: v_sky.astype(tape.dtype, copy=False)}
        return v._replace(shared=shared, cam_from_world_R=v.cam_from_world_R + v_R.astype(v_image.dtype))

    return Renderer(f"{inner.name} with sky", render_over_sky, render_over_sky_vjp, inner.channels)
