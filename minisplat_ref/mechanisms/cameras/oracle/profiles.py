"""Rules by which a version of gsplat departs from ours ``with_ut`` and ``with_eval3d``, as changes of the steps.

gsplat 1.5 culls Gaussians behind the plane of the camera and orders by the centres' z, through a fisheye, too. It drops
a Gaussian unless all of its seven sigma points lie in the image or a margin of a tenth of its size around it, where
ours takes the whole image for its bounds; so a large one disappears at the border. Within its bounds it renders whole
tiles of 16 pixels, which is visible since the bounds of an unscented transform are not those of the response.
"""

import inspect
from collections.abc import Callable
from types import FunctionType
from typing import Any

import numpy as np

from minisplat_ref.mechanisms.cameras import ray_footprints
from minisplat_ref.mechanisms.cameras.gsplat_call import Steps
from minisplat_ref.mechanisms.cameras.models import CameraModel, model_of, z_depths, z_depths_vjp
from minisplat_ref.mechanisms.cameras.ray_footprints import LensFootprints
from minisplat_ref.mechanisms.cameras.unscented import sigma_points
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.types import Bools, Camera, Primitives

MARGIN = 0.1  # of the image's width and height, in which sigma points may lie
TILE = 16  # pixels


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


def _by_z_in_front(camera: Camera) -> CameraModel:
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
    by_z = exchange(model_of=_by_z_in_front)(steps)

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
