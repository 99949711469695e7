"""Colours of all visible Gaussians of a view, forward and backward: the loops over ``scalar/spherical_harmonics.py``.

Eight Gaussians are processed together. The formulas need the same coefficient of all eight, but in memory the
coefficients of one Gaussian are contiguous. They are therefore transposed in small buffers that stay in the cache, and
copied to and from memory row by row: processors prefetch a single stream, but not eight rows read column by column.
Work is proportional to the number of visible Gaussians and of their coefficients: each chunk of Gaussians loops,
degree by degree, over a list of the visible ones of that degree.

Helpers have no loops and no branches: the compiler would count references of the arrays that such a helper is given,
an atomic operation each.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import SH_C0, SH_C1, SH_C2, SH_C3
from minisplat_ref.cpu.gaussian_rows import DOUBLE, add, contiguous, list_visible_degree, load_rows, sum_parts, triple
from minisplat_ref.cpu.memory import large_empty
from minisplat_ref.cpu.projection import N_CHUNKS
from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.jit.lanes import (
    WIDTH,
    cast,
    gather,
    iota,
    load,
    maximum,
    scatter,
    select,
    store,
    transpose,
)
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

_CONSTANTS = (SH_C0, SH_C1, *SH_C2, *SH_C3)
N_BASES = 16
N_REST = 3 * (N_BASES - 1)
STAGE = 48  # N_REST in whole lanes


class Shaded(NamedTuple):
    """The fields of the Gaussians on which colours depend, or the gradient with respect to them."""

    means: Floats
    """[N, 3] world frame."""
    sh_dc: Floats
    """[N, 3]."""
    sh_rest: Floats
    """[N * width] flat."""
    width: int
    """Numbers in a row of ``sh_rest``, 3 (K - 1)."""


class Harmonics(NamedTuple):
    """The viewpoint and the basis functions."""

    centre: Floats
    """[3] of the camera, float64."""
    constants: Floats
    """[10] of degrees 0, 1, 2 (3) and 3 (5)."""
    degrees: Ints
    """[N] uint8, active degree of each Gaussian."""
    lowest: int
    """Of the degrees, likewise below."""
    highest: int


@scalar
def _direction(centre, means, rows):
    """Return directions to means in the data's dtype; the difference is float64, for means far from the origin."""
    x, y, z = triple(means, rows)
    dx, dy, dz, inverse = direction(centre, x, y, z)
    zero = means.dtype.type(0)
    return cast(dx, zero), cast(dy, zero), cast(dz, zero), cast(inverse, zero)


@scalar
def _transpose_out(staged, column, buffer, k):
    """Transpose eight columns of the staged rows into a buffer, where number k of all eight starts at 8 k."""
    rows = (
        load(staged, column),
        load(staged, column + STAGE),
        load(staged, column + 2 * STAGE),
        load(staged, column + 3 * STAGE),
        load(staged, column + 4 * STAGE),
        load(staged, column + 5 * STAGE),
        load(staged, column + 6 * STAGE),
        load(staged, column + 7 * STAGE),
    )
    store(buffer, k * WIDTH, transpose(rows))


@scalar
def _transpose_back(buffer, k, staged, column):
    """Transpose eight columns of a buffer back into staged rows: the inverse of ``_transpose_out``."""
    columns = (
        _at(buffer, k),
        _at(buffer, k + 1),
        _at(buffer, k + 2),
        _at(buffer, k + 3),
        _at(buffer, k + 4),
        _at(buffer, k + 5),
        _at(buffer, k + 6),
        _at(buffer, k + 7),
    )
    a, b, c, d, e, f, g, h = transpose(columns)
    store(staged, column, a)
    store(staged, column + STAGE, b)
    store(staged, column + 2 * STAGE, c)
    store(staged, column + 3 * STAGE, d)
    store(staged, column + 4 * STAGE, e)
    store(staged, column + 5 * STAGE, f)
    store(staged, column + 6 * STAGE, g)
    store(staged, column + 7 * STAGE, h)


@scalar
def _at(buffer, k):
    return load(buffer, k * WIDTH)


@scalar
def _constant(sh_dc, rows, c0):
    """Return the colours of degree 0."""
    red, green, blue = gather(sh_dc, rows, 0), gather(sh_dc, rows, 1), gather(sh_dc, rows, 2)
    return HALF + c0 * red, HALF + c0 * green, HALF + c0 * blue


@scalar
def _rest_vjp(k, v_red, v_green, v_blue, y, rest):
    """Replace a basis function and its coefficients by the gradients with respect to them."""
    y_k = _at(y, k)
    store(y, k * WIDTH, _at(rest, 3 * k) * v_red + _at(rest, 3 * k + 1) * v_green + _at(rest, 3 * k + 2) * v_blue)
    store(rest, 3 * k * WIDTH, (y_k * v_red, y_k * v_green, y_k * v_blue))


@scalar
def _load_triple(buffer, k):
    return _at(buffer, k), _at(buffer, k + 1), _at(buffer, k + 2)


@scalar
def _add_lanes(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@scalar
def _zero_culled(first, end, radii, v):
    """Write the gradient of the Gaussians that the camera does not see."""
    v_means, v_dc, v_rest, width = v
    for n in range(first, end):
        if radii[n, 0] == 0:
            for i in range(3):
                v_means[n, i] = ZERO
                v_dc[n, i] = ZERO
            for column in range(0, width, WIDTH):
                store(v_rest, n * width + min(column, width - WIDTH), v_rest.dtype.type(0))


def _loop_over_chunk(has_gradient: bool) -> Callable:
    """Return the loop over the Gaussians of one degree: it writes their colours, or with a gradient chains it.

    One function for both, because a helper for their shared part would itself loop over the coefficients.
    """

    @scalar
    def _loop(span, degree, shaded, harmonics, radii, colors, backward):
        """``colors`` are written, or ``backward`` is v_colors, the gradient and its sums over offsets."""
        first, end = span
        means, sh_dc, sh_rest, width = shaded
        centre, c, degrees = harmonics.centre, harmonics.constants, harmonics.degrees
        staged = np.empty(STAGE * WIDTH, means.dtype)
        y = np.empty(N_BASES * WIDTH, means.dtype)
        rest = np.zeros(max(width, WIDTH) * WIDTH, means.dtype)  # beyond the active degree the gradient is zero
        visible = np.empty(end - first + WIDTH, np.int64)
        count = list_visible_degree(radii, degrees, degree, first, end, visible)
        n_rest = (degree + 1) * (degree + 1) - 1
        for i in range(0, count, WIDTH):
            rows = load_rows(visible, i)
            dx, dy, dz, inverse = _direction(centre, means, rows)
            if degree >= 1:
                store(y, 0, basis_1(dx, dy, dz, c))
            if degree >= 2:
                store(y, 3 * WIDTH, basis_2(dx, dy, dz, c))
            if degree >= 3:
                store(y, 8 * WIDTH, basis_3(dx, dy, dz, c))
            for r in range(WIDTH):
                for column in range(0, 3 * n_rest, WIDTH):
                    k = min(column, 3 * n_rest - WIDTH)
                    store(staged, r * STAGE + column, load(sh_rest, visible[i + r] * width + k))
            for column in range(0, 3 * n_rest, WIDTH):
                _transpose_out(staged, column, rest, min(column, 3 * n_rest - WIDTH))
            red, green, blue = _constant(sh_dc, rows, c[0])
            for k in range(n_rest):
                red = red + _at(y, k) * _at(rest, 3 * k)
                green = green + _at(y, k) * _at(rest, 3 * k + 1)
                blue = blue + _at(y, k) * _at(rest, 3 * k + 2)
            if not has_gradient:
                scatter(colors, rows, 0, maximum(red, ZERO))
                scatter(colors, rows, 1, maximum(green, ZERO))
                scatter(colors, rows, 2, maximum(blue, ZERO))
                continue
            v_colors, (v_means, v_dc, v_rest, _), v_offset = backward
            # A colour that is clamped at zero has no derivative.
            v_red = select(red > ZERO, gather(v_colors, rows, 0), ZERO)
            v_green = select(green > ZERO, gather(v_colors, rows, 1), ZERO)
            v_blue = select(blue > ZERO, gather(v_colors, rows, 2), ZERO)
            scatter(v_dc, rows, 0, c[0] * v_red)
            scatter(v_dc, rows, 1, c[0] * v_green)
            scatter(v_dc, rows, 2, c[0] * v_blue)
            for k in range(n_rest):
                _rest_vjp(k, v_red, v_green, v_blue, y, rest)
            for column in range(0, width, WIDTH):
                k = min(column, width - WIDTH)
                if k < 3 * n_rest:
                    _transpose_back(rest, k, staged, column)
                for r in range(WIDTH):
                    if k < 3 * n_rest:
                        store(v_rest, visible[i + r] * width + k, load(staged, r * STAGE + column))
                    else:
                        store(v_rest, visible[i + r] * width + k, v_rest.dtype.type(0))
            v_d = (ZERO * dx, ZERO * dx, ZERO * dx)
            if degree >= 1:
                v_d = _add_lanes(v_d, basis_1_vjp(c, _load_triple(y, 0)))
            if degree >= 2:
                v_d = _add_lanes(v_d, basis_2_vjp(dx, dy, dz, c, (*_load_triple(y, 3), _at(y, 6), _at(y, 7))))
            if degree >= 3:
                v_basis = (*_load_triple(y, 8), *_load_triple(y, 11), _at(y, 14))
                v_d = _add_lanes(v_d, basis_3_vjp(dx, dy, dz, c, v_basis))
            v_x, v_y, v_z = direction_vjp(dx, dy, dz, inverse, v_d[0], v_d[1], v_d[2])
            scatter(v_means, rows, 0, v_x)
            scatter(v_means, rows, 1, v_y)
            scatter(v_means, rows, 2, v_z)
            is_counted = iota(means.dtype.type(0)) < count - i
            add(v_offset, 0, is_counted, cast(v_x, DOUBLE))
            add(v_offset, 1, is_counted, cast(v_y, DOUBLE))
            add(v_offset, 2, is_counted, cast(v_z, DOUBLE))

    return _loop


_evaluate_chunk, _differentiate_chunk = _loop_over_chunk(False), _loop_over_chunk(True)


@kernel()
def _sh_colors(
    shaded,  # Shaded
    harmonics,  # Harmonics
    radii,  # [N, 2]
    colors,  # [N, 3]
):
    n_gaussians = radii.shape[0]
    for chunk in prange(N_CHUNKS):
        first, end = n_gaussians * chunk // N_CHUNKS, n_gaussians * (chunk + 1) // N_CHUNKS
        for n in range(first, end):
            for channel in range(3):
                colors[n, channel] = ZERO
        for degree in range(harmonics.lowest, harmonics.highest + 1):
            _evaluate_chunk((first, end), degree, shaded, harmonics, radii, colors, None)


def _harmonics(camera: Camera, degree: int | Ints, means: Floats) -> Harmonics:
    degrees = np.full(len(means), degree, np.uint8)
    lowest, highest = (int(np.min(degree, initial=255)), int(np.max(degree, initial=0)))
    constants = np.array(_CONSTANTS, means.dtype)
    return Harmonics(camera.astype(np.float64).center, constants, degrees, lowest, highest)


def sh_colors(means: Floats, sh_dc: Floats, sh_rest: Floats, camera: Camera, degree: int | Ints, radii: Ints) -> Floats:
    """Evaluate the colour of every visible Gaussian; see ``reference.spherical_harmonics.sh_colors``."""
    colors = np.empty(sh_dc.shape, sh_dc.dtype)
    means, sh_dc = contiguous(means, sh_dc)
    shaded = Shaded(means, sh_dc, sh_rest.ravel(), 3 * sh_rest.shape[1])
    _sh_colors(shaded, _harmonics(camera, degree, means), radii, colors)
    return colors


@kernel()
def _sh_colors_vjp(
    shaded,  # Shaded
    harmonics,  # Harmonics
    radii,  # [N, 2]
    v_colors,  # [N, 3]
    v,  # Shaded
):
    n_gaussians = radii.shape[0]
    v_offsets = np.empty((N_CHUNKS, 3 * WIDTH), np.float64)
    for chunk in prange(N_CHUNKS):
        first, end = n_gaussians * chunk // N_CHUNKS, n_gaussians * (chunk + 1) // N_CHUNKS
        v_offsets[chunk] = ZERO
        _zero_culled(first, end, radii, v)
        for degree in range(harmonics.lowest, harmonics.highest + 1):
            _differentiate_chunk((first, end), degree, shaded, harmonics, radii, None, (v_colors, v, v_offsets[chunk]))
    return sum_parts(v_offsets)


def sh_colors_vjp(
    means: Floats, sh_dc: Floats, sh_rest: Floats, camera: Camera, degree: int | Ints, radii: Ints, v_colors: Floats
) -> SHGradient:
    """Chain the gradient of the colours to their inputs; see ``reference.spherical_harmonics.sh_colors_vjp``."""
    dtype = means.dtype
    out = SHGradient(
        np.empty(means.shape, means.dtype),
        np.empty(sh_dc.shape, sh_dc.dtype),
        large_empty(sh_rest.shape, sh_rest.dtype),
        np.empty((3, 3), dtype),
        np.empty(3, dtype),
    )
    width = 3 * sh_rest.shape[1]
    means, sh_dc = contiguous(means, sh_dc)
    shaded = Shaded(means, sh_dc, sh_rest.ravel(), width)
    v_shaded = Shaded(out.means, out.sh_dc, out.sh_rest.reshape(-1), width)
    v_offset = _sh_colors_vjp(shaded, _harmonics(camera, degree, means), radii, v_colors, v_shaded)
    # Sum over the Gaussians of the gradient with respect to their offset, mean - centre, with centre = -R^T t.
    out.cam_from_world_R[:] = np.outer(camera.cam_from_world_t, v_offset)
    out.cam_from_world_t[:] = camera.cam_from_world_R @ v_offset
    return out
