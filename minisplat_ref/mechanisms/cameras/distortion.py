"""Lens distortion of directions, with Jacobians and inverses, in NumPy.

Brown's model (Brown 1966, in OpenCV's rational form; COLMAP's SIMPLE_RADIAL to FULL_OPENCV) moves the slopes ``(x, y) =
(X / Z, Y / Z)``. With ``s = x^2 + y^2``::

    g  = (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3)
    x' = x g + 2 p1 x y + p2 (s + 2 x^2),   y' = y g + p1 (s + 2 y^2) + 2 p2 x y

The fisheye of Kannala and Brandt (2006; OpenCV's and COLMAP's OPENCV_FISHEYE) turns the angle to the axis into a
radius, so that directions beyond 90 degrees have a place in the image too::

    r = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8),   t = atan2(|(X, Y)|, Z)

Both fold where the radius no longer grows. Directions beyond have no inverse, and points there count as not seen.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from minisplat_ref.types import Bools, Floats

N_STEPS = 60  # of the inverse: bisection alone, from the widest interval, needs no more
NEAR_AXIS = 1e-8  # below this sine of the angle to the axis a fisheye is its first-order expansion
REAL = 1e-9  # imaginary part of a root that counts as real
SLOPE_MAX = 1e4  # of Brown's model: 89.99 degrees from the axis


class LensFunctions(NamedTuple):
    """The functions of a kind of lens; each takes the coefficients last."""

    bend: Callable[[Floats, tuple[float, ...]], Floats]
    """Directions [N, 3] of any length -> places [N, 2] in the image at focal length 1."""
    jacobians: Callable[[Floats, tuple[float, ...]], Floats]
    """Directions -> derivatives [N, 2, 3] of ``bend``."""
    unbend: Callable[[Floats, tuple[float, ...]], Floats]
    """Places [N, 2] -> unit directions [N, 3]; NaN where there is none."""
    is_seen: Callable[[Floats, tuple[float, ...]], Bools]
    """Directions -> whether they have a place, before the lens folds."""


# --- Brown ---


def brown(x: Floats, k: tuple[float, ...]) -> Floats:
    """Return the distorted slopes [N, 2] of directions [N, 3] in front of the camera."""
    slopes = x[:, :2] / x[:, 2:]
    s = np.sum(slopes * slopes, axis=1)
    a, b = slopes.T
    ab = 2 * a * b
    tangential = np.column_stack([k[6] * ab + k[7] * (s + 2 * a * a), k[6] * (s + 2 * b * b) + k[7] * ab])
    return slopes * _gain(s, k)[0][:, None] + tangential


def brown_jacobians(x: Floats, k: tuple[float, ...]) -> Floats:
    """Return the derivatives of :func:`brown`: ``dp/d(slopes) (1, 0, -x'; 0, 1, -y') / Z``."""
    slopes = x[:, :2] / x[:, 2:]
    eye = np.broadcast_to(np.eye(2), (len(x), 2, 2))
    of_slopes = np.concatenate([eye, -slopes[:, :, None]], axis=2) / x[:, 2, None, None]
    return _brown_by_slopes(slopes, k) @ of_slopes


def unbend_brown(places: Floats, k: tuple[float, ...]) -> Floats:
    """Return the directions that :func:`brown` maps to places: the radial part by bisection, the rest by Newton."""
    r_max = np.sqrt(brown_limit(k))

    def radius(r: Floats) -> Floats:
        return r * _gain(r * r, k)[0]

    wanted = np.linalg.norm(places, axis=1)
    r = _bisect(radius, wanted, r_max)
    slopes = places * np.where(wanted > 0, r / np.where(wanted > 0, wanted, 1), 1 / _gain(np.zeros(1), k)[0])[:, None]
    for _ in range(12):
        errors = brown(_ahead(slopes), k) - places
        steps = np.linalg.solve(_brown_by_slopes(slopes, k), errors[:, :, None])[:, :, 0]
        slopes = np.clip(slopes - steps, -r_max, r_max)
    is_found = np.abs(brown(_ahead(slopes), k) - places).max(axis=1, initial=0) <= 1e-10 * (1 + wanted)
    J = _brown_by_slopes(slopes, k)
    is_found &= J[:, 0, 0] * J[:, 1, 1] > J[:, 0, 1] * J[:, 1, 0]
    is_found &= brown_is_seen(_ahead(slopes), k)
    return np.where(is_found[:, None], _unit(_ahead(slopes)), np.nan)


def brown_is_seen(x: Floats, k: tuple[float, ...]) -> Bools:
    """Return whether directions lie in front of the camera and inside the radius at which the lens folds."""
    is_ahead = x[:, 2] > 0
    s = np.sum(x[:, :2] ** 2, axis=1) / np.where(is_ahead, x[:, 2], 1) ** 2
    return is_ahead & (s < brown_limit(k))


def brown_limit(k: tuple[float, ...]) -> float:
    """Return the squared slope at which ``r g(r^2)`` stops growing, at most ``SLOPE_MAX^2``.

    With ``g = N / D``, it is the least positive root in s of ``(N + 2 s N') D - 2 s N D'``, or of D.
    """
    N, D = np.polynomial.Polynomial([1, *k[:3]]), np.polynomial.Polynomial([1, *k[3:6]])
    s = np.polynomial.Polynomial([0, 1])
    growth = (N + 2 * s * N.deriv()) * D - 2 * s * N * D.deriv()
    return min(_least_root(growth, SLOPE_MAX**2), _least_root(D, SLOPE_MAX**2))


def _gain(s: Floats, k: tuple[float, ...]) -> tuple[Floats, Floats]:
    """Return g and dg/ds."""
    N, D = 1 + s * (k[0] + s * (k[1] + s * k[2])), 1 + s * (k[3] + s * (k[4] + s * k[5]))
    v_N, v_D = k[0] + s * (2 * k[1] + 3 * s * k[2]), k[3] + s * (2 * k[4] + 3 * s * k[5])
    return N / D, (v_N * D - N * v_D) / (D * D)


def _brown_by_slopes(slopes: Floats, k: tuple[float, ...]) -> Floats:
    """Return the derivatives [N, 2, 2] of :func:`brown` with respect to slopes."""
    a, b = slopes.T
    gain, by_s = _gain(a * a + b * b, k)
    p1, p2 = k[6], k[7]
    J = np.empty((len(slopes), 2, 2))
    J[:, 0, 0] = gain + 2 * a * a * by_s + 2 * p1 * b + 6 * p2 * a
    J[:, 1, 1] = gain + 2 * b * b * by_s + 6 * p1 * b + 2 * p2 * a
    J[:, 0, 1] = J[:, 1, 0] = 2 * a * b * by_s + 2 * p1 * a + 2 * p2 * b
    return J


# --- fisheye ---


def fisheye(x: Floats, k: tuple[float, ...]) -> Floats:
    """Return the places [N, 2] of directions [N, 3], at the radius of their angle to the axis."""
    rho = np.hypot(x[:, 0], x[:, 1])
    radius, _ = _radius(np.arctan2(rho, x[:, 2]), k)
    is_near = rho <= NEAR_AXIS * np.abs(x[:, 2])
    return x[:, :2] * np.where(is_near, 1 / x[:, 2], radius / np.where(is_near, 1, rho))[:, None]


def fisheye_jacobians(x: Floats, k: tuple[float, ...]) -> Floats:
    """Return the derivatives of :func:`fisheye`.

    With the unit vector u along (X, Y), v across it, ``rho = |(X, Y)|`` and ``dt = (Z d rho - rho dZ) / |x|^2``::

        J = u r'(t) dt^T + (r / rho) v v^T
    """
    rho = np.hypot(x[:, 0], x[:, 1])
    is_near = rho <= NEAR_AXIS * np.abs(x[:, 2])
    safe = np.where(is_near, 1, rho)
    radius, slope = _radius(np.arctan2(rho, x[:, 2]), k)
    u = np.where(is_near[:, None], [1.0, 0.0], x[:, :2] / safe[:, None])
    v = np.column_stack([-u[:, 1], u[:, 0]])
    across = np.where(is_near, 1 / np.where(x[:, 2] == 0, 1, x[:, 2]), radius / safe)
    by_angle = np.column_stack([x[:, 2:] * u, -rho]) / np.sum(x * x, axis=1)[:, None]  # [N, 3] dt
    J = slope[:, None, None] * u[:, :, None] * by_angle[:, None, :]
    J[:, :, :2] += across[:, None, None] * v[:, :, None] * v[:, None, :]
    return J


def unbend_fisheye(places: Floats, k: tuple[float, ...]) -> Floats:
    """Return the directions that :func:`fisheye` maps to places."""
    wanted = np.linalg.norm(places, axis=1)
    angles = _bisect(lambda t: _radius(t, k)[0], wanted, fisheye_limit(k))
    shrink = np.where(wanted > 0, np.sin(angles) / np.where(wanted > 0, wanted, 1), 1)
    return np.column_stack([places * shrink[:, None], np.cos(angles)])


def fisheye_is_seen(x: Floats, k: tuple[float, ...]) -> Bools:
    """Return whether the angle of directions to the axis is below that at which the lens folds."""
    return np.arctan2(np.hypot(x[:, 0], x[:, 1]), x[:, 2]) < fisheye_limit(k)


def fisheye_limit(k: tuple[float, ...]) -> float:
    """Return the angle at which the radius stops growing, at most pi."""
    growth = np.polynomial.Polynomial([1, 3 * k[0], 5 * k[1], 7 * k[2], 9 * k[3]])  # in t^2
    return float(np.sqrt(_least_root(growth, np.pi**2)))


def _radius(t: Floats, k: tuple[float, ...]) -> tuple[Floats, Floats]:
    """Return r and dr/dt."""
    s = t * t
    r = t * (1 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3]))))
    return r, 1 + s * (3 * k[0] + s * (5 * k[1] + s * (7 * k[2] + s * 9 * k[3])))


BROWN = LensFunctions(brown, brown_jacobians, unbend_brown, brown_is_seen)
FISHEYE = LensFunctions(fisheye, fisheye_jacobians, unbend_fisheye, fisheye_is_seen)


def _least_root(polynomial: np.polynomial.Polynomial, limit: float) -> float:
    """Return the least real root in (0, limit), or the limit."""
    roots = polynomial.trim().roots() if polynomial.trim().degree() > 0 else np.zeros(0)
    real = [root.real for root in np.atleast_1d(roots) if abs(np.imag(root)) <= REAL * max(abs(root), REAL)]
    return min([float(root) for root in real if 0 < root < limit], default=limit)


def _bisect(function: Callable[[Floats], Floats], wanted: Floats, limit: float) -> Floats:
    """Return where a function that grows on [0, limit] has the wanted values; NaN for larger ones.

    In every other step the secant through both ends replaces the middle, so few steps are needed.
    """
    low, high = np.zeros_like(wanted), np.full_like(wanted, limit)
    below, above = np.zeros_like(wanted) - wanted, function(high) - wanted
    is_inside = above >= 0
    for step in range(N_STEPS):
        secant = low - below * (high - low) / np.where(above > below, above - below, 1)
        middle = np.where(step % 2 == 0, np.clip(secant, low, high), (low + high) / 2)
        value = function(middle) - wanted
        is_low = value < 0
        low, below = np.where(is_low, middle, low), np.where(is_low, value, below)
        high, above = np.where(is_low, high, middle), np.where(is_low, above, value)
        if np.all(~is_inside | (high - low <= 1e-15 * limit)):
            break
    return np.where(is_inside, np.where(-below < above, low, high), np.nan)


def _ahead(slopes: Floats) -> Floats:
    return np.column_stack([slopes, np.ones(len(slopes))])


def _unit(x: Floats) -> Floats:
    unit: Floats = x / np.linalg.norm(x, axis=1, keepdims=True)
    return unit
