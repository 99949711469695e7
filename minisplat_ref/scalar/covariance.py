"""Rotation of one Gaussian from its quaternion (3DGS section 4), as nine scalars.

The covariance itself is never formed here: projection uses its square root ``R diag(s)``, which loses no digits for
needle-shaped Gaussians.
"""

import numpy as np

from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import maximum, select, sqrt
from minisplat_ref.jit.literals import ONE, TWO, ZERO

TINY = np.finfo(np.float64).tiny  # the smallest number whose reciprocal is finite


@scalar
def normalize(w, x, y, z):
    """Return the unit quaternion and the reciprocal of the original length; zeros for the zero quaternion.

    The quaternion is float64 and divided by its largest entry first, so that no square overflows or underflows.
    """
    largest = maximum(maximum(abs(w), abs(x)), maximum(abs(y), abs(z)))
    unit = ONE / maximum(largest, TINY)
    w, x, y, z = w * unit, x * unit, y * unit, z * unit
    squared = w * w + x * x + y * y + z * z
    inverse = ONE / sqrt(select(largest > ZERO, squared, ONE))
    return w * inverse, x * inverse, y * inverse, z * inverse, select(largest > ZERO, inverse * unit, ZERO)


@scalar
def rotation(w, x, y, z):
    """Return the rotation matrix of a unit quaternion: nine entries, row by row."""
    return (
        (ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y)),
        (TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x)),
        (TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y)),
    )


@scalar
def rotation_vjp(w, x, y, z, v):
    """Chain ``v[i][j] = dL/dR_ij`` to a unit quaternion; each line collects the entries with one component."""
    v_w = TWO * (x * (v[2][1] - v[1][2]) + y * (v[0][2] - v[2][0]) + z * (v[1][0] - v[0][1]))
    v_x = TWO * (
        w * (v[2][1] - v[1][2]) + y * (v[0][1] + v[1][0]) + z * (v[0][2] + v[2][0]) - TWO * x * (v[1][1] + v[2][2])
    )
    v_y = TWO * (
        w * (v[0][2] - v[2][0]) + x * (v[0][1] + v[1][0]) + z * (v[1][2] + v[2][1]) - TWO * y * (v[0][0] + v[2][2])
    )
    v_z = TWO * (
        w * (v[1][0] - v[0][1]) + x * (v[0][2] + v[2][0]) + y * (v[1][2] + v[2][1]) - TWO * z * (v[0][0] + v[1][1])
    )
    return v_w, v_x, v_y, v_z


@scalar
def normalize_vjp(unit, inverse_length, v_unit):
    """Chain through q / |q|, which removes the part of the cotangent along the unit quaternion."""
    w, x, y, z = unit
    v_w, v_x, v_y, v_z = v_unit
    along = w * v_w + x * v_x + y * v_y + z * v_z
    return (
        (v_w - along * w) * inverse_length,
        (v_x - along * x) * inverse_length,
        (v_y - along * y) * inverse_length,
        (v_z - along * z) * inverse_length,
    )
