"""One Gaussian along the rays of a camera, as scalars: its place in the lens, its moments in the image, its reach.

The equations of lenses are those of :mod:`.distortion` and :mod:`.models`; those of the unscented transform and of the
whitening are in :mod:`.unscented` and :mod:`.ray_footprints`. A lens is a :class:`Lens` of functions of the camera's
frame; ``k`` are its coefficients, and behind them the limit at which it folds.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import WIDTH, load, select, sqrt, store
from minisplat_ref.jit.literals import ONE, TWO, ZERO
from minisplat_ref.mechanisms.cameras.distortion import NEAR_AXIS, brown_limit, fisheye_limit
from minisplat_ref.mechanisms.cameras.unscented import COVARIANCE_WEIGHTS, MEAN_WEIGHTS
from minisplat_ref.scalar.projection import dot
from minisplat_ref.types import Floats, Optics

MEAN_WEIGHT = float(MEAN_WEIGHTS[1])  # of each sigma point but the centre
CENTRE_WEIGHT, COVARIANCE_WEIGHT = float(COVARIANCE_WEIGHTS[0]), float(COVARIANCE_WEIGHTS[1])


class Lens(NamedTuple):
    """The functions of a kind of lens; ``scratch`` [16] is memory for eight angles."""

    bend: Callable
    """``bend(x, k, scratch)``: (place in the image at focal length 1, whether it is seen)."""
    jacobian: Callable
    """``jacobian(x, k, scratch)``: two rows of derivatives of the place."""
    has_distances: bool
    """Whether the order is that of the distances, and not of the camera z."""


class Moments(NamedTuple):
    """Mean and covariance in the image, px and px^2."""

    x: float
    y: float
    cov_xx: float
    cov_xy: float
    cov_yy: float


# --- pinhole and Brown ---


@scalar
def _slopes(x):
    return x[0] / x[2], x[1] / x[2]


@scalar
def _by_slopes(J, a, b, x):
    """Return the rows of J [2, 2], by slopes (a, b), times those of the slopes by x."""
    inverse_z = ONE / x[2]
    return (
        (J[0][0] * inverse_z, J[0][1] * inverse_z, -(J[0][0] * a + J[0][1] * b) * inverse_z),
        (J[1][0] * inverse_z, J[1][1] * inverse_z, -(J[1][0] * a + J[1][1] * b) * inverse_z),
    )


@scalar
def _bend_pinhole(x, k, scratch):
    return _slopes(x), x[2] > ZERO


@scalar
def _pinhole_jacobian(x, k, scratch):
    a, b = _slopes(x)
    one = ZERO * a + ONE
    return _by_slopes(((one, ZERO * a), (ZERO * a, one)), a, b, x)


@scalar
def _gain(s, k):
    """Return g and dg/ds."""
    N, D = ONE + s * (k[0] + s * (k[1] + s * k[2])), ONE + s * (k[3] + s * (k[4] + s * k[5]))
    v_N, v_D = k[0] + s * (TWO * k[1] + 3.0 * s * k[2]), k[3] + s * (TWO * k[4] + 3.0 * s * k[5])
    return N / D, (v_N * D - N * v_D) / (D * D)


@scalar
def _bend_brown(x, k, scratch):
    a, b = _slopes(x)
    s = a * a + b * b
    gain, _ = _gain(s, k)
    ab = TWO * a * b
    place = a * gain + k[6] * ab + k[7] * (s + TWO * a * a), b * gain + k[6] * (s + TWO * b * b) + k[7] * ab
    return place, (x[2] > ZERO) & (s < k[8])


@scalar
def _brown_jacobian(x, k, scratch):
    a, b = _slopes(x)
    gain, by_s = _gain(a * a + b * b, k)
    xx = gain + TWO * a * a * by_s + TWO * k[6] * b + 6.0 * k[7] * a
    yy = gain + TWO * b * b * by_s + 6.0 * k[6] * b + TWO * k[7] * a
    xy = TWO * a * b * by_s + TWO * k[6] * a + TWO * k[7] * b
    return _by_slopes(((xx, xy), (xy, yy)), a, b, x)


# --- fisheye ---


@scalar
def _angle(rho, z, scratch):
    """Return the angles to the axis, one after the other: there is no arctangent of lanes."""
    store(scratch, 0, rho)
    store(scratch, WIDTH, z)
    for i in range(WIDTH):
        scratch[i] = math.atan2(scratch[i], scratch[WIDTH + i])
    return load(scratch, 0)


@scalar
def _radius(t, k):
    """Return r and dr/dt."""
    s = t * t
    r = t * (ONE + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3]))))
    return r, ONE + s * (3.0 * k[0] + s * (5.0 * k[1] + s * (7.0 * k[2] + s * (9.0 * k[3]))))


@scalar
def _bend_fisheye(x, k, scratch):
    rho = sqrt(x[0] * x[0] + x[1] * x[1])
    angle, is_near = _angle(rho, x[2], scratch), rho <= NEAR_AXIS * abs(x[2])
    radius, _ = _radius(angle, k)
    shrink = select(is_near, ONE / x[2], radius / select(is_near, ONE, rho))
    return (x[0] * shrink, x[1] * shrink), angle < k[4]


@scalar
def _fisheye_jacobian(x, k, scratch):
    """``J = u r'(t) dt^T + (r / rho) v v^T`` with the unit vector u along (X, Y) and v across it."""
    rho = sqrt(x[0] * x[0] + x[1] * x[1])
    is_near = rho <= NEAR_AXIS * abs(x[2])
    safe = select(is_near, ONE, rho)
    radius, slope = _radius(_angle(rho, x[2], scratch), k)
    u_x, u_y = select(is_near, ONE, x[0] / safe), select(is_near, ZERO, x[1] / safe)
    across = select(is_near, ONE / select(abs(x[2]) > ZERO, x[2], ONE), radius / safe)
    by_square = slope / dot(x, x)
    dt = x[2] * u_x * by_square, x[2] * u_y * by_square, -rho * by_square
    return (
        (u_x * dt[0] + across * u_y * u_y, u_x * dt[1] - across * u_x * u_y, u_x * dt[2]),
        (u_y * dt[0] - across * u_x * u_y, u_y * dt[1] + across * u_x * u_x, u_y * dt[2]),
    )


PINHOLE = Lens(_bend_pinhole, _pinhole_jacobian, False)
BROWN = Lens(_bend_brown, _brown_jacobian, False)
FISHEYE = Lens(_bend_fisheye, _fisheye_jacobian, True)


def lens_of(optics: Optics | None) -> tuple[Lens, Floats]:
    """Return the lens of a camera whose rays begin at its centre, and its coefficients with the limit, float64."""
    if optics is None:
        return PINHOLE, np.zeros(1)
    if optics.model == "brown":
        return BROWN, np.array([*optics.coefficients, brown_limit(optics.coefficients)])
    return FISHEYE, np.array([*optics.coefficients, fisheye_limit(optics.coefficients)])


# --- any lens ---


@scalar
def _offset(place, centre, camera):
    """Return a place relative to the centre's, px."""
    return (place[0] - centre[0]) * camera.fx, (place[1] - centre[1]) * camera.fy


@scalar
def _add_product(spread, offset, shift):
    x, y = offset[0] - shift[0], offset[1] - shift[1]
    return spread[0] + x * x, spread[1] + x * y, spread[2] + y * y


@scalar
def moments(centre, places, camera, eps2d):
    """Return mean and covariance, with the low-pass, from the places of the six sigma points around the centre's."""
    a, b, c = _offset(places[0], centre, camera), _offset(places[1], centre, camera), _offset(places[2], centre, camera)
    d, e, f = _offset(places[3], centre, camera), _offset(places[4], centre, camera), _offset(places[5], centre, camera)
    shift = (
        MEAN_WEIGHT * (a[0] + b[0] + c[0] + d[0] + e[0] + f[0]),
        MEAN_WEIGHT * (a[1] + b[1] + c[1] + d[1] + e[1] + f[1]),
    )
    spread = _add_product((ZERO * shift[0], ZERO * shift[0], ZERO * shift[0]), a, shift)
    spread = _add_product(_add_product(spread, b, shift), c, shift)
    spread = _add_product(_add_product(_add_product(spread, d, shift), e, shift), f, shift)
    return Moments(
        centre[0] * camera.fx + camera.cx + shift[0],
        centre[1] * camera.fy + camera.cy + shift[1],
        CENTRE_WEIGHT * shift[0] * shift[0] + COVARIANCE_WEIGHT * spread[0] + eps2d,
        CENTRE_WEIGHT * shift[0] * shift[1] + COVARIANCE_WEIGHT * spread[1],
        CENTRE_WEIGHT * shift[1] * shift[1] + COVARIANCE_WEIGHT * spread[2] + eps2d,
    )


@scalar
def is_reached(x, distance, radius, cosine, sine):
    """Return whether a ball around x touches the cone about the axis that has the cosine and sine of half its angle.

    Beyond the cone, x is ``|x| sin`` of the further angle away from it, if that is no more than a right angle.
    """
    rho = sqrt(x[0] * x[0] + x[1] * x[1])
    beyond, along = rho * cosine - x[2] * sine, rho * sine + x[2] * cosine
    return beyond <= select(radius >= distance, radius, select(along >= ZERO, radius, ZERO))


@scalar
def pixel_vjp(J, focal_x, focal_y, v_x):
    """Return ``(J J^T)^-1 J v_x``, for the rows of J at focal length 1: the derivative by the mean's pixel."""
    a, b = J
    a, b = (a[0] * focal_x, a[1] * focal_x, a[2] * focal_x), (b[0] * focal_y, b[1] * focal_y, b[2] * focal_y)
    aa, ab, bb = dot(a, a), dot(a, b), dot(b, b)
    v_a, v_b = dot(a, v_x), dot(b, v_x)
    inverse = ONE / (aa * bb - ab * ab)
    return (bb * v_a - ab * v_b) * inverse, (aa * v_b - ab * v_a) * inverse


@scalar
def depth_vjp(x, v_depth, has_distances):
    """Return the gradient of the depth that orders the lists."""
    if has_distances:
        share = v_depth / sqrt(dot(x, x))
        return x[0] * share, x[1] * share, x[2] * share
    return ZERO * v_depth, ZERO * v_depth, v_depth
