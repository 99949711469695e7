"""Hard cases of cameras that are no pinholes, with answers that were worked out without the renderer's formulas.

One ball in front of, beside or behind a camera, and the alpha of some pixels: along a ray at an angle g to the
direction of the ball's centre, at distance r, a ball of standard deviation s has ``o exp(-(r sin g / s)^2 / 2)`` where
g is less than 90 degrees. All images and gradients have to be finite.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.mechanisms.cameras.gsplat_call import rasterization, rasterization_vjp
from minisplat_ref.mechanisms.cameras.oracle.scenes import ALONG_RAYS
from minisplat_ref.oracle import call_cases
from minisplat_ref.oracle.cases import Report

SIZE, CENTER = 32, 16  # px; the principal point is (16.5, 16.5): the centre of pixel (16, 16) is on the axis
PINHOLE = {"focal": 32.0, **ALONG_RAYS}
FISHEYE = {"focal": 8.0, "camera_model": "fisheye", "radial_coeffs": np.zeros((1, 4)), **ALONG_RAYS}
ORTHO = {"focal": 8.0, "camera_model": "ortho"}
OPACITY = 0.8


class HardCase(NamedTuple):
    """A ball, a camera, and the alpha of some pixels."""

    name: str
    mean: tuple[float, float, float]
    scale: float
    camera: Mapping[str, Any]
    """Keywords of the call, and the focal length."""
    alphas: Mapping[tuple[int, int], float]
    """By row and column."""


def _radial(k1: float) -> dict[str, Any]:
    return {**PINHOLE, "radial_coeffs": np.array([[k1, 0, 0, 0, 0, 0]])}


def _place(r: float, angle: float) -> tuple[float, float, float]:
    """Return the place at a distance r and an angle from the axis towards x, radians."""
    return float(r * np.sin(angle)), 0.0, float(r * np.cos(angle))


def _ball(r: float, g: float, scale: float) -> float:
    return OPACITY * float(np.exp(-((r * np.sin(g) / scale) ** 2) / 2))


_SLOPE = 0.25 * (1 - 0.2 * 0.25**2)  # where a lens with k1 = -0.2 has the direction of slope 1/4
CASES = (
    HardCase(
        "pinhole: on the axis",
        (0, 0, 4.0),
        0.3,
        PINHOLE,
        {(CENTER, CENTER): OPACITY, (CENTER, CENTER + 4): _ball(4, np.arctan(1 / 8), 0.3)},
    ),
    HardCase(
        "pinhole: the mean beyond the border",
        _place(4, np.arctan(18 / 32)),
        0.5,
        PINHOLE,
        {(CENTER, SIZE - 1): _ball(4, np.arctan(18 / 32) - np.arctan(15 / 32), 0.5)},
    ),
    HardCase("pinhole: behind the camera", (0, 0, -4.0), 0.3, PINHOLE, {(CENTER, CENTER): 0.0}),
    HardCase(
        "lens: moved to a pixel's centre by a focal length that its distortion divides",
        _place(4, np.arctan(0.25)),
        0.1,
        {**_radial(-0.2), "focal": 8 / _SLOPE},
        {(CENTER, CENTER + 8): OPACITY},
    ),
    HardCase("lens: beyond the fold, whose image is inside", (4.0, 0, 2.0), 0.1, _radial(-0.2), {(CENTER, 29): 0.0}),
    HardCase(
        "fisheye: beyond 90 degrees",
        _place(4, 14 / 8),
        0.4,
        FISHEYE,
        {(CENTER, CENTER + 14): OPACITY, (CENTER, CENTER + 13): _ball(4, 1 / 8, 0.4)},
    ),
    HardCase("fisheye: behind the camera", (0, 0, -4.0), 0.3, FISHEYE, {(CENTER, CENTER): 0.0, (0, 0): 0.0}),
    HardCase(
        "fisheye: around the camera, half of its rays lead away",
        (0, 0, 2.0),
        3.0,
        FISHEYE,
        {(CENTER, CENTER): OPACITY, (CENTER, CENTER + 8): _ball(2, 1.0, 3), (CENTER, CENTER + 14): 0.0},
    ),
    HardCase(
        "ortho: as large at any depth, with the low-pass",
        (0, 0, 400.0),
        0.3,
        ORTHO,
        {(CENTER, CENTER): OPACITY, (CENTER + 4, CENTER): OPACITY * float(np.exp(-8 / (2.4**2 + 0.3)))},
    ),
    HardCase("ortho: behind the camera", (0, 0, -4.0), 0.3, ORTHO, {(CENTER, CENTER): 0.0}),
)


def select(pattern: str) -> tuple[HardCase, ...]:
    """Return the cases whose name holds a pattern; see :func:`minisplat_ref.oracle.call_cases.select`."""
    return call_cases.select(CASES, pattern)


def arguments_of(case: HardCase, dtype: str) -> dict[str, Any]:
    """Return the arguments of the call."""
    settings = {key: value for key, value in case.camera.items() if key != "focal"}
    focal = case.camera["focal"]
    K = np.array([[focal, 0, CENTER + 0.5], [0, focal, CENTER + 0.5], [0, 0, 1]], dtype)
    return {
        "means": np.array([case.mean], dtype),
        "quats": np.array([[0.9, 0.1, 0.2, 0.3]], dtype),
        "scales": np.full((1, 3), case.scale, dtype),
        "opacities": np.array([OPACITY], dtype),
        "colors": np.array([[0.2, 0.5, 0.9]], dtype),
        "viewmats": np.eye(4, dtype=dtype)[None],
        "Ks": K[None],
        "width": SIZE,
        "height": SIZE,
        **settings,
    }


def run_cases(cases: Sequence[HardCase] = CASES) -> Report:
    """Run cases; see :func:`minisplat_ref.oracle.call_cases.run_cases`."""
    return call_cases.run_cases("rasterization_cameras", _run, cases)


def _run(case: HardCase, backend: str, dtype: str) -> tuple[float, bool]:
    arguments = arguments_of(case, dtype)
    image, alpha, _ = rasterization(**arguments, backend=backend)
    ones: dict[str, Any] = {"v_render_colors": np.ones_like(image), "v_render_alphas": np.ones_like(alpha)}
    gradients = rasterization_vjp(**arguments, **ones, backend=backend)
    is_finite = all(np.isfinite(array).all() for array in (image, alpha, *gradients.values()))
    error = max(abs(float(alpha[0, row, column, 0]) - value) for (row, column), value in case.alphas.items())
    return error, is_finite
