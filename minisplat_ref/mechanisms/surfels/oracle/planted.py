"""Errors planted in ``rasterization_2dgs``, each at one step of the call, to see where a comparison finds it."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from minisplat_ref.mechanisms.surfels.gsplat_call import Steps
from minisplat_ref.mechanisms.surfels.projection import Surfels
from minisplat_ref.mechanisms.surfels.ray_measures import RayMeasures
from minisplat_ref.mechanisms.surfels.renderer import Shown
from minisplat_ref.oracle.call_comparison import PlantedInCall
from minisplat_ref.types import Floats, RenderOutput


def _projected(change: Callable[..., Surfels]) -> Callable[[Steps], Steps]:
    """Return a fault that changes the result of the projection; ``change(surfels, primitives, camera)``."""

    def plant(steps: Steps) -> Steps:
        def project(primitives: Any, camera: Any, *rest: Any) -> Surfels:
            return change(steps.project(primitives, camera, *rest), primitives, camera)

        return steps._replace(project=project)

    return plant


def _shown(change: Callable[[Shown], Shown]) -> Callable[[Steps], Steps]:
    """Return a fault that changes the surfels that are blended, in the forward and in the backward pass."""

    def plant(steps: Steps) -> Steps:
        return steps._replace(
            blend=lambda shown: steps.blend(change(shown)),
            blend_vjp=lambda shown, *rest: steps.blend_vjp(change(shown), *rest),
            measure=lambda shown: steps.measure(change(shown)),
            measure_vjp=lambda shown, *rest: steps.measure_vjp(change(shown), *rest),
        )

    return plant


def _measured(change: Callable[[RayMeasures], RayMeasures]) -> Callable[[Steps], Steps]:
    return lambda steps: steps._replace(measure=lambda shown: change(steps.measure(shown)))


def _projected_centers(surfels: Surfels, primitives: Any, camera: Any) -> Surfels:
    T, is_seen = surfels.transforms, surfels.radii[:, :1] > 0
    return surfels._replace(means2d=np.where(is_seen, T[:, :2, 2] / np.where(is_seen, T[:, 2:, 2], 1), 0))


def _three_sigma(surfels: Surfels, primitives: Any, camera: Any) -> Surfels:
    return surfels._replace(radii=np.ceil(surfels.radii * (3 / 3.33)).astype(np.int32))


def _drop_principal_point(surfels: Surfels, primitives: Any, camera: Any) -> Surfels:
    T = surfels.transforms.copy()
    T[:, 0] -= camera.cx * T[:, 2]
    return surfels._replace(transforms=T)


def _unturned(surfels: Surfels, primitives: Any, camera: Any) -> Surfels:
    return surfels._replace(normals=np.where(surfels.transforms[:, :1, 0] > 0, surfels.normals, -surfels.normals))


def _clamp_sooner(shown: Shown) -> Shown:
    return shown._replace(conventions=shown.conventions._replace(alpha_max=0.99))


def _moved_low_pass(shown: Shown) -> Shown:
    surfels = shown.surfels
    return shown._replace(surfels=surfels._replace(means2d=surfels.means2d + 0.3 * (surfels.radii > 0)))


def _blended(change: Callable[[RenderOutput], RenderOutput]) -> Callable[[Steps], Steps]:
    return lambda steps: steps._replace(blend=lambda shown: change(steps.blend(shown)))


def _scaled_normals(output: RenderOutput) -> RenderOutput:
    image = output.image.copy()
    image[..., -3:] /= np.maximum(np.linalg.norm(image[..., -3:], axis=2, keepdims=True), 1e-12)
    return output._replace(image=image)


def _no_low_pass_gradient(steps: Steps) -> Steps:
    def project_vjp(primitives: Any, camera: Any, conventions: Any, surfels: Surfels, v: Any) -> Any:
        return steps.project_vjp(primitives, camera, conventions, surfels, v._replace(means2d=0 * v.means2d))

    return steps._replace(project_vjp=project_vjp)


def _no_distortion_gradient(steps: Steps) -> Steps:
    return steps._replace(
        measure_vjp=lambda shown, measures, v_median, v_distortion: steps.measure_vjp(
            shown, measures, v_median, 0 * v_distortion
        )
    )


def _no_median_gradient(steps: Steps) -> Steps:
    return steps._replace(
        measure_vjp=lambda shown, measures, v_median, v_distortion: steps.measure_vjp(
            shown, measures, 0 * v_median, v_distortion
        )
    )


def _forward_differences(depth: Floats, camera: Any) -> Floats:
    """Return normals from the right and the lower neighbour instead of both sides."""
    from minisplat_ref.reference.pinhole import pinhole_rays

    height, width = depth.shape
    X = depth[:, :, None] * pinhole_rays(np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5, camera)
    N = np.cross(X[1:, :-1] - X[:-1, :-1], X[:-1, 1:] - X[:-1, :-1])
    normals = np.zeros((*depth.shape, 3), depth.dtype)
    normals[1:-1, 1:-1] = (N / np.maximum(np.linalg.norm(N, axis=2, keepdims=True), 1e-12))[1:, 1:]
    return normals


PLANTED: Mapping[str, PlantedInCall] = {
    "projected-center": PlantedInCall("low-pass at the projected centre", "projection", _projected(_projected_centers)),
    "three-sigma": PlantedInCall("radii of 3 standard deviations", "projection", _projected(_three_sigma)),
    "no-principal-point": PlantedInCall("rays without c_x", "projection", _projected(_drop_principal_point)),
    "unturned-normals": PlantedInCall("normals not turned to the camera", "projection", _projected(_unturned)),
    "moved-low-pass": PlantedInCall("low-pass 0.3 px off", "alpha", _shown(_moved_low_pass)),
    "clamp-0.99": PlantedInCall("alpha clamped at 0.99", "alpha", _shown(_clamp_sooner)),
    "depth-not-divided": PlantedInCall(
        "accumulated depth for the expected one",
        "colours and expected depth",
        lambda steps: steps._replace(expect=lambda sums, alpha: sums),
    ),
    "unit-normals": PlantedInCall("blended normals of length one", "normals", _blended(_scaled_normals)),
    "mean-for-median": PlantedInCall(
        "mean depth for the median",
        "median depth",
        _measured(lambda m: m._replace(median=m.depth_sums / np.maximum(m.alpha, 1e-12))),
    ),
    "half-distortion": PlantedInCall(
        "distortion over pairs i < j", "distortion", _measured(lambda m: m._replace(distortion=m.distortion / 2))
    ),
    "forward-differences": PlantedInCall(
        "surface normals by forward differences",
        "surface normals",
        lambda steps: steps._replace(normals_of=_forward_differences),
    ),
    "no-low-pass-gradient": PlantedInCall("no gradient via the low-pass", "gradients", _no_low_pass_gradient),
    "no-distortion-gradient": PlantedInCall("no gradient of the distortion", "gradients", _no_distortion_gradient),
    "no-median-gradient": PlantedInCall("no gradient of the median depth", "gradients", _no_median_gradient),
}
"""The errors by name."""
