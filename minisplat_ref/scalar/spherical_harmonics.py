"""View-dependent colour of one Gaussian: real spherical harmonics of degree 0 to 3 (3DGS section 4, Plenoxels).

The sixteen basis functions are polynomials of the unit direction (x, y, z). They are written once, as products of the
first-degree terms, and their gradients are the derivatives of those polynomials.
"""

import math

from minisplat_ref.scalar._jit import scalar
from minisplat_ref.scalar.literals import FOUR, ONE, THREE, TWO, ZERO


@scalar
def direction(centre, x, y, z):
    """Unit direction from the camera centre to a point, and one over its length; zeros at the centre itself."""
    dx = x - centre[0]
    dy = y - centre[1]
    dz = z - centre[2]
    squared = dx * dx + dy * dy + dz * dz
    if squared == ZERO:
        return squared, squared, squared, squared
    inverse = ONE / math.sqrt(squared)
    return dx * inverse, dy * inverse, dz * inverse, inverse


@scalar
def direction_vjp(x, y, z, inverse, v_x, v_y, v_z):
    """Chain through d / |d|: the part along the direction is lost."""
    along = x * v_x + y * v_y + z * v_z
    return (v_x - along * x) * inverse, (v_y - along * y) * inverse, (v_z - along * z) * inverse


@scalar
def basis(x, y, z, c, degree, out):
    """Write the (degree + 1)^2 basis functions into ``out``; ``c`` holds the constants of degrees 1, 2 (3), 3 (5)."""
    if degree >= 1:
        out[1] = -c[1] * y
        out[2] = c[1] * z
        out[3] = -c[1] * x
    if degree >= 2:
        out[4] = c[2] * x * y
        out[5] = -c[2] * y * z
        out[6] = c[3] * (TWO * z * z - x * x - y * y)
        out[7] = -c[2] * x * z
        out[8] = c[4] * (x * x - y * y)
    if degree >= 3:
        out[9] = -c[5] * y * (THREE * x * x - y * y)
        out[10] = c[6] * x * y * z
        out[11] = -c[7] * y * (FOUR * z * z - x * x - y * y)
        out[12] = c[8] * z * (TWO * z * z - THREE * x * x - THREE * y * y)
        out[13] = -c[7] * x * (FOUR * z * z - x * x - y * y)
        out[14] = c[9] * z * (x * x - y * y)
        out[15] = -c[5] * x * (x * x - THREE * y * y)


@scalar
def basis_vjp(x, y, z, c, degree, v):
    """Chain ``v[k] = dL/dY_k`` to the direction, degree by degree."""
    v_x = ZERO * x
    v_y = ZERO * x
    v_z = ZERO * x
    if degree >= 1:
        v_x -= c[1] * v[3]
        v_y -= c[1] * v[1]
        v_z += c[1] * v[2]
    if degree >= 2:
        v_x += c[2] * (y * v[4] - z * v[7]) - TWO * x * (c[3] * v[6] - c[4] * v[8])
        v_y += c[2] * (x * v[4] - z * v[5]) - TWO * y * (c[3] * v[6] + c[4] * v[8])
        v_z += FOUR * c[3] * z * v[6] - c[2] * (y * v[5] + x * v[7])
    if degree >= 3:
        xx = x * x
        yy = y * y
        zz = z * z
        v_x += (
            -TWO * THREE * c[5] * x * y * v[9]
            + c[6] * y * z * v[10]
            + TWO * c[7] * x * y * v[11]
            - TWO * THREE * c[8] * x * z * v[12]
            - c[7] * (FOUR * zz - THREE * xx - yy) * v[13]
            + TWO * c[9] * x * z * v[14]
            - THREE * c[5] * (xx - yy) * v[15]
        )
        v_y += (
            -THREE * c[5] * (xx - yy) * v[9]
            + c[6] * x * z * v[10]
            - c[7] * (FOUR * zz - xx - THREE * yy) * v[11]
            - TWO * THREE * c[8] * y * z * v[12]
            + TWO * c[7] * x * y * v[13]
            - TWO * c[9] * y * z * v[14]
            + TWO * THREE * c[5] * x * y * v[15]
        )
        v_z += (
            c[6] * x * y * v[10]
            - TWO * FOUR * c[7] * z * (y * v[11] + x * v[13])
            + THREE * c[8] * (TWO * zz - xx - yy) * v[12]
            + c[9] * (xx - yy) * v[14]
        )
    return v_x, v_y, v_z
