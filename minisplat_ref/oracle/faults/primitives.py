"""Errors of the projection and of the colours: what is computed once for each Gaussian."""

from collections.abc import Callable
from typing import Any

import numpy as np

from minisplat_ref.constants import SH_C0
from minisplat_ref.oracle.faults import forward as f
from minisplat_ref.oracle.faults.backward import as_planted
from minisplat_ref.oracle.faults.fault import Fault
from minisplat_ref.oracle.planted import change_camera
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.rendering.backends import REFERENCE, Backend
from minisplat_ref.types import Camera, Floats

CENTRES = "pixel centres at {} in place of 0.5"
EXPONENT = "the exponent times {}, such as a half that is missing"
OFF_DIAGONAL = "the conic's off-diagonal times {}"
OPACITY = "opacities times {}"
ORDER = "the Gaussians not sorted by depth"
DISTANCE = "distances from the camera in place of depths"
HALVES = (0.0, 1.0)  # pixel centres
FACTORS = (-1.0, 0.5, 2.0, 0.0)
DIAGONAL = np.array([1.0, -1.0, -1.0])


def _camera(**moved: Callable[[Camera, float], float]) -> Callable[[float], Backend]:
    """Return a fault that projects by a camera with other fields, in the projection alone."""
    return lambda size: change_camera(
        REFERENCE, lambda c: Camera(**{**c._asdict(), **{name: move(c, size) for name, move in moved.items()}})
    )


def _posed(change: Callable[[Camera], Camera]) -> Callable[[float], Backend]:
    return lambda _: f.with_camera(change)


def _covariances(change: Callable[[Floats, float, float], Floats]) -> Callable[[float], Backend]:
    """Return a fault of the covariances [N, 2, 2], by the low-pass that is in them and the size."""
    return lambda size: f.with_covariances(lambda B, c: change(B, c.eps2d, size))


def _jacobians(factor: Callable[[float], Floats]) -> Callable[[float], Backend]:
    return lambda size: f.with_jacobians(lambda J: J * factor(size))


PROJECTION = (
    Fault(
        f"{CENTRES}, in x and y",
        "projection",
        lambda d: f.with_positions(lambda p, _: p + 0.5 - d),
        HALVES,
        0.5,
    ),
    Fault(
        f"{CENTRES}, in x",
        "projection",
        lambda d: f.with_positions(lambda p, _: p + np.array([0.5 - d, 0])),
        HALVES,
        0.5,
    ),
    Fault(
        f"{CENTRES}, in y",
        "projection",
        lambda d: f.with_positions(lambda p, _: p + np.array([0, 0.5 - d])),
        HALVES,
        0.5,
    ),
    Fault(
        "the principal point taken in the image's middle",
        "projection",
        _camera(cx=lambda c, _: c.width / 2, cy=lambda c, _: c.height / 2),
    ),
    Fault(
        "focal lengths times {}",
        "projection",
        _camera(fx=lambda c, s: c.fx * s, fy=lambda c, s: c.fy * s),
        (1.02, 0.5, 2.0),
        1.0,
    ),
    Fault("fx times {}", "projection", _camera(fx=lambda c, s: c.fx * s), (1.02, 2.0), 1.0),
    Fault("fy times {}", "projection", _camera(fy=lambda c, s: c.fy * s), (1.02, 2.0), 1.0),
    Fault("fx and fy exchanged", "projection", _camera(fx=lambda c, _: c.fy, fy=lambda c, _: c.fx)),
    Fault("fx for both axes", "projection", _camera(fy=lambda c, _: c.fx)),
    Fault("fy for both axes", "projection", _camera(fx=lambda c, _: c.fy)),
    Fault(
        "the camera's y axis reversed",
        "projection",
        _posed(
            lambda c: c._replace(
                cam_from_world_R=np.diag([1, -1, 1]) @ c.cam_from_world_R,
                cam_from_world_t=np.array([1, -1, 1]) * c.cam_from_world_t,
            )
        ),
    ),
    Fault(
        "the camera's axes those of OpenGL",
        "projection",
        _posed(
            lambda c: c._replace(
                cam_from_world_R=np.diag(DIAGONAL) @ c.cam_from_world_R, cam_from_world_t=DIAGONAL * c.cam_from_world_t
            )
        ),
    ),
    Fault(
        "the view's rotation transposed",
        "projection",
        _posed(lambda c: c._replace(cam_from_world_R=c.cam_from_world_R.T.copy())),
    ),
    Fault(
        "the view's translation reversed",
        "projection",
        _posed(lambda c: c._replace(cam_from_world_t=-c.cam_from_world_t)),
    ),
    Fault("the view's rotation transposed in J R", "projection", as_planted("transposed-view")),
    Fault(
        "the low-pass at {} px^2 in place of 0.3",
        "projection",
        lambda e: f.with_rules(lambda c: {"eps2d": max(0.0, e)}),
        (0.0, 0.1, 1.0, 0.6),
        0.3,
    ),
    Fault("the low-pass on all four entries", "projection", _covariances(lambda B, e, _: B + e * (1 - np.eye(2)))),
    Fault("the low-pass in x alone", "projection", _covariances(lambda B, e, _: B - e * np.diag([0, 1]))),
    Fault("the low-pass in y alone", "projection", _covariances(lambda B, e, _: B - e * np.diag([1, 0]))),
    Fault("slopes of the Jacobian that are not clamped", "projection", lambda _: f.with_slope_limits(1e6)),
    Fault(
        "the limits of the Jacobian's slopes times {}", "projection", f.with_slope_limits, (0.8, 1.2, 1 / 1.3, 1.5), 1.0
    ),
    Fault(
        "the Jacobian's column of z times {}",
        "projection",
        _jacobians(lambda s: np.array([1, 1, s])),
        (0.0, -1.0),
        1.0,
    ),
    Fault(
        "the Jacobian's entry of x and z times {}",
        "projection",
        _jacobians(lambda s: np.array([[1, 1, s], [1, 1, 1]])),
        (0.0, -1.0),
        1.0,
    ),
    Fault(
        "the Jacobian's entry of y and z times {}",
        "projection",
        _jacobians(lambda s: np.array([[1, 1, 1], [1, 1, s]])),
        (0.0, -1.0),
        1.0,
    ),
    Fault("the Jacobian's row of x times {}", "projection", _jacobians(lambda s: np.array([[s], [1]])), (0.5,), 1.0),
    Fault("the Jacobian's row of y times {}", "projection", _jacobians(lambda s: np.array([[1], [s]])), (0.5,), 1.0),
    Fault("quaternions read as xyzw", "projection", f.with_rolled_quats),
    Fault("quaternions that are not normalised", "projection", f.with_unnormalised_quats),
    Fault(
        "quaternions that are not normalised",
        "projection",
        lambda _: f.with_rotations(f.unnormalised_rotations),
    ),
    Fault(
        "the Gaussians' rotation transposed, as of conjugated quaternions",
        "projection",
        lambda _: f.with_rotations(lambda q: rotation_matrices(q * [1, -1, -1, -1])),
    ),
    Fault("a covariance without its rotation", "projection", f.without_rotation),
    Fault("scales that are not squared", "projection", f.with_unsquared_scales),
    Fault("scales times {}", "projection", f.with_scales, (1.1, 2.0, 0.5), 1.0),
    Fault("the Jacobian times {}", "projection", _jacobians(lambda s: np.array([s, s, s])), (2.0, 0.5), 1.0),
    Fault("the exponential of scales", "projection", lambda _: f.with_primitives(scales=np.exp)),
    Fault("scales in the order zyx", "projection", lambda _: f.with_primitives(scales=lambda s: s[:, ::-1])),
    Fault("scales in the order yzx", "projection", lambda _: f.with_primitives(scales=lambda s: np.roll(s, -1, 1))),
    Fault("scales in the order zxy", "projection", lambda _: f.with_primitives(scales=lambda s: np.roll(s, 1, 1))),
    Fault("covariances without their off-diagonal", "projection", _covariances(lambda B, *_: B * np.eye(2))),
    Fault(
        "the covariance in place of its inverse",
        "projection",
        _covariances(lambda B, *_: np.linalg.inv(B)),
    ),
    Fault(OFF_DIAGONAL, "projection", lambda s: f.with_conics((1, s, 1)), FACTORS, 1.0),
    Fault(EXPONENT, "projection", lambda s: f.with_conics((s, s, s)), (2.0, 0.5, 1.1), 1.0),
    Fault("the conic's entry of x times {}", "projection", lambda s: f.with_conics((s, 1, 1)), (2.0, 0.5), 1.0),
    Fault("the conic's entry of y times {}", "projection", lambda s: f.with_conics((1, 1, s)), (2.0, 0.5), 1.0),
    Fault(
        "a plus in the determinant of the covariance",
        "projection",
        _covariances(
            lambda B, *_: (
                B * (B[:, 0, 0] * B[:, 1, 1] + B[:, 0, 1] ** 2)[:, None, None] / np.linalg.det(B)[:, None, None]
            )
        ),
    ),
    Fault("the conic's diagonal exchanged", "projection", lambda _: f.with_conics((1, 1, 1), (2, 1, 0))),
    Fault(
        "opacities that are not compensated", "projection", lambda _: f.with_rules(lambda _: {"is_antialiased": False})
    ),
    Fault(
        "opacities compensated where they should not be",
        "projection",
        lambda _: f.with_rules(lambda _: {"is_antialiased": True}),
    ),
    Fault("opacities compensated without the square root", "projection", lambda _: f.with_compensations(2.0)),
    Fault("opacities divided by their compensation", "projection", lambda _: f.with_compensations(-1.0)),
    Fault(OPACITY, "projection", lambda s: f.with_projected_opacities(lambda o: s * o), (0.9, 0.5), 1.0),
    Fault(
        "Gaussians cut at three deviations",
        "projection",
        as_planted("three-sigma"),
        has_own_bounds=True,
    ),
    Fault(
        "the near plane times {}",
        "projection",
        lambda s: f.with_rules(lambda c: {"near_plane": s * c.near_plane}),
        (0.0, 0.5, 2.0, 0.1, 1.3),
    ),
    Fault(
        "a near plane at {}, whatever is asked for",
        "projection",
        lambda s: f.with_rules(lambda _: {"near_plane": s}),
        (0.01, 0.2, 0.1),
    ),
    Fault("no near plane", "projection", lambda _: f.with_rules(lambda _: {"near_plane": -1e9})),
    Fault("no far plane", "projection", lambda _: f.with_rules(lambda _: {"far_plane": 1e9})),
    Fault(DISTANCE, "projection", f.with_distances),
    Fault("depths times {}", "projection", lambda s: f.with_depths(lambda z: s * z), (0.5, -1.0), 1.0),
    Fault("the reciprocals of depths", "projection", lambda _: f.with_depths(lambda z: 1 / z)),
)

NAMES = ("Y_1,-1", "Y_1,0", "Y_1,1", *(f"Y_2,{m}" for m in range(-2, 3)), *(f"Y_3,{m}" for m in range(-3, 4)))
"""Of the harmonics that ``sh_rest`` holds the coefficients of."""


def _coefficient(k: int) -> Fault:
    def plant(factor: float) -> Backend:
        return f.with_coefficient(k, factor)

    return Fault(f"harmonic {NAMES[k]} times {{}}", "colours", plant, (-1.0,), 1.0)


def _band(degree: int) -> Fault:
    def plant(factor: float) -> Backend:
        return f.with_bands(lambda own: factor if own == degree else 1.0)

    return Fault(f"harmonics of degree {degree} times {{}}", "colours", plant, (-1.0,), 1.0)


def _cut(degree: int) -> Fault:
    def plant(_: float) -> Backend:
        return f.with_bands(lambda own: 1.0 if own <= degree else 0.0)

    return Fault(f"harmonics above degree {degree} missing", "colours", plant)


def _reordered(words: str, *columns: int) -> Fault:
    def change(sh_dc: Floats, sh_rest: Floats) -> tuple[Floats, Floats]:
        order = np.arange(sh_rest.shape[1])
        order[:3] = columns[: len(order)]
        return sh_dc, sh_rest[:, order]

    return Fault(f"harmonics of degree 1 in the order {words}", "colours", lambda _: f.with_coefficients(change))


def _by_channel(sh_dc: Floats, sh_rest: Floats) -> tuple[Floats, Floats]:
    return sh_dc, sh_rest.reshape(len(sh_rest), 3, -1).swapaxes(1, 2)


def _base(factor: float) -> Backend:
    return f.with_coefficients(lambda sh_dc, sh_rest: (factor * sh_dc, sh_rest))


def _in_camera(means: Floats, camera: Camera) -> tuple[Floats, Camera]:
    seen = means @ camera.cam_from_world_R.T + camera.cam_from_world_t
    return seen, camera._replace(cam_from_world_R=np.eye(3), cam_from_world_t=np.zeros(3))


def _from(centre: Callable[[Camera], Floats]) -> Callable[[Any], Backend]:
    """Return a fault that shades as seen from another centre than ``-R^T t``."""
    return lambda _: f.with_directions(
        lambda means, c: (means, c._replace(cam_from_world_t=-c.cam_from_world_R @ centre(c)))
    )


COLORS = (
    *(_band(degree) for degree in (1, 2, 3)),
    *(_coefficient(k) for k in range(15)),
    Fault("harmonic Y_0,0 times {}", "colours", _base, (1 / SH_C0, 0.5), 1.0),
    *(_cut(degree) for degree in (0, 1, 2)),
    _reordered("x, y, z", 2, 0, 1),
    _reordered("z, x, y", 1, 2, 0),
    _reordered("x, z, y", 2, 1, 0),
    Fault("coefficients read channel by channel", "colours", lambda _: f.with_coefficients(_by_channel)),
    Fault("colours off by {}, such as the 0.5", "colours", f.with_lighter_colors, (-0.5, 0.5), 0.0),
    Fault("viewing directions reversed", "colours", lambda _: f.with_bands(lambda degree: (-1.0) ** degree)),
    Fault("viewing directions that are not normalised", "colours", f.with_unnormalised_directions),
    Fault("viewing directions in the camera's frame", "colours", lambda _: f.with_directions(_in_camera)),
    Fault("viewing directions from the world's origin", "colours", f.with_directions_from_the_origin),
    Fault("viewing directions from t in place of -R^T t", "colours", _from(lambda c: c.cam_from_world_t)),
    Fault("viewing directions from -t in place of -R^T t", "colours", _from(lambda c: -c.cam_from_world_t)),
    Fault(
        "viewing directions from R^T t in place of -R^T t",
        "colours",
        _from(lambda c: c.cam_from_world_R.T @ c.cam_from_world_t),
    ),
    Fault(
        "viewing directions from -R t in place of -R^T t",
        "colours",
        _from(lambda c: -c.cam_from_world_R @ c.cam_from_world_t),
    ),
    Fault("colours that are not clamped at 0", "colours", f.with_negative_colors),
    Fault("colours clamped at 1 as well", "colours", lambda _: f.with_colors(lambda c: np.minimum(c, 1))),
    Fault("a sigmoid of colours", "colours", lambda _: f.with_colors(lambda c: 1 / (1 + np.exp(-c)))),
    Fault("red and blue exchanged", "colours", lambda _: f.with_colors(lambda c: c[:, ::-1].copy())),
    Fault("colours times {}", "colours", lambda s: f.with_colors(lambda c: s * c), (0.5, 2.0), 1.0),
)
