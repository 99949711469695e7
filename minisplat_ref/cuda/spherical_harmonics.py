"""Colours of all visible Gaussians of a view, forward and backward: a thread for each Gaussian.

Directions are differences of float64, for means far from the origin, and then in the data's dtype. The gradient with
respect to the camera's pose is summed as in :mod:`minisplat_ref.cuda.projection`.
"""

import functools
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import SH_C0, SH_C1, SH_C2, SH_C3
from minisplat_ref.cuda.arrays import beside, empty, to_device, to_host
from minisplat_ref.cuda.projection import sum_parts, wide_triple
from minisplat_ref.cuda.target import (
    ROW_THREADS,
    GpuKernel,
    cuda,
    device_function,
    gpu_kernel,
    launch_rows,
    n_row_blocks,
)
from minisplat_ref.jit.lanes import maximum, select
from minisplat_ref.jit.literals import HALF, ZERO
from minisplat_ref.scalar.spherical_harmonics import (
    basis_1,
    basis_1_vjp,
    basis_2,
    basis_2_vjp,
    basis_3,
    basis_3_vjp,
    direction,
    direction_vjp,
)
from minisplat_ref.types import Camera, Floats, Ints, SHGradient


class Shaded(NamedTuple):
    """The fields of the Gaussians on which colours depend, or the gradient with respect to them."""

    means: Floats
    """[N, 3] world frame."""
    sh_dc: Floats
    """[N, 3]."""
    sh_rest: Floats
    """[N, K-1, 3]."""


class Harmonics(NamedTuple):
    """The viewpoint and the basis functions."""

    centre: Floats
    """[3] of the camera, float64."""
    constants: Floats
    """[10] of degrees 0, 1, 2 (3) and 3 (5)."""
    degrees: Ints
    """[N] uint8, active degree of each Gaussian, or [1] of all."""


_CONSTANTS = (SH_C0, SH_C1, *SH_C2, *SH_C3)
N_REST = 15  # basis functions of degrees 1 to 3


@device_function
def store_basis(d, degree, c, y):
    """Write the basis functions of degree 1 and above in a direction."""
    if degree >= 1:
        first = basis_1(d[0], d[1], d[2], c)
        for k in range(3):
            y[k] = first[k]
    if degree >= 2:
        second = basis_2(d[0], d[1], d[2], c)
        for k in range(5):
            y[3 + k] = second[k]
    if degree >= 3:
        third = basis_3(d[0], d[1], d[2], c)
        for k in range(7):
            y[8 + k] = third[k]


@device_function
def evaluate(sh_dc, sh_rest, n, n_rest, y, c):
    """Return the colour of one Gaussian before it is clamped."""
    red, green, blue = HALF + c[0] * sh_dc[n, 0], HALF + c[0] * sh_dc[n, 1], HALF + c[0] * sh_dc[n, 2]
    for k in range(n_rest):
        red += y[k] * sh_rest[n, k, 0]
        green += y[k] * sh_rest[n, k, 1]
        blue += y[k] * sh_rest[n, k, 2]
    return red, green, blue


@functools.cache
def colors_kernel(dtype: np.dtype) -> GpuKernel:
    """Return the forward kernel for data of a dtype."""
    real = dtype.type

    @gpu_kernel
    def color_rows(shaded, harmonics, radii, colors):
        means, sh_dc, sh_rest = shaded
        centre, c, degrees = harmonics
        n = cuda.grid(1)
        if n >= means.shape[0]:
            return
        if radii[n, 0] == 0:
            for k in range(3):
                colors[n, k] = ZERO
            return
        y = cuda.local.array(N_REST, dtype)
        degree = int(degrees[min(n, degrees.shape[0] - 1)])
        mean = wide_triple(means, n)
        dx, dy, dz, _ = direction(centre, mean[0], mean[1], mean[2])
        store_basis((real(dx), real(dy), real(dz)), degree, c, y)
        color = evaluate(sh_dc, sh_rest, n, (degree + 1) * (degree + 1) - 1, y, c)
        for k in range(3):
            colors[n, k] = maximum(color[k], ZERO)

    return color_rows


@functools.cache
def colors_vjp_kernel(dtype: np.dtype) -> GpuKernel:
    """Return the backward kernel for data of a dtype."""
    real = dtype.type

    @gpu_kernel
    def color_rows_vjp(shaded, harmonics, radii, v_colors, out, v_offsets):
        means, sh_dc, sh_rest = shaded
        centre, c, degrees = harmonics
        parts = cuda.shared.array((ROW_THREADS, 3), np.float64)
        y = cuda.local.array(N_REST, dtype)
        n, thread = cuda.grid(1), cuda.threadIdx.x
        for k in range(3):
            parts[thread, k] = ZERO
        v_means, v_dc, v_rest = out
        if n < means.shape[0]:
            n_stored = sh_rest.shape[1]
            degree = int(degrees[min(n, degrees.shape[0] - 1)])
            n_rest = (degree + 1) * (degree + 1) - 1
            if radii[n, 0] == 0:
                n_rest = 0
                for k in range(3):
                    v_means[n, k] = ZERO
                    v_dc[n, k] = ZERO
            else:
                mean = wide_triple(means, n)
                dx, dy, dz, inverse = direction(centre, mean[0], mean[1], mean[2])
                d = real(dx), real(dy), real(dz)
                store_basis(d, degree, c, y)
                color = evaluate(sh_dc, sh_rest, n, n_rest, y, c)
                # A colour that is clamped at zero has no derivative.
                v_red = select(color[0] > ZERO, v_colors[n, 0], real(0))
                v_green = select(color[1] > ZERO, v_colors[n, 1], real(0))
                v_blue = select(color[2] > ZERO, v_colors[n, 2], real(0))
                v_dc[n, 0], v_dc[n, 1], v_dc[n, 2] = c[0] * v_red, c[0] * v_green, c[0] * v_blue
                for k in range(n_rest):
                    y_k = y[k]
                    y[k] = sh_rest[n, k, 0] * v_red + sh_rest[n, k, 1] * v_green + sh_rest[n, k, 2] * v_blue
                    v_rest[n, k, 0], v_rest[n, k, 1], v_rest[n, k, 2] = y_k * v_red, y_k * v_green, y_k * v_blue
                v_x, v_y, v_z = real(0), real(0), real(0)
                if degree >= 1:
                    v_1 = basis_1_vjp(c, (y[0], y[1], y[2]))
                    v_x, v_y, v_z = v_x + v_1[0], v_y + v_1[1], v_z + v_1[2]
                if degree >= 2:
                    v_2 = basis_2_vjp(d[0], d[1], d[2], c, (y[3], y[4], y[5], y[6], y[7]))
                    v_x, v_y, v_z = v_x + v_2[0], v_y + v_2[1], v_z + v_2[2]
                if degree >= 3:
                    v_3 = basis_3_vjp(d[0], d[1], d[2], c, (y[8], y[9], y[10], y[11], y[12], y[13], y[14]))
                    v_x, v_y, v_z = v_x + v_3[0], v_y + v_3[1], v_z + v_3[2]
                v_mean = direction_vjp(d[0], d[1], d[2], real(inverse), v_x, v_y, v_z)
                for k in range(3):
                    v_means[n, k] = v_mean[k]
                    parts[thread, k] = v_mean[k]
            for k in range(n_rest, n_stored):
                v_rest[n, k, 0], v_rest[n, k, 1], v_rest[n, k, 2] = ZERO, ZERO, ZERO
        sum_parts(parts, 3, v_offsets)

    return color_rows_vjp


def _harmonics(camera: Camera, degree: int | Ints, means: Floats) -> Harmonics:
    degrees = np.atleast_1d(np.asarray(degree, np.uint8))
    return Harmonics(camera.astype(np.float64).center, np.array(_CONSTANTS, means.dtype), degrees)


def sh_colors(means: Floats, sh_dc: Floats, sh_rest: Floats, camera: Camera, degree: int | Ints, radii: Ints) -> Floats:
    """Evaluate the colour of every visible Gaussian; see ``reference.spherical_harmonics.sh_colors``."""
    colors = empty(sh_dc.shape, sh_dc.dtype)
    shaded, harmonics = to_device(Shaded(means, sh_dc, sh_rest)), to_device(_harmonics(camera, degree, means))
    launch_rows(colors_kernel(means.dtype), len(means), shaded, harmonics, to_device(radii), colors)
    return beside(means, colors)


def sh_colors_vjp(
    means: Floats, sh_dc: Floats, sh_rest: Floats, camera: Camera, degree: int | Ints, radii: Ints, v_colors: Floats
) -> SHGradient:
    """Chain the gradient of the colours to their inputs; see ``reference.spherical_harmonics.sh_colors_vjp``."""
    dtype = means.dtype
    out = Shaded(empty(means.shape, dtype), empty(sh_dc.shape, dtype), empty(sh_rest.shape, dtype))
    v_offsets = empty((n_row_blocks(len(means)), 3), np.float64)
    shaded, harmonics = to_device(Shaded(means, sh_dc, sh_rest)), to_device(_harmonics(camera, degree, means))
    launch_rows(
        colors_vjp_kernel(dtype),
        len(means),
        *(shaded, harmonics, to_device(radii), to_device(v_colors)),
        *(out, v_offsets),
    )
    # Sum over the Gaussians of the gradient with respect to their offset, mean - centre, with centre = -R^T t.
    v_offset = np.sum(to_host(v_offsets), axis=0)
    v_R, v_t = np.outer(camera.cam_from_world_t, v_offset), camera.cam_from_world_R @ v_offset
    v = beside(means, out)
    return SHGradient(v.means, v.sh_dc, v.sh_rest, v_R.astype(dtype), v_t.astype(dtype))
