"""Changes of the steps of ``rasterization`` with other cameras: planted errors, and the rules of a version of gsplat.

Each error is at one step, to see where a comparison finds it. The rules are those by which gsplat 1.5 departs from ours
``with_ut`` and ``with_eval3d``. It culls Gaussians behind the plane of the camera and orders by the centres' z,
through a fisheye, too. It drops a Gaussian unless all of its seven sigma points lie in the image or a margin of a tenth
of its size around it, where ours takes the whole image for its bounds; so a large one disappears at the border. Within
its bounds it renders whole tiles of 16 pixels, which is visible since the bounds of an unscented transform are not
those of the response.
"""

import inspect
from collections.abc import Callable, Mapping
from types import FunctionType
from typing import Any

import numpy as np

from minisplat_ref.mechanisms.cameras import ray_footprints
from minisplat_ref.mechanisms.cameras.gsplat_call import Steps
from minisplat_ref.mechanisms.cameras.models import CameraModel, model_of, ray_table, z_depths, z_depths_vjp
from minisplat_ref.mechanisms.cameras.ray_footprints import FootprintGradient, LensFootprints
from minisplat_ref.mechanisms.cameras.unscented import sigma_points
from minisplat_ref.oracle.call_comparison import PlantedInCall
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.types import Bools, Camera, Floats, Primitives

MARGIN = 0.1  # of the image's width and height, in which sigma points may lie
TILE = 16  # pixels
Bend = Callable[[list[float], list[float]], tuple[list[float], list[float]]]


def exchange(**functions: Any) -> Callable[[Steps], Steps]:
    """Return a change that exchanges functions that the projection and its gradient call."""

    def plant(steps: Steps) -> Steps:
        names = {**vars(ray_footprints), **functions}
        correct = inspect.unwrap(ray_footprints.project), ray_footprints.project_vjp
        project, project_vjp = (FunctionType(step.__code__, names) for step in correct)
        return steps._replace(project=project, project_vjp=project_vjp)

    return plant


def in_front(camera: Camera) -> CameraModel:
    """See only points in front of the camera, through a fisheye too."""
    model = model_of(camera)
    return model._replace(is_seen=lambda x, camera: (x[:, 2] > 0) & model.is_seen(x, camera))


def _bent(change: Bend) -> Callable[[Steps], Steps]:
    """Return a fault that changes the radial and tangential coefficients of pinholes."""

    def plant(steps: Steps) -> Steps:
        def bend(camera: Camera, model: str, k: list[float], p: list[float]) -> Camera:
            return steps.bend(camera, model, *(change(k, p) if model == "pinhole" else (k, p)))

        return steps._replace(bend=bend)

    return plant


def _opencv_order(k: list[float], p: list[float]) -> tuple[list[float], list[float]]:
    """Read (k1, k2, p1, p2, k3, ...) as if it were (k1, k2, k3, ...)."""
    return [*k[:2], *p, *k[2:4]], k[4:]


def _unfolded(camera: Camera) -> CameraModel:
    model = model_of(camera)
    is_brown = camera.optics is not None and camera.optics.model == "brown"
    return model._replace(is_seen=lambda x, camera: x[:, 2] > 0) if is_brown else model


def _sort_z(camera: Camera) -> CameraModel:
    return model_of(camera)._replace(depths=z_depths, depths_vjp=z_depths_vjp)


def _corner_rays(camera: Camera) -> Floats:
    return ray_table(camera._replace(cx=camera.cx + 0.5, cy=camera.cy + 0.5))


def _bare_rays(camera: Camera) -> Floats:
    """Return the rays of the lens without distortion, while means are projected with it."""
    if camera.optics is None or camera.optics.model != "brown":
        return ray_table(camera)
    return ray_table(camera._replace(optics=None))


def _one_sigma(steps: Steps) -> Steps:
    """Bound by one standard deviation instead of three and a third."""

    def project(primitives: Primitives, camera: Camera, conventions: Any) -> LensFootprints:
        f = steps.project(primitives, camera, conventions)
        size = np.array([camera.width, camera.height])
        low, high = np.floor(f.means2d - f.radii / 3.33), np.ceil(f.means2d + f.radii / 3.33)
        boxes = np.hstack([np.clip(low, 0, size), np.clip(high, 0, size)]).astype(np.int32)
        return f._replace(boxes=np.where(f.radii[:, :1] > 0, boxes, 0))

    return steps._replace(project=project)


def _drop_gradient(field: str) -> Callable[[Steps], Steps]:
    """Return a fault that drops the gradient with respect to a field of the footprints."""

    def plant(steps: Steps) -> Steps:
        def project_vjp(primitives: Primitives, f: LensFootprints, v: FootprintGradient) -> Any:
            return steps.project_vjp(primitives, f, v._replace(**{field: 0 * getattr(v, field)}))

        return steps._replace(project_vjp=project_vjp)

    return plant


def _pose_of_means_alone(steps: Steps) -> Steps:
    def project_vjp(primitives: Primitives, f: LensFootprints, v: FootprintGradient) -> Any:
        gradient, v_means2d = steps.project_vjp(primitives, f, v)
        rigid, _ = steps.project_vjp(primitives, f, v._replace(whitenings=0 * v.whitenings))
        return gradient._replace(cam_from_world_R=rigid.cam_from_world_R), v_means2d

    return steps._replace(project_vjp=project_vjp)


PLANTED: Mapping[str, PlantedInCall] = {
    "swapped-tangential": PlantedInCall("p1 for p2, and p2 for p1", "projection", _bent(lambda k, p: (k, p[::-1]))),
    "opencv-order": PlantedInCall("tangential coefficients read as k3 and k4", "projection", _bent(_opencv_order)),
    "no-denominator": PlantedInCall("k4 to k6 left out", "projection", _bent(lambda k, p: ([*k[:3], 0, 0, 0], p))),
    "fold-not-culled": PlantedInCall("beyond the fold of a lens seen", "culling", exchange(model_of=_unfolded)),
    "half-space": PlantedInCall("beyond 90 degrees culled", "culling", exchange(model_of=in_front)),
    "z-for-distance": PlantedInCall("a fisheye ordered by the centres' z", "projection", exchange(model_of=_sort_z)),
    "corner-rays": PlantedInCall("rays through the corners of pixels", "alpha", exchange(ray_table=_corner_rays)),
    "straight-rays": PlantedInCall("rays not bent by the lens", "alpha", exchange(ray_table=_bare_rays)),
    "one-sigma": PlantedInCall("bounds of one standard deviation", "alpha", _one_sigma),
    "frozen-shape": PlantedInCall("no gradient via the whitening", "gradients", _drop_gradient("whitenings")),
    "frozen-position": PlantedInCall("no gradient via the position", "gradients", _drop_gradient("positions")),
    "pose-of-means": PlantedInCall("the pose turns means, not axes", "gradients", _pose_of_means_alone),
}
"""The errors by name; those of lenses do not change parallel rays."""


def _see_in_front_by_z(camera: Camera) -> CameraModel:
    return in_front(camera)._replace(depths=z_depths, depths_vjp=z_depths_vjp)


def has_all_points(primitives: Primitives, camera: Camera) -> Bools:
    """Return whether all sigma points of each Gaussian are seen, in the image or in the margin around it."""
    R, t = camera.cam_from_world_R, camera.cam_from_world_t
    axes = R @ rotation_matrices(primitives.quats) * primitives.scales[:, None, :]
    points = sigma_points(primitives.means @ R.T + t, axes)
    flat, model, size = points.reshape(-1, 3), in_front(camera), np.array([camera.width, camera.height])
    with np.errstate(all="ignore"):  # of points that are not seen
        pixels = model.project(flat, camera)
    is_inside = ((-MARGIN * size <= pixels) & (pixels < (1 + MARGIN) * size)).all(axis=1) & model.is_seen(flat, camera)
    return np.asarray(is_inside.reshape(points.shape[:2]).all(axis=1))


def gsplat_1_5(steps: Steps) -> Steps:
    """Return the steps of gsplat 1.5."""
    by_z = exchange(model_of=_see_in_front_by_z)(steps)

    def project(primitives: Primitives, camera: Camera, conventions: Any) -> LensFootprints:
        f = by_z.project(primitives, camera, conventions)
        is_kept = has_all_points(primitives, camera) & (f.radii > 0).all(axis=1)
        size = np.array([camera.width, camera.height])
        low, high = f.boxes[:, :2] // TILE * TILE, np.minimum(-(-f.boxes[:, 2:] // TILE) * TILE, size)
        f = f._replace(boxes=np.hstack([low, high]).astype(np.int32))

        def kept(rows: Any) -> Any:
            return np.where(is_kept.reshape(-1, *(1,) * (rows.ndim - 1)), rows, 0).astype(rows.dtype)

        return f._replace(
            positions=kept(f.positions),
            whitenings=kept(f.whitenings),
            opacities=kept(f.opacities),
            depths=kept(f.depths),
            means2d=kept(f.means2d),
            radii=kept(f.radii),
            boxes=kept(f.boxes),
        )

    return by_z._replace(project=project)


PROFILES: dict[str, Callable[[Steps], Steps]] = {"GSPLAT_1_5": gsplat_1_5}
"""The rules by the name of the profile."""
