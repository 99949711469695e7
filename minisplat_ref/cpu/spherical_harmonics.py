"""Colours of all visible Gaussians of a view, forward and backward: the loops over ``scalar/spherical_harmonics.py``.

Work is proportional to what the camera sees: culled Gaussians are skipped, and a chunk of Gaussians shares one small
buffer for the basis.
"""

import numpy as np

from minisplat_ref.constants import SH_C0, SH_C1, SH_C2, SH_C3
from minisplat_ref.cpu.projection import N_CHUNKS, camera_centre
from minisplat_ref.scalar._jit import kernel, prange, scalar
from minisplat_ref.scalar.literals import HALF, ZERO
from minisplat_ref.scalar.spherical_harmonics import basis, basis_vjp, direction, direction_vjp
from minisplat_ref.types import Camera, Floats, Ints, SHGradient

_CONSTANTS = (SH_C0, SH_C1, *SH_C2, *SH_C3)
N_BASES = 16


@scalar
def _direction(centre, means, n):
    """Direction to a mean in the data's dtype; the difference is float64, for worlds whose origin is far away."""
    dx, dy, dz, inverse = direction(centre, means[n, 0], means[n, 1], means[n, 2])
    as_data = means.dtype.type
    return as_data(dx), as_data(dy), as_data(dz), as_data(inverse)


@kernel()
def _sh_colors(means, sh_dc, sh_rest, centre, degree, c, radii, colors):
    n_gaussians = means.shape[0]
    n_rest = (degree + 1) * (degree + 1) - 1
    for chunk in prange(N_CHUNKS):
        y = np.empty(N_BASES, means.dtype)
        for n in range(n_gaussians * chunk // N_CHUNKS, n_gaussians * (chunk + 1) // N_CHUNKS):
            if radii[n, 0] == 0:
                continue
            dx, dy, dz, _ = _direction(centre, means, n)
            basis(dx, dy, dz, c, degree, y)
            for channel in range(3):
                value = HALF + c[0] * sh_dc[n, channel]
                for k in range(n_rest):
                    value += y[k + 1] * sh_rest[n, k, channel]
                colors[n, channel] = max(value, ZERO)


def sh_colors(means: Floats, sh_dc: Floats, sh_rest: Floats, camera: Camera, degree: int, radii: Ints) -> Floats:
    """Evaluate the colour of every visible Gaussian; see ``reference.spherical_harmonics.sh_colors``."""
    colors = np.zeros(sh_dc.shape, sh_dc.dtype)
    centre = camera_centre(camera)
    _sh_colors(means, sh_dc, sh_rest, centre, degree, np.array(_CONSTANTS, means.dtype), radii, colors)
    return colors


@scalar
def _sh_color_vjp(n, means, sh_dc, sh_rest, centre, degree, c, v_colors, out, v_centre, y, v_y):
    n_rest = (degree + 1) * (degree + 1) - 1
    dx, dy, dz, inverse = _direction(centre, means, n)
    basis(dx, dy, dz, c, degree, y)
    v_y[:] = ZERO
    for channel in range(3):
        value = HALF + c[0] * sh_dc[n, channel]
        for k in range(n_rest):
            value += y[k + 1] * sh_rest[n, k, channel]
        if value <= ZERO:  # the colour is clamped at zero and does not move
            continue
        v_value = v_colors[n, channel]
        out.sh_dc[n, channel] = c[0] * v_value
        for k in range(n_rest):
            out.sh_rest[n, k, channel] = y[k + 1] * v_value
            v_y[k + 1] += sh_rest[n, k, channel] * v_value
    v_d = basis_vjp(dx, dy, dz, c, degree, v_y)
    v_mean = direction_vjp(dx, dy, dz, inverse, v_d[0], v_d[1], v_d[2])
    for i in range(3):
        out.means[n, i] = v_mean[i]
        v_centre[i] -= v_mean[i]


@kernel()
def _sh_colors_vjp(means, sh_dc, sh_rest, centre, degree, c, radii, v_colors, out, v_centres):
    n_gaussians = means.shape[0]
    for chunk in prange(N_CHUNKS):
        y = np.empty(N_BASES, means.dtype)
        v_y = np.empty(N_BASES, means.dtype)
        for n in range(n_gaussians * chunk // N_CHUNKS, n_gaussians * (chunk + 1) // N_CHUNKS):
            if radii[n, 0] > 0:
                _sh_color_vjp(n, means, sh_dc, sh_rest, centre, degree, c, v_colors, out, v_centres[chunk], y, v_y)


def sh_colors_vjp(
    means: Floats, sh_dc: Floats, sh_rest: Floats, camera: Camera, degree: int, radii: Ints, v_colors: Floats
) -> SHGradient:
    """Chain the gradient of the colours to their inputs; see ``reference.spherical_harmonics.sh_colors_vjp``."""
    dtype = means.dtype
    v_centres = np.zeros((N_CHUNKS, 3), np.float64)
    out = SHGradient(
        np.zeros(means.shape, means.dtype),
        np.zeros(sh_dc.shape, sh_dc.dtype),
        np.zeros(sh_rest.shape, sh_rest.dtype),
        np.zeros((3, 3), dtype),
        np.zeros(3, dtype),
    )
    centre = camera_centre(camera)
    constants = np.array(_CONSTANTS, dtype)
    _sh_colors_vjp(means, sh_dc, sh_rest, centre, degree, constants, radii, v_colors, out, v_centres)
    v_centre = v_centres.sum(axis=0)
    out.cam_from_world_R[:] = -np.outer(camera.cam_from_world_t, v_centre)  # centre = -R^T t
    out.cam_from_world_t[:] = -camera.cam_from_world_R @ v_centre
    return out
