"""Error of the linear profile of a fan against a Gaussian's, seen from the front.

With the centre at the origin, in standard deviations, at the distance r and the angle theta from the middle of a side

    fan(r, theta) = 1 - (1 - rim) f   where f <= 1, else 0;     f = r cos(theta) / (k cos(pi / n))
    mass = integral of fan / (2 pi) = n k^2 sin(2 pi / n) (1 + 2 rim) / (12 pi)

f is 1 on the rim, and linear on each triangle. The error is the root of the mean squared difference from
``exp(-r^2 / 2)`` over the plane, relative to that of the Gaussian itself.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from data_tools.claims.fans.shape_search import alpha_of
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.extensions.fans.model import FRONT_REACH, FanShape, convert_gaussians
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.types import Camera, Floats, Gaussians, view_from

REACH_OF_GRID, STEP = 5.0, 0.025  # standard deviations
SIZE, DISTANCE = 65, 10.0  # px, standard deviations
OPACITY = 0.8
SCALES = {"disc": (1.0, 1.0, 0.01), "ball": (1.0, 1.0, 0.999)}  # a flat fan faces the camera first
ANGLES = tuple(range(0, 91, 10))  # degrees


def fan_profile(points: Floats, shape: FanShape) -> Floats:
    """Return the opacity [...] of a fan of opacity 1 at points [..., 2], standard deviations from its centre."""
    n = shape.n_sides
    angles = (np.arctan2(points[..., 1], points[..., 0]) % (2 * np.pi / n)) - np.pi / n
    f = np.linalg.norm(points, axis=-1) * np.cos(angles) / (shape.reach * math.cos(math.pi / n))
    profile: Floats = np.where(f <= 1, 1 - (1 - shape.rim) * f, 0)
    return profile


def mass(shape: FanShape) -> float:
    """Return the integral of a fan's profile over that of the Gaussian."""
    area = 0.5 * shape.n_sides * shape.reach**2 * math.sin(2 * math.pi / shape.n_sides)
    return area * (1 + 2 * shape.rim) / (6 * math.pi)


def profile_error(shape: FanShape) -> float:
    """Return the error of a fan's profile relative to the Gaussian's, by a sum over a grid."""
    axis = np.arange(-REACH_OF_GRID, REACH_OF_GRID, STEP) + STEP / 2
    points = np.stack(np.meshgrid(axis, axis), axis=-1)
    gaussian = np.exp(-0.5 * np.sum(points**2, axis=-1))
    return float(np.linalg.norm(fan_profile(points, shape) - gaussian) / np.linalg.norm(gaussian))


def best_profile(n_sides: int) -> FanShape:
    """Return the reach and the rim of the least error for a number of sides."""

    def shape_at(x: Floats) -> FanShape:
        return FanShape(n_sides, float(x[0]), float(np.clip(x[1], 0, 1)))

    found = minimize(lambda x: profile_error(shape_at(x)) + max(0, -x[1]), [2.5, 0.05], method="Nelder-Mead")
    return shape_at(found.x)


class Tilt(NamedTuple):
    """Errors of a fan of one Gaussian as it is turned away from the camera."""

    kind: str
    """Key of ``SCALES``."""
    is_flat: bool
    errors: list[float]
    """At ``ANGLES``: of alpha, the root mean square over that of the Gaussian."""


def tilts() -> list[Tilt]:
    """Return the errors of flat and of solid fans of a disc and of a ball."""
    f = SIZE * DISTANCE / 10  # the image is ten standard deviations wide
    view = view_from(Camera(np.eye(3), np.zeros(3), f, f, SIZE / 2, SIZE / 2, SIZE, SIZE))
    sharp = GSPLAT_MAIN._replace(eps2d=0.0)
    results = []
    for kind, scales in SCALES.items():
        for is_flat in (True, False):
            errors = []
            for angle in np.radians(ANGLES):
                one = _rotate(scales, angle)
                expected = alpha_of(one, view, conventions=sharp, backend=REFERENCE)
                fans = convert_gaussians(one, FanShape(reach=FRONT_REACH, is_flat=is_flat))
                found = alpha_of(fans, view, conventions=sharp, backend=REFERENCE)
                errors.append(float(np.linalg.norm(found - expected) / np.linalg.norm(expected)))
            results.append(Tilt(kind, is_flat, errors))
    return results


def _rotate(scales: tuple[float, float, float], angle: float) -> Gaussians:
    """Return one gray Gaussian before the camera, rotated about the x axis."""
    quats = np.array([[math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0]])
    return Gaussians(
        means=np.array([[0.0, 0.0, DISTANCE]]),
        quats=quats,
        log_scales=np.log([scales]),
        opacity_logits=np.full(1, math.log(OPACITY / (1 - OPACITY))),
        sh_dc=np.zeros((1, 3)),
        sh_rest=np.zeros((1, 0, 3)),
    )
