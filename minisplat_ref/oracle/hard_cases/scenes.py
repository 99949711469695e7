"""Building blocks of the catalogue's scenes: Gaussians, cameras and matrices with numbers that float32 holds."""

from typing import Any

import numpy as np

from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.oracle.hard_cases.subjects import Call, Parameters
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.types import Camera, Floats, Gaussians

ANTIALIASED = GSPLAT_MAIN._replace(name="ANTIALIASED", is_antialiased=True)
BACKGROUND = np.array([[0.25, 0.5, 0.75]])


def round_to_float32(values: Any) -> Floats:
    """Return float64 numbers that float32 holds too."""
    with np.errstate(over="ignore"):
        return np.asarray(values, np.float64).astype(np.float32).astype(np.float64)


def camera(width: int = 24, height: int = 18, **changes: Any) -> Camera:
    """Return a camera at the origin that looks along +z, half a field of view of 22 degrees."""
    plain = Camera(np.eye(3), np.zeros(3), 30.0, 28.0, width / 2, height / 2, width, height)
    return plain._replace(**changes)


def gaussians(means: Any, scales: Any = 0.2, *, quats: Any = None, logits: Any = 1.0, sh_rest: Any = None) -> Gaussians:
    """Return Gaussians at ``means`` [N, 3]; the other values may be one for all. Random rotations and colours."""
    means = round_to_float32(means)
    n, rng = len(means), np.random.default_rng(7)
    quaternions, colors = rng.normal(size=(n, 4)), rng.normal(size=(n, 3))
    return Gaussians(
        means=means,
        quats=round_to_float32(np.broadcast_to(quaternions if quats is None else quats, (n, 4))),
        log_scales=round_to_float32(np.log(np.broadcast_to(scales, (n, 3)))),
        opacity_logits=round_to_float32(np.broadcast_to(logits, n)),
        sh_dc=round_to_float32(colors),
        sh_rest=np.zeros((n, 0, 3)) if sh_rest is None else round_to_float32(sh_rest),
    )


def cloud(n: int = 30, *, sh_degree: int = 0, scales: Any = (0.25, 0.15, 0.08), **changes: Any) -> Gaussians:
    """Return Gaussians all over the view of :func:`camera`, 2 to 4 units away."""
    rng = np.random.default_rng(3)
    z = rng.uniform(2, 4, size=n)
    rest = 0.3 * rng.normal(size=(n, (sh_degree + 1) ** 2 - 1, 3))
    means = np.column_stack([rng.uniform(-0.35, 0.35, size=(n, 2)) * z[:, None], z])
    return gaussians(means, scales, logits=rng.normal(size=n), sh_rest=rest)._replace(**changes)


def rotation_quat(angle: float, axis: tuple[float, float, float] = (0, 0, 1)) -> Floats:
    """Return the quaternion of a rotation by an angle in radians about an axis."""
    unit = np.asarray(axis, float) / np.linalg.norm(axis)
    return np.append(np.cos(angle / 2), np.sin(angle / 2) * unit)


def needle(scales: tuple[float, float, float], quat: Any, **changes: Any) -> Parameters:
    """Return one Gaussian 4 units away, a little beside the axis, in an image of 160 x 160 pixels."""
    population = gaussians([[0.013, 0.007, 4]], [scales], quats=quat, logits=3.0)
    return Parameters(population, camera(160, 160, fx=120.0, fy=120.0), **changes)


def move_world(offset: Any, n: int = 30, scale: float = 1.0, **changes: Any) -> Parameters:
    """Return the cloud and a rotated camera, both displaced by ``offset`` and scaled, as a georeferenced scene is."""
    R = rotation_matrices(rotation_quat(0.7, (1, 2, 3))[None])[0]
    centre = np.broadcast_to(offset, 3) + scale * np.array([0.317, -0.143, 0.059])  # no float32 far from the origin
    population = cloud(n)
    means = round_to_float32(scale * population.means @ R + centre)  # the camera's frame is R (x - centre)
    log_scales = round_to_float32(population.log_scales + np.log(scale))
    view = camera(cam_from_world_R=R, cam_from_world_t=-R @ centre)
    return Parameters(population._replace(means=means, log_scales=log_scales), view, **changes)


def call(
    means: Any, scales: Any = 0.2, opacities: Any = 0.75, *, size: tuple[int, int] = (9, 9), **options: Any
) -> Call:
    """Return activated Gaussians at ``means`` [N, 3] whose axes are the camera's; (0, 0, z) falls on a pixel's centre.

    Arguments named like an array of ``rasterization`` replace that array; the rest are options.
    """
    n, (width, height) = len(means), size
    arrays = {
        "means": round_to_float32(means),
        "quats": np.tile([1.0, 0, 0, 0], (n, 1)),
        "scales": round_to_float32(np.broadcast_to(scales, (n, 3))),
        "opacities": round_to_float32(np.broadcast_to(opacities, n)),
        "colors": round_to_float32(np.random.default_rng(5).uniform(size=(n, 3))),
        "viewmats": np.eye(4)[None],
        "Ks": intrinsics(30, 30, width / 2, height / 2),
    }
    arrays.update({key: round_to_float32(options.pop(key)) for key in list(options) if key in arrays})
    return Call(arrays, width, height, {"backgrounds": BACKGROUND, **options})


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Floats:
    """Return K [1, 3, 3]."""
    return np.array([[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]], float)
