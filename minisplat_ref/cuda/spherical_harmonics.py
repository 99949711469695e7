"""Colours of all visible Gaussians of a view, forward and backward: a thread for each Gaussian.

Directions are differences of float64, for means far from the origin, and then in the data's dtype. The gradient with
respect to the camera's pose is summed as in :mod:`minisplat_ref.cuda.projection`.
"""

import functools
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import SH_C0, SH_C1, SH_C2, SH_C3
from minisplat_ref.cuda.arrays import beside, empty, to_device, to_host
from minisplat_ref.cuda.projection import store_triple, sum_parts, wide_triple
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


class Viewpoint(NamedTuple):
    """Where Gaussians are seen from, and with which basis functions."""

    centre: tuple[float, ...]
    """(x, y, z) of the camera, float64."""
    degree: int
    """Active degree."""
    degrees: Ints
    """[N] uint8, active degree of each Gaussian, or [0] where all have the same."""


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
def degree_of(viewpoint, n):
    """Return the active degree of a Gaussian."""
    return int(viewpoint.degrees[n]) if viewpoint.degrees.shape[0] > 0 else viewpoint.degree


@device_function
def evaluate(sh_dc, sh_rest, n, n_rest, y, c):
    """Return the colour of one Gaussian before it is clamped."""
    red, green, blue = HALF + c[0] * sh_dc[n, 0], HALF + c[0] * sh_dc[n, 1], HALF + c[0] * sh_dc[n, 2]
    for k in range(N_REST):  # a constant number of times, so that the compiler keeps y in registers
        if k < n_rest:
            red += y[k] * sh_rest[n, k, 0]
            green += y[k] * sh_rest[n, k, 1]
            blue += y[k] * sh_rest[n, k, 2]
    return red, green, blue


class Shading(NamedTuple):
    """Functions of kernels for data of a dtype."""

    color: Any
    """``color(shaded, n, degree, centre)``: the colour of a Gaussian, at least 0."""
    color_vjp: Any
    """``color_vjp(shaded, n, degree, centre, v_color, v)``: writes row n of v.sh_dc and v.sh_rest, returns v_mean."""


@functools.cache
def shading(dtype: np.dtype) -> Shading:
    """Return the functions for a dtype."""
    real, zero = dtype.type, dtype.type(0)
    c = tuple(real(constant) for constant in _CONSTANTS)

    @device_function
    def color(shaded, n, degree, centre):
        y = cuda.local.array(N_REST, dtype)
        mean = wide_triple(shaded.means, n)
        dx, dy, dz, _ = direction(centre, mean[0], mean[1], mean[2])
        store_basis((real(dx), real(dy), real(dz)), degree, c, y)
        n_rest = (degree + 1) * (degree + 1) - 1
        red, green, blue = evaluate(shaded.sh_dc, shaded.sh_rest, n, n_rest, y, c)
        return maximum(red, zero), maximum(green, zero), maximum(blue, zero)

    @device_function
    def color_vjp(shaded, n, degree, centre, v_color, v):
        y = cuda.local.array(N_REST, dtype)
        sh_rest, v_dc, v_rest = shaded.sh_rest, v.sh_dc, v.sh_rest
        mean = wide_triple(shaded.means, n)
        dx, dy, dz, inverse = direction(centre, mean[0], mean[1], mean[2])
        d = real(dx), real(dy), real(dz)
        store_basis(d, degree, c, y)
        n_rest = (degree + 1) * (degree + 1) - 1
        red, green, blue = evaluate(shaded.sh_dc, sh_rest, n, n_rest, y, c)
        # A colour that is clamped at zero has no derivative.
        v_red = select(red > ZERO, v_color[0], zero)
        v_green = select(green > ZERO, v_color[1], zero)
        v_blue = select(blue > ZERO, v_color[2], zero)
        v_dc[n, 0], v_dc[n, 1], v_dc[n, 2] = c[0] * v_red, c[0] * v_green, c[0] * v_blue
        for k in range(n_rest):
            y_k = y[k]
            y[k] = sh_rest[n, k, 0] * v_red + sh_rest[n, k, 1] * v_green + sh_rest[n, k, 2] * v_blue
            v_rest[n, k, 0], v_rest[n, k, 1], v_rest[n, k, 2] = y_k * v_red, y_k * v_green, y_k * v_blue
        for k in range(n_rest, sh_rest.shape[1]):
            v_rest[n, k, 0], v_rest[n, k, 1], v_rest[n, k, 2] = ZERO, ZERO, ZERO
        v_x, v_y, v_z = zero, zero, zero
        if degree >= 1:
            v_1 = basis_1_vjp(c, (y[0], y[1], y[2]))
            v_x, v_y, v_z = v_x + v_1[0], v_y + v_1[1], v_z + v_1[2]
        if degree >= 2:
            v_2 = basis_2_vjp(d[0], d[1], d[2], c, (y[3], y[4], y[5], y[6], y[7]))
            v_x, v_y, v_z = v_x + v_2[0], v_y + v_2[1], v_z + v_2[2]
        if degree >= 3:
            v_3 = basis_3_vjp(d[0], d[1], d[2], c, (y[8], y[9], y[10], y[11], y[12], y[13], y[14]))
            v_x, v_y, v_z = v_x + v_3[0], v_y + v_3[1], v_z + v_3[2]
        return direction_vjp(d[0], d[1], d[2], real(inverse), v_x, v_y, v_z)

    return Shading(color, color_vjp)


@device_function
def clear_color(v, n):
    """Write a gradient of zeros for the coefficients of a culled Gaussian."""
    for k in range(3):
        v.sh_dc[n, k] = ZERO
    for k in range(v.sh_rest.shape[1]):
        v.sh_rest[n, k, 0], v.sh_rest[n, k, 1], v.sh_rest[n, k, 2] = ZERO, ZERO, ZERO


@functools.cache
def colors_kernel(dtype: np.dtype) -> GpuKernel:
    """Return the forward kernel for data of a dtype."""
    color = shading(dtype).color

    @gpu_kernel
    def color_rows(
        shaded,  # Shaded
        viewpoint,  # Viewpoint
        radii,  # [N, 2]
        colors,  # [N, 3]
    ):
        n = cuda.grid(1)
        if n >= colors.shape[0]:
            return
        if radii[n, 0] == 0:
            store_triple(colors, n, (ZERO, ZERO, ZERO))
        else:
            store_triple(colors, n, color(shaded, n, degree_of(viewpoint, n), viewpoint.centre))

    return color_rows


@functools.cache
def colors_vjp_kernel(dtype: np.dtype) -> GpuKernel:
    """Return the backward kernel for data of a dtype."""
    color_vjp = shading(dtype).color_vjp

    @gpu_kernel
    def color_rows_vjp(
        shaded,  # Shaded
        viewpoint,  # Viewpoint
        radii,  # [N, 2]
        v_colors,  # [N, 3]
        out,  # Shaded
        v_offsets,  # [blocks, 3]
    ):
        parts = cuda.shared.array((ROW_THREADS, 3), np.float64)
        n, thread = cuda.grid(1), cuda.threadIdx.x
        for k in range(3):
            parts[thread, k] = ZERO
        if n < radii.shape[0]:
            if radii[n, 0] == 0:
                store_triple(out.means, n, (ZERO, ZERO, ZERO))
                clear_color(out, n)
            else:
                v_color = v_colors[n, 0], v_colors[n, 1], v_colors[n, 2]
                v_mean = color_vjp(shaded, n, degree_of(viewpoint, n), viewpoint.centre, v_color, out)
                store_triple(out.means, n, v_mean)
                store_triple(parts, thread, v_mean)
        sum_parts(parts, 3, v_offsets)

    return color_rows_vjp


def pass_viewpoint(camera: Camera, degree: int | Ints) -> Viewpoint:
    """Return the camera's centre as numbers, and the degrees on the device if they differ."""
    centre = tuple(camera.astype(np.float64).center)
    if np.ndim(degree) == 0:
        return Viewpoint(centre, int(degree), no_degrees())
    return Viewpoint(centre, 0, to_device(np.asarray(degree, np.uint8)))


@functools.cache
def no_degrees() -> Any:
    """Return an array [0] on the device."""
    return empty(0, np.uint8)


def sh_colors(means: Floats, sh_dc: Floats, sh_rest: Floats, camera: Camera, degree: int | Ints, radii: Ints) -> Floats:
    """Evaluate the colour of every visible Gaussian; see ``reference.spherical_harmonics.sh_colors``."""
    colors = empty(sh_dc.shape, sh_dc.dtype)
    shaded, viewpoint = to_device(Shaded(means, sh_dc, sh_rest)), pass_viewpoint(camera, degree)
    launch_rows(colors_kernel(means.dtype), len(means), shaded, viewpoint, to_device(radii), colors)
    return beside(means, colors)


def sh_colors_vjp(
    means: Floats, sh_dc: Floats, sh_rest: Floats, camera: Camera, degree: int | Ints, radii: Ints, v_colors: Floats
) -> SHGradient:
    """Chain the gradient of the colours to their inputs; see ``reference.spherical_harmonics.sh_colors_vjp``."""
    dtype = means.dtype
    out = Shaded(empty(means.shape, dtype), empty(sh_dc.shape, dtype), empty(sh_rest.shape, dtype))
    v_offsets = empty((n_row_blocks(len(means)), 3), np.float64)
    shaded, viewpoint = to_device(Shaded(means, sh_dc, sh_rest)), pass_viewpoint(camera, degree)
    launch_rows(
        colors_vjp_kernel(dtype),
        len(means),
        *(shaded, viewpoint, to_device(radii), to_device(v_colors)),
        *(out, v_offsets),
    )
    # Sum over the Gaussians of the gradient with respect to their offset, mean - centre, with centre = -R^T t.
    v_offset = np.sum(to_host(v_offsets), axis=0)
    v_R, v_t = np.outer(camera.cam_from_world_t, v_offset), camera.cam_from_world_R @ v_offset
    v = beside(means, out)
    return SHGradient(v.means, v.sh_dc, v.sh_rest, v_R.astype(dtype), v_t.astype(dtype))
