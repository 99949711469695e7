"""Formulas of one pixel in the geometric losses: its edge weight to a neighbour, the cost of an error, its normal.

A plane N . X = c is seen along the ray (s, t, 1) at the inverse depth w = N . (s, t, 1) / c, which is linear in s and
t. Conversely N is proportional to (w_s, w_t, w - s w_s - t w_t). With forward differences, from a pixel of depth z to
its right and its lower neighbour of depths z_r and z_d, and divided by -w, so that N . (s, t, 1) = -1 and N faces the
camera:

    p = fx (z_r - z) / z_r,   q = fy (z_d - z) / z_d,   N = (p, q, -(1 + s p + t q))

So no cross product is taken and no point is computed.
"""

import math

from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.literals import HALF, ONE, THREE
from minisplat_ref.scalar.projection import dot


@scalar
def edge_weight(a, b, sharpness):
    """Return the weight of two neighbouring pixels of colours a and b: 1 where equal, near 0 across an edge."""
    difference = abs(a[0] - b[0]) + abs(a[1] - b[1]) + abs(a[2] - b[2])
    return math.exp(-sharpness * difference / THREE)


@scalar
def huber(error, tolerance):
    """Return the Huber function of an error: quadratic up to the tolerance, linear with slope 1 beyond."""
    size = abs(error)
    if size <= tolerance:
        return HALF * error * error / tolerance
    return size - HALF * tolerance


@scalar
def huber_vjp(error, tolerance):
    """Return the derivative of :func:`huber` with respect to the error, from -1 to 1."""
    return min(max(error / tolerance, -ONE), ONE)


@scalar
def pixel_normal(z, z_right, z_down, s, t, fx, fy):
    """Return the unit normal of a pixel of slopes s and t, and the inverse length of N."""
    p = fx * (z_right - z) / z_right
    q = fy * (z_down - z) / z_down
    n_z = -(ONE + s * p + t * q)
    inverse_length = ONE / math.sqrt(p * p + q * q + n_z * n_z)
    return (p * inverse_length, q * inverse_length, n_z * inverse_length), inverse_length


@scalar
def pixel_normal_vjp(z, z_right, z_down, s, t, fx, fy, v_normal):
    """Return the gradient with respect to log(z_right / z) and log(z_down / z); p = fx (1 - exp(-log(z_right / z)))."""
    normal, inverse_length = pixel_normal(z, z_right, z_down, s, t, fx, fy)
    along = dot(normal, v_normal)
    v_x = (v_normal[0] - along * normal[0]) * inverse_length
    v_y = (v_normal[1] - along * normal[1]) * inverse_length
    v_z = (v_normal[2] - along * normal[2]) * inverse_length
    return (v_x - s * v_z) * fx * z / z_right, (v_y - t * v_z) * fy * z / z_down
