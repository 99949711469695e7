"""The cameras: the effect of a :class:`~minisplat_ref.types.Camera`'s optics on points, pixels and the order.

All functions are of the camera's frame (OpenCV axes) and in float64. A model never sees the pose, so a renderer
differentiates with respect to it by the chain rule through ``x = R mu + t`` alone.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.cameras.distortion import BROWN, FISHEYE, LensFunctions
from minisplat_ref.types import Bools, Camera, Floats, Optics

PADDING = 7  # copies of a line's last ray in a table, so that eight can be read from any pixel on


class CameraModel(NamedTuple):
    """A camera's functions."""

    project: Callable[[Floats, Camera], Floats]
    """``project(x, camera)``: pixels [N, 2] of points [N, 3]; meaningless where not seen."""
    jacobians: Callable[[Floats, Camera], Floats]
    """``jacobians(x, camera)``: derivatives [N, 2, 3] of the pixels."""
    is_seen: Callable[[Floats, Camera], Bools]
    """``is_seen(x, camera)``: whether points have a place in the image plane, inside of the image or not."""
    rays: Callable[[Floats, Camera], tuple[Floats, Floats]]
    """``rays(pixels, camera)``: origins [P, 3] and unit directions [P, 3] through pixels [P, 2]; NaN where none is."""
    depths: Callable[[Floats], Floats]
    """``depths(x)``: [N] the depth that orders points and is bounded by the near and far planes, world units."""
    depths_vjp: Callable[[Floats, Floats], Floats]
    """``depths_vjp(x, v)``: the gradient [N, 3]."""


def project_vjp(model: CameraModel, x: Floats, camera: Camera, v_pixels: Floats) -> Floats:
    """Gradient of ``model.project``: ``v_x = J^T v_p``, [N, 3]."""
    return np.einsum("nki,nk->ni", model.jacobians(x, camera), v_pixels)


def z_depths(x: Floats) -> Floats:
    """Return the camera z of points [N, 3]."""
    return x[:, 2]


def z_depths_vjp(x: Floats, v: Floats) -> Floats:
    """Gradient of :func:`z_depths`: ``(0, 0, v)``."""
    return np.column_stack([np.zeros((len(v), 2)), v])


def distances(x: Floats) -> Floats:
    """Return the distances of points [N, 3] from the camera, which order beyond 90 degrees from the axis too."""
    distance: Floats = np.linalg.norm(x, axis=1)
    return distance


def distances_vjp(x: Floats, v: Floats) -> Floats:
    """Gradient of :func:`distances`: ``v x / |x|``."""
    gradient: Floats = x * (v / distances(x))[:, None]
    return gradient


def _focal(camera: Camera) -> Floats:
    return np.array([camera.fx, camera.fy])


def _center(camera: Camera) -> Floats:
    return np.array([camera.cx, camera.cy])


def _coefficients(camera: Camera) -> tuple[float, ...]:
    assert camera.optics is not None
    return camera.optics.coefficients


def _make_lens_model(lens: LensFunctions, depths: Callable, depths_vjp: Callable) -> CameraModel:
    """Return the camera whose image is that of a lens, times the focal lengths, about the principal point."""

    def project(x: Floats, camera: Camera) -> Floats:
        return lens.bend(x, _coefficients(camera)) * _focal(camera) + _center(camera)

    def jacobians(x: Floats, camera: Camera) -> Floats:
        return lens.jacobians(x, _coefficients(camera)) * _focal(camera)[:, None]

    def is_seen(x: Floats, camera: Camera) -> Bools:
        return lens.is_seen(x, _coefficients(camera))

    def rays(pixels: Floats, camera: Camera) -> tuple[Floats, Floats]:
        directions = lens.unbend((pixels - _center(camera)) / _focal(camera), _coefficients(camera))
        return np.zeros_like(directions), directions

    return CameraModel(project, jacobians, is_seen, rays, depths, depths_vjp)


def _project_perspective(x: Floats, camera: Camera) -> Floats:
    return x[:, :2] / x[:, 2:] * _focal(camera) + _center(camera)


def _perspective_jacobians(x: Floats, camera: Camera) -> Floats:
    """Return ``f_k (e_k - (x_k / z) e_z) / z``."""
    eye = np.broadcast_to(np.eye(2), (len(x), 2, 2))
    slopes = x[:, :2] / x[:, 2:]
    by_slopes = np.concatenate([eye, -slopes[:, :, None]], axis=2) / x[:, 2, None, None]
    return by_slopes * _focal(camera)[:, None]


def _perspective_rays(pixels: Floats, camera: Camera) -> tuple[Floats, Floats]:
    slopes = (pixels - _center(camera)) / _focal(camera)
    directions = np.column_stack([slopes, np.ones(len(slopes))])
    return np.zeros_like(directions), directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _project_orthographic(x: Floats, camera: Camera) -> Floats:
    return x[:, :2] * _focal(camera) + _center(camera)


def _orthographic_jacobians(x: Floats, camera: Camera) -> Floats:
    J = np.zeros((len(x), 2, 3))
    J[:, 0, 0], J[:, 1, 1] = camera.fx, camera.fy
    return J


def _orthographic_rays(pixels: Floats, camera: Camera) -> tuple[Floats, Floats]:
    origins = np.column_stack([(pixels - _center(camera)) / _focal(camera), np.zeros(len(pixels))])
    return origins, np.broadcast_to([0.0, 0.0, 1.0], origins.shape)


def pixels_per_unit(camera: Camera) -> Floats:
    """Return the derivatives [2, 2] of the pixels of ``affine`` optics with respect to the camera's x and y."""
    shear = _coefficients(camera)[0]
    return np.array([[camera.fx, 0.0], [camera.fy * shear, camera.fy]])


def _project_affine(x: Floats, camera: Camera) -> Floats:
    return x[:, :2] @ pixels_per_unit(camera).T + _center(camera)


def _affine_jacobians(x: Floats, camera: Camera) -> Floats:
    J = np.zeros((len(x), 2, 3))
    J[:, :, :2] = pixels_per_unit(camera)
    return J


def _affine_rays(pixels: Floats, camera: Camera) -> tuple[Floats, Floats]:
    places = (pixels - _center(camera)) @ np.linalg.inv(pixels_per_unit(camera)).T
    origins = np.column_stack([places, np.zeros(len(pixels))])
    return origins, np.broadcast_to([0.0, 0.0, 1.0], origins.shape)


PERSPECTIVE = CameraModel(
    _project_perspective,
    _perspective_jacobians,
    lambda x, camera: x[:, 2] > 0,
    _perspective_rays,
    z_depths,
    z_depths_vjp,
)
ORTHOGRAPHIC = CameraModel(
    _project_orthographic,
    _orthographic_jacobians,
    lambda x, camera: np.ones(len(x), bool),
    _orthographic_rays,
    z_depths,
    z_depths_vjp,
)
"""Focal lengths are pixels per world unit."""
AFFINE = ORTHOGRAPHIC._replace(project=_project_affine, jacobians=_affine_jacobians, rays=_affine_rays)
"""Likewise, with a shear; the order by altitude of :mod:`.affine` is not that of its depths, the camera z."""
MODELS = {
    "brown": _make_lens_model(BROWN, z_depths, z_depths_vjp),
    "fisheye": _make_lens_model(FISHEYE, distances, distances_vjp),
    "orthographic": ORTHOGRAPHIC,
    "affine": AFFINE,
}
"""By :attr:`Optics.model`; a camera without optics is ``PERSPECTIVE``."""


def model_of(camera: Camera) -> CameraModel:
    """Return the functions of a camera.

    Raises
    ------
    InputError
        Its optics are not known.
    """
    if camera.optics is None:
        return PERSPECTIVE
    if camera.optics.model not in MODELS:
        raise InputError(f"optics {camera.optics.model!r} are not known: choose from {', '.join(MODELS)}")
    return MODELS[camera.optics.model]


def are_inside(points: Floats, camera: Camera) -> Bools:
    """Return for each point [P, 3] of the world whether it is inside the image of a camera with any optics, [P].

    Raises
    ------
    InputError
        As :func:`model_of`.
    """
    model = model_of(camera)
    x = points @ camera.cam_from_world_R.T + camera.cam_from_world_t
    rows = np.flatnonzero(model.is_seen(x, camera))
    u, v = model.project(x[rows], camera).T
    inside = np.zeros(len(points), bool)
    inside[rows] = (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height)
    return inside


def ray_table(camera: Camera) -> Floats:
    """Return the unit directions of all pixels' rays as a table for kernels, float64 and read-only.

    Parameters
    ----------
    camera : Camera
        Of which all rays begin at its centre.

    Returns
    -------
    ndarray of shape (3 H, W + PADDING)
        Camera frame; component k of line y is row ``3 y + k``, whose last ray is repeated ``PADDING`` times.

    Raises
    ------
    InputError
        A pixel has no ray, because the lens folds inside the image.
    """
    return _ray_table(*(float(value) for value in camera[2:6]), camera.width, camera.height, camera.optics)


@functools.lru_cache(maxsize=8)
def _ray_table(fx: float, fy: float, cx: float, cy: float, width: int, height: int, optics: Optics | None) -> Floats:
    camera = Camera(np.eye(3), np.zeros(3), fx, fy, cx, cy, width, height, optics)
    table = np.empty((height, 3, width + PADDING))
    xs = np.arange(width) + 0.5
    model = model_of(camera)
    for y in range(height):  # line by line, so that the inverse needs little memory
        _, directions = model.rays(np.column_stack([xs, np.full(width, y + 0.5)]), camera)
        table[y, :, :width] = directions.T
    table[:, :, width:] = table[:, :, width - 1 : width]
    missing = np.argwhere(np.isnan(table[:, 0, :width]))
    if len(missing):
        y, x = missing[0]
        raise InputError(
            f"the lens {_describe(optics)} folds inside the image: no ray reaches pixel ({x}, {y}), nor"
            f" {len(missing) - 1} others of {width * height}; calibrate it with another model, or undistort the scene"
        )
    table.flags.writeable = False
    return table.reshape(3 * height, width + PADDING)


def check_optics(camera: Camera) -> None:
    """Refuse a camera whose lens folds inside its image: the rays of a frame of pixels are tried, and of a grid.

    Raises
    ------
    InputError
        Names the first pixel without a ray.
    """
    if camera.optics is None:
        return
    xs = np.unique(np.linspace(0, camera.width - 1, 33).round()) + 0.5
    ys = np.unique(np.linspace(0, camera.height - 1, 33).round()) + 0.5
    pixels = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    _, directions = model_of(camera).rays(pixels, camera)
    wrong = np.flatnonzero(np.isnan(directions).any(axis=1))
    if len(wrong):
        x, y = pixels[wrong[0]]
        raise InputError(
            f"the lens {_describe(camera.optics)} folds inside the image: no ray reaches pixel ({x:.0f}, {y:.0f});"
            " calibrate it with another model, or undistort the scene"
        )


def _describe(optics: Optics | None) -> str:
    assert optics is not None
    return f"{optics.model} with {', '.join(f'{value:g}' for value in optics.coefficients)}"
