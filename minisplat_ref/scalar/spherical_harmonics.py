"""View-dependent colour of one Gaussian: real spherical harmonics of degree 0 to 3 (3DGS section 3, Plenoxels).

The sixteen basis functions are polynomials of the unit direction (x, y, z). They are written once, as products of the
first-degree terms, and their gradients are the derivatives of those polynomials.
"""

from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import select, sqrt
from minisplat_ref.jit.literals import FOUR, ONE, SIX, THREE, TWO, ZERO


@scalar
def direction(centre, x, y, z):
    """Return the unit direction from the camera centre to a point, and 1 / distance; zeros at the centre itself."""
    dx = x - centre[0]
    dy = y - centre[1]
    dz = z - centre[2]
    squared = dx * dx + dy * dy + dz * dz
    inverse = select(squared > ZERO, ONE / sqrt(select(squared > ZERO, squared, ONE)), ZERO)
    return dx * inverse, dy * inverse, dz * inverse, inverse


@scalar
def direction_vjp(x, y, z, inverse, v_x, v_y, v_z):
    """Chain through d / |d|, which removes the part along the direction."""
    along = x * v_x + y * v_y + z * v_z
    return (v_x - along * x) * inverse, (v_y - along * y) * inverse, (v_z - along * z) * inverse


@scalar
def basis_1(x, y, z, c):
    """Return the basis functions 1 to 3, of degree 1; ``c`` holds the constants of degrees 0, 1, 2 (3) and 3 (5)."""
    return -c[1] * y, c[1] * z, -c[1] * x


@scalar
def basis_2(x, y, z, c):
    """Return the basis functions 4 to 8, of degree 2."""
    return (
        c[2] * x * y,
        -c[2] * y * z,
        c[3] * (TWO * z * z - x * x - y * y),
        -c[2] * x * z,
        c[4] * (x * x - y * y),
    )


@scalar
def basis_3(x, y, z, c):
    """Return the basis functions 9 to 15, of degree 3."""
    return (
        -c[5] * y * (THREE * x * x - y * y),
        c[6] * x * y * z,
        -c[7] * y * (FOUR * z * z - x * x - y * y),
        c[8] * z * (TWO * z * z - THREE * x * x - THREE * y * y),
        -c[7] * x * (FOUR * z * z - x * x - y * y),
        c[9] * z * (x * x - y * y),
        -c[5] * x * (x * x - THREE * y * y),
    )


@scalar
def basis_1_vjp(c, v):
    """Chain the gradient with respect to the basis functions of degree 1 to the direction."""
    return -c[1] * v[2], -c[1] * v[0], c[1] * v[1]


@scalar
def basis_2_vjp(x, y, z, c, v):
    """Chain the gradient with respect to the basis functions of degree 2 to the direction."""
    return (
        c[2] * (y * v[0] - z * v[3]) - TWO * x * (c[3] * v[2] - c[4] * v[4]),
        c[2] * (x * v[0] - z * v[1]) - TWO * y * (c[3] * v[2] + c[4] * v[4]),
        FOUR * c[3] * z * v[2] - c[2] * (y * v[1] + x * v[3]),
    )


@scalar
def basis_3_vjp(x, y, z, c, v):
    """Chain the gradient with respect to the basis functions of degree 3 to the direction."""
    xx = x * x
    yy = y * y
    zz = z * z
    v_x = (
        -SIX * c[5] * x * y * v[0]
        + c[6] * y * z * v[1]
        + TWO * c[7] * x * y * v[2]
        - SIX * c[8] * x * z * v[3]
        - c[7] * (FOUR * zz - THREE * xx - yy) * v[4]
        + TWO * c[9] * x * z * v[5]
        - THREE * c[5] * (xx - yy) * v[6]
    )
    v_y = (
        -THREE * c[5] * (xx - yy) * v[0]
        + c[6] * x * z * v[1]
        - c[7] * (FOUR * zz - xx - THREE * yy) * v[2]
        - SIX * c[8] * y * z * v[3]
        + TWO * c[7] * x * y * v[4]
        - TWO * c[9] * y * z * v[5]
        + SIX * c[5] * x * y * v[6]
    )
    v_z = (
        c[6] * x * y * v[1]
        - TWO * FOUR * c[7] * z * (y * v[2] + x * v[4])
        + THREE * c[8] * (TWO * zz - xx - yy) * v[3]
        + c[9] * (xx - yy) * v[5]
    )
    return v_x, v_y, v_z
