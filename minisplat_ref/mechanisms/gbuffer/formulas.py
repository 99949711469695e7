"""Formulas of shading for one surface point, as numbers: directions, texels, the table of the split sum, irradiance.

:mod:`.environment`, :mod:`.prefilter` and :mod:`.brdf` state the equations for all points at once. Here a direction is
two angles, whatever the number of texels: the maps of two roughnesses are read at one (theta, phi), and the derivatives
of both add up before the angles are chained to the direction::

    v_theta = sum over maps of f H / pi v_row,   v_phi = sum of f W / (2 pi) v_column
    v_d = v_theta (z x / rho, z y / rho, -rho) + v_phi (-y, x, 0) / rho^2

with the share f of a map. All arithmetic is float64, and an index is within its array whatever the number.
"""

import math

from minisplat_ref.jit.compile import scalar
from minisplat_ref.scalar.projection import dot
from minisplat_ref.scalar.spherical_harmonics import basis_1, basis_1_vjp, basis_2, basis_2_vjp

FIRST, HEIGHT, WIDTH = 0, 1, 2  # columns of the table of maps: the first texel, and the number of rows and columns


@scalar
def load_triple(table, row):
    """Return a row of a table [N, 3] in float64."""
    return float(table[row, 0]), float(table[row, 1]), float(table[row, 2])


@scalar
def store_triple(table, row, a):
    """Write a row of a table [N, 3], rounded to its dtype."""
    table[row, 0] = a[0]
    table[row, 1] = a[1]
    table[row, 2] = a[2]


@scalar
def turn(R, a):
    """Return R a."""
    return (
        R[0, 0] * a[0] + R[0, 1] * a[1] + R[0, 2] * a[2],
        R[1, 0] * a[0] + R[1, 1] * a[1] + R[1, 2] * a[2],
        R[2, 0] * a[0] + R[2, 1] * a[1] + R[2, 2] * a[2],
    )


@scalar
def turn_back(R, a):
    """Return R^T a."""
    return (
        R[0, 0] * a[0] + R[1, 0] * a[1] + R[2, 0] * a[2],
        R[0, 1] * a[0] + R[1, 1] * a[1] + R[2, 1] * a[2],
        R[0, 2] * a[0] + R[1, 2] * a[1] + R[2, 2] * a[2],
    )


@scalar
def mirror(n, v):
    """Return n.v and ``r = 2 (n.v) n - v``."""
    cosine = dot(n, v)
    return cosine, (2.0 * cosine * n[0] - v[0], 2.0 * cosine * n[1] - v[1], 2.0 * cosine * n[2] - v[2])


@scalar
def mirror_vjp(n, v, cosine, v_cosine, v_r):
    """Gradient: ``v_n = v_(n.v) v + 2 (n.v) v_r + 2 (n.v_r) v``, ``v_v = v_(n.v) n + 2 (n.v_r) n - v_r``."""
    along, twice = v_cosine + 2.0 * dot(n, v_r), 2.0 * cosine
    v_n = along * v[0] + twice * v_r[0], along * v[1] + twice * v_r[1], along * v[2] + twice * v_r[2]
    return v_n, (along * n[0] - v_r[0], along * n[1] - v_r[1], along * n[2] - v_r[2])


# --- the environment ---


@scalar
def angles_of(d):
    """Return theta and phi of a direction."""
    return math.atan2(math.sqrt(d[0] * d[0] + d[1] * d[1]), d[2]), math.atan2(d[1], d[0])


@scalar
def angles_vjp(d, v_theta, v_phi):
    """Gradient of :func:`angles_of`, 0 at the poles; see above."""
    x, y, z = d
    rho2 = x * x + y * y
    if not rho2 > 0.0:
        return 0.0, 0.0, 0.0
    rho = math.sqrt(rho2)
    outwards, around = v_theta * z / rho, v_phi / rho2
    return outwards * x - around * y, outwards * y + around * x, -v_theta * rho


@scalar
def find_place(maps, k, angles):
    """Return the four texels of map k around a direction, the shares of the lower and of the right ones, and slopes.

    The slopes are those of the row by theta, 0 beyond the outer rows, and of the column by phi.
    """
    first, height, width = maps[k, FIRST], maps[k, HEIGHT], maps[k, WIDTH]
    by_theta, by_phi = height / math.pi, width / (2.0 * math.pi)
    row, column = angles[0] * by_theta - 0.5, angles[1] * by_phi + 0.5 * width - 0.5
    last = height - 1.0
    if not (row > 0.0 and row < last):
        row, by_theta = (last if row >= last else 0.0), 0.0
    upper = min(max(int(row), 0), max(height - 2, 0))
    left = min(max(math.floor(column), -1), width - 1)
    down, right = row - upper, column - left
    right_column = left + 1 if left + 1 < width else 0
    left_column = left if left >= 0 else width - 1
    rows = first + upper * width, first + min(upper + 1, height - 1) * width
    texels = rows[0] + left_column, rows[0] + right_column, rows[1] + left_column, rows[1] + right_column
    return texels, (down, right), (by_theta, by_phi)


@scalar
def _corners(texels, place, c):
    """Return a channel of the four texels."""
    i = place[0]
    return texels[i[0], c], texels[i[1], c], texels[i[2], c], texels[i[3], c]


@scalar
def _mix(corners, shares):
    down, right = shares
    upper = (1.0 - right) * corners[0] + right * corners[1]
    lower = (1.0 - right) * corners[2] + right * corners[3]
    return (1.0 - down) * upper + down * lower


@scalar
def read(texels, place):
    """Return the colour at a place."""
    shares = place[1]
    return (
        _mix(_corners(texels, place, 0), shares),
        _mix(_corners(texels, place, 1), shares),
        _mix(_corners(texels, place, 2), shares),
    )


@scalar
def _channel_vjp(texels, place, c, v, v_texels):
    """Add to one channel of the four texels; return what it adds to the gradients of the row and of the column."""
    i, (down, right), _ = place
    upper_left, upper_right, lower_left, lower_right = _corners(texels, place, c)
    v_upper, v_lower = (1.0 - down) * v, down * v
    v_texels[i[0], c] += (1.0 - right) * v_upper
    v_texels[i[1], c] += right * v_upper
    v_texels[i[2], c] += (1.0 - right) * v_lower
    v_texels[i[3], c] += right * v_lower
    v_row = v * ((1.0 - right) * (lower_left - upper_left) + right * (lower_right - upper_right))
    return v_row, v_upper * (upper_right - upper_left) + v_lower * (lower_right - lower_left)


@scalar
def read_vjp(texels, place, v, v_texels):
    """Add the gradient of :func:`read` to the texels; return that with respect to theta and phi."""
    row_0, column_0 = _channel_vjp(texels, place, 0, v[0], v_texels)
    row_1, column_1 = _channel_vjp(texels, place, 1, v[1], v_texels)
    row_2, column_2 = _channel_vjp(texels, place, 2, v[2], v_texels)
    by_theta, by_phi = place[2]
    return by_theta * (row_0 + row_1 + row_2), by_phi * (column_0 + column_1 + column_2)


@scalar
def find_knot(knots, roughness):
    """Return the index of the knot below a roughness, the share of the knot above, and the step between them."""
    below = 0
    for k in range(1, knots.size - 1):
        if roughness >= knots[k]:
            below = k
    step = knots[below + 1] - knots[below]
    return below, (roughness - knots[below]) / step, step


# --- the table of the split sum ---


@scalar
def _find_cell(x, size):
    """Return the cell of a table of ``size`` rows in which a number in [0, 1] lies, and its place there."""
    scaled = min(max(x, 0.0), 1.0) * (size - 1.0)
    cell = min(max(int(scaled), 0), size - 2)
    return cell, scaled - cell


@scalar
def read_table(table, cosine, roughness):
    """Return S and B, their derivatives by the cosine, and by the roughness."""
    size = table.shape[0]
    i, a = _find_cell(cosine, size)
    j, b = _find_cell(roughness, size)
    return _read_column(table, i, j, a, b, 0), _read_column(table, i, j, a, b, 1)


@scalar
def _read_column(table, i, j, a, b, c):
    """Return a value of a cell and its derivatives by row and by column."""
    near, far = table[i, j, c], table[i + 1, j, c]
    near_right, far_right = table[i, j + 1, c], table[i + 1, j + 1, c]
    left, right = (1.0 - a) * near + a * far, (1.0 - a) * near_right + a * far_right
    per_cell = table.shape[0] - 1.0
    by_row = per_cell * ((1.0 - b) * (far - near) + b * (far_right - near_right))
    return (1.0 - b) * left + b * right, by_row, per_cell * (right - left)


# --- irradiance ---


@scalar
def nine_bases(n, constants):
    """Return the harmonics of degrees 0 to 2."""
    return (constants[0], *basis_1(n[0], n[1], n[2], constants), *basis_2(n[0], n[1], n[2], constants))


@scalar
def nine_bases_vjp(n, constants, v):
    """Gradient of :func:`nine_bases`: ``v_n = sum_k v_k dY_k/dn``."""
    x_1, y_1, z_1 = basis_1_vjp(constants, (v[1], v[2], v[3]))
    x_2, y_2, z_2 = basis_2_vjp(n[0], n[1], n[2], constants, (v[4], v[5], v[6], v[7], v[8]))
    return x_1 + x_2, y_1 + y_2, z_1 + z_2


@scalar
def _sum_bases(bases, irradiance, c):
    return (
        bases[0] * irradiance[0, c]
        + bases[1] * irradiance[1, c]
        + bases[2] * irradiance[2, c]
        + bases[3] * irradiance[3, c]
        + bases[4] * irradiance[4, c]
        + bases[5] * irradiance[5, c]
        + bases[6] * irradiance[6, c]
        + bases[7] * irradiance[7, c]
        + bases[8] * irradiance[8, c]
    )


@scalar
def irradiate(bases, irradiance):
    """Return ``E = sum_k irradiance_k Y_k``."""
    return _sum_bases(bases, irradiance, 0), _sum_bases(bases, irradiance, 1), _sum_bases(bases, irradiance, 2)


@scalar
def irradiate_vjp(bases, irradiance, v, v_irradiance):
    """Add ``Y_k v`` to the irradiance; return ``v_Y_k = irradiance_k . v``."""
    for k in range(irradiance.shape[0]):
        v_irradiance[k, 0] += bases[k] * v[0]
        v_irradiance[k, 1] += bases[k] * v[1]
        v_irradiance[k, 2] += bases[k] * v[2]
    return (
        _row_dot(irradiance, 0, v),
        _row_dot(irradiance, 1, v),
        _row_dot(irradiance, 2, v),
        _row_dot(irradiance, 3, v),
        _row_dot(irradiance, 4, v),
        _row_dot(irradiance, 5, v),
        _row_dot(irradiance, 6, v),
        _row_dot(irradiance, 7, v),
        _row_dot(irradiance, 8, v),
    )


@scalar
def _row_dot(irradiance, k, v):
    return irradiance[k, 0] * v[0] + irradiance[k, 1] * v[1] + irradiance[k, 2] * v[2]
