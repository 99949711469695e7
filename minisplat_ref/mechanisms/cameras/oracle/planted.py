"""Errors planted in ``rasterization`` with other cameras, each at one step, to see where a comparison finds it."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from minisplat_ref.mechanisms.cameras.gsplat_call import Steps
from minisplat_ref.mechanisms.cameras.models import CameraModel, model_of, ray_table, z_depths, z_depths_vjp
from minisplat_ref.mechanisms.cameras.oracle.profiles import exchange, in_front
from minisplat_ref.mechanisms.cameras.ray_footprints import FootprintGradient, LensFootprints
from minisplat_ref.oracle.call_comparison import PlantedInCall
from minisplat_ref.types import Camera, Floats, Primitives

Bend = Callable[[list[float], list[float]], tuple[list[float], list[float]]]


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


def _by_z(camera: Camera) -> CameraModel:
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


def _without(field: str) -> Callable[[Steps], Steps]:
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
    "z-for-distance": PlantedInCall("a fisheye ordered by the centres' z", "projection", exchange(model_of=_by_z)),
    "corner-rays": PlantedInCall("rays through the corners of pixels", "alpha", exchange(ray_table=_corner_rays)),
    "straight-rays": PlantedInCall("rays not bent by the lens", "alpha", exchange(ray_table=_bare_rays)),
    "one-sigma": PlantedInCall("bounds of one standard deviation", "alpha", _one_sigma),
    "frozen-shape": PlantedInCall("no gradient via the whitening", "gradients", _without("whitenings")),
    "frozen-position": PlantedInCall("no gradient via the position", "gradients", _without("positions")),
    "pose-of-means": PlantedInCall("the pose turns means, not axes", "gradients", _pose_of_means_alone),
}
"""The errors by name; those of lenses do not change parallel rays."""
