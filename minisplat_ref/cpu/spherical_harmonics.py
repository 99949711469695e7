"""Colours of all visible Gaussians of a view, forward and backward: the loops over ``scalar/spherical_harmonics.py``.

Eight Gaussians are one step. The coefficients of a Gaussian stand together in memory, and the numbers of eight
Gaussians are what the formulas want: they are turned in a small buffer that stays in the cache, so that memory is read
and written once, in order, and is what the time goes to. Work is proportional to what the camera sees: culled Gaussians
are left out of the list that a chunk goes through.
"""

import numpy as np

from minisplat_ref.constants import SH_C0, SH_C1, SH_C2, SH_C3
from minisplat_ref.cpu.projection import DOUBLE, N_CHUNKS, camera_centre, list_visible, listed_rows, triple
from minisplat_ref.scalar._jit import kernel, prange, scalar
from minisplat_ref.scalar.lanes import (
    WIDTH,
    converted,
    counted,
    filled,
    gather,
    larger,
    load,
    scatter,
    select,
    store,
    sum_of,
    transposed,
)
from minisplat_ref.scalar.literals import HALF, ZERO
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


@scalar
def _direction(centre, means, rows):
    """Directions to means in the data's dtype; the difference is float64, for worlds whose origin is far away."""
    x, y, z = triple(means, rows)
    dx, dy, dz, inverse = direction(centre, x, y, z)
    zero = means.dtype.type(0)
    return converted(dx, zero), converted(dy, zero), converted(dz, zero), converted(inverse, zero)


@scalar
def _read(table, rows, width, n_columns, turned):
    """Turn the first columns of eight rows of a flat table: number k of all eight stands at 8 k, one after the other.

    The last eight columns overlap the ones before, so that nothing beyond a row is touched.
    """
    for column in range(0, n_columns, WIDTH):
        k = min(column, n_columns - WIDTH)
        lanes = transposed(
            load(table, rows[0] * width + k),
            load(table, rows[1] * width + k),
            load(table, rows[2] * width + k),
            load(table, rows[3] * width + k),
            load(table, rows[4] * width + k),
            load(table, rows[5] * width + k),
            load(table, rows[6] * width + k),
            load(table, rows[7] * width + k),
        )
        store(turned, k * WIDTH, lanes)


@scalar
def _write(table, rows, width, turned):
    """Turn back, into eight rows of a flat table."""
    for column in range(0, width, WIDTH):
        k = min(column, width - WIDTH)
        i = k * WIDTH
        lanes = transposed(
            load(turned, i),
            load(turned, i + WIDTH),
            load(turned, i + 2 * WIDTH),
            load(turned, i + 3 * WIDTH),
            load(turned, i + 4 * WIDTH),
            load(turned, i + 5 * WIDTH),
            load(turned, i + 6 * WIDTH),
            load(turned, i + 7 * WIDTH),
        )
        store(table, rows[0] * width + k, lanes[0])
        store(table, rows[1] * width + k, lanes[1])
        store(table, rows[2] * width + k, lanes[2])
        store(table, rows[3] * width + k, lanes[3])
        store(table, rows[4] * width + k, lanes[4])
        store(table, rows[5] * width + k, lanes[5])
        store(table, rows[6] * width + k, lanes[6])
        store(table, rows[7] * width + k, lanes[7])


@scalar
def _colors(rows, sh_dc, c, n_rest, y, rest):
    """Colours of eight Gaussians before they are clamped, from the basis functions and coefficients in the buffers."""
    red = HALF + c[0] * gather(sh_dc, rows, 0)
    green = HALF + c[0] * gather(sh_dc, rows, 1)
    blue = HALF + c[0] * gather(sh_dc, rows, 2)
    for k in range(n_rest):
        y_k = load(y, k * WIDTH)
        red = red + y_k * load(rest, 3 * k * WIDTH)
        green = green + y_k * load(rest, (3 * k + 1) * WIDTH)
        blue = blue + y_k * load(rest, (3 * k + 2) * WIDTH)
    return red, green, blue


@scalar
def _prepare(rows, d, sh_rest, width, degree, c, y, rest):
    """Fill the buffers of eight Gaussians: basis functions from degree 1 on, and their coefficients."""
    if degree >= 1:
        store(y, 0, basis_1(d[0], d[1], d[2], c))
    if degree >= 2:
        store(y, 3 * WIDTH, basis_2(d[0], d[1], d[2], c))
    if degree >= 3:
        store(y, 8 * WIDTH, basis_3(d[0], d[1], d[2], c))
    _read(sh_rest, rows, width, 3 * ((degree + 1) * (degree + 1) - 1), rest)


@scalar
def _chunk_colors(first, end, means, sh_dc, sh_rest, width, centre, degree, c, radii, colors):
    y = np.empty(N_BASES * WIDTH, means.dtype)
    rest = np.empty(N_REST * WIDTH, means.dtype)
    visible = np.empty(end - first + WIDTH, np.int64)
    count = list_visible(radii, first, end, visible)
    n_rest = (degree + 1) * (degree + 1) - 1
    for n in range(first, end):
        for channel in range(3):
            colors[n, channel] = ZERO
    for i in range(0, count, WIDTH):
        rows = listed_rows(visible, i)
        _prepare(rows, _direction(centre, means, rows), sh_rest, width, degree, c, y, rest)
        red, green, blue = _colors(rows, sh_dc, c, n_rest, y, rest)
        scatter(colors, rows, 0, larger(red, ZERO))
        scatter(colors, rows, 1, larger(green, ZERO))
        scatter(colors, rows, 2, larger(blue, ZERO))


@kernel()
def _sh_colors(means, sh_dc, sh_rest, width, centre, degree, c, radii, colors):
    n_gaussians = means.shape[0]
    for chunk in prange(N_CHUNKS):
        first, end = n_gaussians * chunk // N_CHUNKS, n_gaussians * (chunk + 1) // N_CHUNKS
        _chunk_colors(first, end, means, sh_dc, sh_rest, width, centre, degree, c, radii, colors)


def sh_colors(means: Floats, sh_dc: Floats, sh_rest: Floats, camera: Camera, degree: int, radii: Ints) -> Floats:
    """Evaluate the colour of every visible Gaussian; see ``reference.spherical_harmonics.sh_colors``."""
    colors = np.empty(sh_dc.shape, sh_dc.dtype)
    constants = np.array(_CONSTANTS, means.dtype)
    width = 3 * sh_rest.shape[1]
    _sh_colors(means, sh_dc, sh_rest.ravel(), width, camera_centre(camera), degree, constants, radii, colors)
    return colors


@scalar
def _rest_vjp(v_red, v_green, v_blue, n_rest, y, rest):
    """Replace each basis function by the gradient by it, and each coefficient by the gradient by it."""
    for k in range(n_rest):
        y_k, red, green, blue = load(y, k * WIDTH), 3 * k * WIDTH, (3 * k + 1) * WIDTH, (3 * k + 2) * WIDTH
        store(y, k * WIDTH, load(rest, red) * v_red + load(rest, green) * v_green + load(rest, blue) * v_blue)
        store(rest, red, y_k * v_red)
        store(rest, green, y_k * v_green)
        store(rest, blue, y_k * v_blue)


@scalar
def _buffered(buffer, k):
    return load(buffer, k * WIDTH)


@scalar
def _added(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@scalar
def _basis_vjp(d, c, degree, v):
    """Chain the gradient by the basis functions, in a buffer, to the direction, degree by degree."""
    x, y, z = d
    v_d = (ZERO * x, ZERO * x, ZERO * x)
    if degree >= 1:
        v_d = _added(v_d, basis_1_vjp(c, (_buffered(v, 0), _buffered(v, 1), _buffered(v, 2))))
    if degree >= 2:
        own = (_buffered(v, 3), _buffered(v, 4), _buffered(v, 5), _buffered(v, 6), _buffered(v, 7))
        v_d = _added(v_d, basis_2_vjp(x, y, z, c, own))
    if degree >= 3:
        low = _buffered(v, 8), _buffered(v, 9), _buffered(v, 10), _buffered(v, 11)
        high = _buffered(v, 12), _buffered(v, 13), _buffered(v, 14)
        v_d = _added(v_d, basis_3_vjp(x, y, z, c, (*low, *high)))
    return v_d


@scalar
def _zero_culled(first, end, width, radii, v_means, v_dc, v_rest):
    for n in range(first, end):
        if radii[n, 0] == 0:
            for i in range(3):
                v_means[n, i] = ZERO
                v_dc[n, i] = ZERO
            for i in range(width):
                v_rest[n * width + i] = ZERO


@scalar
def _chunk_vjp(first, end, means, sh_dc, sh_rest, width, centre, degree, c, radii, v_colors, out, v_rest, v_centre):
    y = np.empty(N_BASES * WIDTH, means.dtype)
    rest = np.zeros(max(width, WIDTH) * WIDTH, means.dtype)  # beyond the active degree the gradient is zero
    visible = np.empty(end - first + WIDTH, np.int64)
    count = list_visible(radii, first, end, visible)
    n_rest = (degree + 1) * (degree + 1) - 1
    _zero_culled(first, end, width, radii, out.means, out.sh_dc, v_rest)
    sum_x, sum_y, sum_z = filled(DOUBLE), filled(DOUBLE), filled(DOUBLE)
    for i in range(0, count, WIDTH):
        rows = listed_rows(visible, i)
        dx, dy, dz, inverse = _direction(centre, means, rows)
        d = (dx, dy, dz)
        _prepare(rows, d, sh_rest, width, degree, c, y, rest)
        red, green, blue = _colors(rows, sh_dc, c, n_rest, y, rest)
        # A colour that is clamped at zero does not move.
        v_red = select(red > ZERO, gather(v_colors, rows, 0), ZERO)
        v_green = select(green > ZERO, gather(v_colors, rows, 1), ZERO)
        v_blue = select(blue > ZERO, gather(v_colors, rows, 2), ZERO)
        scatter(out.sh_dc, rows, 0, c[0] * v_red)
        scatter(out.sh_dc, rows, 1, c[0] * v_green)
        scatter(out.sh_dc, rows, 2, c[0] * v_blue)
        _rest_vjp(v_red, v_green, v_blue, n_rest, y, rest)
        _write(v_rest, rows, width, rest)
        v_d = _basis_vjp(d, c, degree, y)
        v_x, v_y, v_z = direction_vjp(dx, dy, dz, inverse, v_d[0], v_d[1], v_d[2])
        scatter(out.means, rows, 0, v_x)
        scatter(out.means, rows, 1, v_y)
        scatter(out.means, rows, 2, v_z)
        is_counted = counted(means.dtype.type(0)) < count - i
        sum_x = sum_x - converted(select(is_counted, v_x, ZERO), DOUBLE)
        sum_y = sum_y - converted(select(is_counted, v_y, ZERO), DOUBLE)
        sum_z = sum_z - converted(select(is_counted, v_z, ZERO), DOUBLE)
    v_centre[0], v_centre[1], v_centre[2] = sum_of(sum_x), sum_of(sum_y), sum_of(sum_z)


@kernel()
def _sh_colors_vjp(
    means, sh_dc, sh_rest, width, centre, degree, c, radii, v_colors, out, v_rest, v_centres
):
    n_gaussians = means.shape[0]
    for chunk in prange(N_CHUNKS):
        first, end = n_gaussians * chunk // N_CHUNKS, n_gaussians * (chunk + 1) // N_CHUNKS
        v_centre = v_centres[chunk]
        _chunk_vjp(
            first, end, means, sh_dc, sh_rest, width, centre, degree, c, radii, v_colors, out, v_rest, v_centre
        )


def sh_colors_vjp(
    means: Floats, sh_dc: Floats, sh_rest: Floats, camera: Camera, degree: int, radii: Ints, v_colors: Floats
) -> SHGradient:
    """Chain the gradient of the colours to their inputs; see ``reference.spherical_harmonics.sh_colors_vjp``."""
    dtype = means.dtype
    v_centres = np.empty((N_CHUNKS, 3), np.float64)
    out = SHGradient(
        np.empty(means.shape, means.dtype),
        np.empty(sh_dc.shape, sh_dc.dtype),
        np.empty(sh_rest.shape, sh_rest.dtype),
        np.empty((3, 3), dtype),
        np.empty(3, dtype),
    )
    constants = np.array(_CONSTANTS, dtype)
    _sh_colors_vjp(
        means,
        sh_dc,
        sh_rest.ravel(),
        3 * sh_rest.shape[1],
        camera_centre(camera),
        degree,
        constants,
        radii,
        v_colors,
        out,
        out.sh_rest.reshape(-1),
        v_centres,
    )
    v_centre = v_centres.sum(axis=0)
    out.cam_from_world_R[:] = -np.outer(camera.cam_from_world_t, v_centre)  # centre = -R^T t
    out.cam_from_world_t[:] = -camera.cam_from_world_R @ v_centre
    return out
