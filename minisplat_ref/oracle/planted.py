"""Backends that are wrong in one formula, on purpose: they show that a check would find the error.

Most of these errors occurred in renderers that people use; the others are classic mistakes. Each wraps one stage of a
given backend, so that the same error can be planted in the reference and in the kernels. An error in a forward formula
is planted together with its own derivative: its gradients are consistent with its images, and only a comparison finds
it. An error in a gradient does not change the image: only a check of gradients finds it.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import SH_C2
from minisplat_ref.errors import InputError
from minisplat_ref.reference.covariance import rotation_matrices, rotation_matrices_vjp
from minisplat_ref.reference.projection import project_vjp as reference_project_vjp
from minisplat_ref.rendering.backends import CPU, Backend
from minisplat_ref.types import (
    Camera,
    CompositeGradient,
    Floats,
    PrimitiveGradient,
    Projection,
    SHGradient,
    TileBins,
)

Change = Callable[[Backend], Backend]
Stage = Any
"""A function of a backend; its arguments are those of its protocol in :mod:`minisplat_ref.rendering.stages`."""


class Planted(NamedTuple):
    """One deliberate error."""

    name: str
    """Unique."""
    stage: str
    """First quantity, in the order of the pipeline, that is wrong; those of gradients begin with ``v_``."""
    what: str
    """The error, one line."""
    plant: Change
    """Turns a correct backend into a wrong one."""

    @property
    def is_forward(self) -> bool:
        """Return whether images are wrong, rather than gradients."""
        return not self.stage.startswith("v_")


def plant(name: str, backend: Backend = CPU) -> Backend:
    """Return a backend with one error.

    Parameters
    ----------
    name : str
        Of one of :data:`PLANTED`.
    backend : Backend
        Where to plant it.

    Returns
    -------
    Backend
        Named after both.

    Raises
    ------
    InputError
        If there is no such error.
    """
    for error in PLANTED:
        if error.name == name:
            return replace(error.plant(backend), name=f"{backend.name}+{name}")
    raise InputError(f"planted error {name!r} is unknown; choose one of {', '.join(e.name for e in PLANTED)}")


def change_stages(base: Backend, **changes: Callable[..., Any]) -> Backend:
    """Return a backend in which some stages are changed.

    Parameters
    ----------
    base : Backend
        The one that is changed.
    **changes : callable
        By the name of a stage: ``change(stage, *args, **named)`` is computed in place of ``stage(*args, **named)``.
    """

    def wrap(stage: Stage, change: Callable[..., Any]) -> Stage:
        @wraps(stage)
        def changed(*args: Any, **named: Any) -> Any:
            return change(stage, *args, **named)

        return changed

    return replace(base, **{name: wrap(getattr(base, name), change) for name, change in changes.items()})


def change_camera(base: Backend, change: Callable[[Camera], Camera]) -> Backend:
    """Return a backend that projects by another camera."""

    def project(stage: Stage, *args: Any) -> Any:
        return stage(*args[:4], change(args[4]), *args[5:])

    return change_stages(base, project=project, project_vjp=project)


def _corner_pixels(base: Backend) -> Backend:
    return change_camera(base, lambda camera: camera._replace(cx=camera.cx - 0.5, cy=camera.cy - 0.5))


def _transposed_view(base: Backend) -> Backend:
    """With means R R mu and the rotation R^T, a point's camera coordinates are still R mu + t: only J R^T differs."""

    def turn(means: Floats, camera: Camera) -> tuple[Floats, Camera, Floats]:
        R = np.asarray(camera.cam_from_world_R, means.dtype)
        return means @ (R @ R).T, camera._replace(cam_from_world_R=R.T.copy()), R

    def project(stage: Stage, means: Floats, *args: Any) -> Projection:
        turned_means, turned_camera, _ = turn(means, args[3])
        return stage(turned_means, *args[:3], turned_camera, *args[4:])

    def project_vjp(stage: Stage, means: Floats, *args: Any) -> PrimitiveGradient:
        turned_means, turned_camera, R = turn(means, args[3])
        v = stage(turned_means, *args[:3], turned_camera, *args[4:])
        v_RR = v.means.T @ means
        v_R = v.cam_from_world_R.T + v_RR @ R.T + R.T @ v_RR
        return v._replace(means=v.means @ (R @ R), cam_from_world_R=v_R)

    return change_stages(base, project=project, project_vjp=project_vjp)


def _three_sigma(base: Backend) -> Backend:
    def project(stage: Stage, *args: Any) -> Projection:
        p, camera = stage(*args), args[4]
        a, b, c = np.where(p.radii[:, :1] > 0, p.conics, (1, 0, 1)).T  # [N]; rows that are culled stay so
        sigmas = np.sqrt(np.column_stack([c, a]) / (a * c - b * b)[:, None])
        radii = np.minimum(p.radii, np.ceil(3 * sigmas)).astype(np.int32)
        size = np.array([camera.width, camera.height])
        low, high = (np.clip(edge, 0, size) for edge in (np.floor(p.means2d - radii), np.ceil(p.means2d + radii)))
        boxes = np.where(radii[:, :1] > 0, np.hstack([low, high]), 0).astype(np.int32)
        return p._replace(radii=radii, boxes=boxes)

    return change_stages(base, project=project)


def _negated_band(base: Backend) -> Backend:
    def negate(sh_rest: Floats) -> Floats:
        flipped = sh_rest.copy()
        flipped[:, 4:5] *= -1  # Y_2-1, the second of degree 2, where there is one
        return flipped

    def sh_colors(stage: Stage, means: Floats, sh_dc: Floats, sh_rest: Floats, *rest: Any) -> Floats:
        return stage(means, sh_dc, negate(sh_rest), *rest)

    def sh_colors_vjp(stage: Stage, means: Floats, sh_dc: Floats, sh_rest: Floats, *rest: Any) -> SHGradient:
        v = stage(means, sh_dc, negate(sh_rest), *rest)
        return v._replace(sh_rest=negate(v.sh_rest))

    return change_stages(base, sh_colors=sh_colors, sh_colors_vjp=sh_colors_vjp)


def _unsorted_depth(base: Backend) -> Backend:
    def bin_gaussians(stage: Stage, projection: Projection, *rest: Any) -> TileBins:
        return stage(projection._replace(depths=np.roll(projection.depths, 1)), *rest)

    return change_stages(base, bin_gaussians=bin_gaussians)


def _blend_by(**changes: Any) -> Callable[..., Any]:
    """Return a change of a compositing stage: other conventions."""

    def blend(stage: Stage, *args: Any, **named: Any) -> Any:
        return stage(*args[:4], args[4]._replace(**changes), *args[5:], **named)

    return blend


def _clamp(alpha_max: float) -> Change:
    blend = _blend_by(alpha_max=alpha_max)
    return lambda base: change_stages(base, composite=blend, composite_vjp=blend)


def _unclamped_mean_gradient(base: Backend) -> Backend:
    return change_stages(base, composite_vjp=_blend_by(clamp_stops_mean_gradient=False))


def _half_off_diagonal(base: Backend) -> Backend:
    def composite_vjp(stage: Stage, *args: Any) -> CompositeGradient:
        v = stage(*args)
        return v._replace(conics=v.conics * np.array([1, 0.5, 1], v.conics.dtype))

    return change_stages(base, composite_vjp=composite_vjp)


def _forgotten_background(base: Backend) -> Backend:
    """dL/dT_end is ``v . background - v_alpha``, so this v_alpha takes the first term out."""

    def composite_vjp(stage: Stage, *args: Any) -> CompositeGradient:
        background, v_image, v_alpha = args[2], args[6], args[7]
        return stage(*args[:7], v_alpha + v_image @ background)

    return change_stages(base, composite_vjp=composite_vjp)


def _transposed_rs(base: Backend) -> Backend:
    """The reference's gradient with one function exchanged: v_M is passed on to M = diag(s) R, not to R diag(s)."""

    def covariances_vjp(quats: Floats, scales: Floats, v_covariances: Floats) -> tuple[Floats, Floats]:
        R, rows = rotation_matrices(quats), scales[:, :, None]
        v_M = (v_covariances + np.swapaxes(v_covariances, 1, 2)) @ (rows * R)
        return rotation_matrices_vjp(quats, rows * v_M), np.sum(R * v_M, axis=2)

    names = {**reference_project_vjp.__globals__, "covariances_vjp": covariances_vjp}
    changed = FunctionType(reference_project_vjp.__code__, names)

    def project_vjp(stage: Stage, means: Floats, *rest: Any) -> PrimitiveGradient:
        return PrimitiveGradient._make(field.astype(means.dtype) for field in changed(means, *rest))

    return change_stages(base, project_vjp=project_vjp)


def _change_project_vjp(change: Callable[[PrimitiveGradient, Floats], PrimitiveGradient]) -> Change:
    """Return an error of the gradient of the projection: ``change(v, quats)``."""

    def project_vjp(stage: Stage, *args: Any) -> PrimitiveGradient:
        return change(stage(*args), args[1])

    return lambda base: change_stages(base, project_vjp=project_vjp)


def _forgotten_depth(base: Backend) -> Backend:
    def project_vjp(stage: Stage, *args: Any) -> PrimitiveGradient:
        v_projection = args[7]
        return stage(*args[:7], v_projection._replace(depths=np.zeros_like(v_projection.depths)))

    return change_stages(base, project_vjp=project_vjp)


def _frozen_direction(base: Backend) -> Backend:
    def sh_colors_vjp(stage: Stage, *args: Any) -> SHGradient:
        v = stage(*args)
        return v._replace(means=np.zeros_like(v.means))

    return change_stages(base, sh_colors_vjp=sh_colors_vjp)


PLANTED = (
    Planted("corner-pixels", "means2d", "pixel centres taken at whole numbers, half a pixel off", _corner_pixels),
    Planted("transposed-view", "conics", "view rotation transposed in J R, right for the means", _transposed_view),
    Planted("three-sigma", "radii", "a Gaussian is cut at 3 sigma although its alpha is visible there", _three_sigma),
    Planted("sh-sign", "colors", f"Y_2-1 = +{SH_C2[0]:.4f} y z instead of minus", _negated_band),
    Planted("unsorted-depth", "tile lists", "sorted by the depth of the Gaussian before", _unsorted_depth),
    Planted("clamp-0.999", "T", "alpha is clamped at 0.999, whatever the profile says", _clamp(0.999)),
    Planted("mean-gradient-unclamped", "v_means2d", "clamped alpha hands its gradient on", _unclamped_mean_gradient),
    Planted("background-forgotten", "v_means2d", "what shines through from the background", _forgotten_background),
    Planted("half-off-diagonal", "v_conics", "v_b halved, although b already stands for both", _half_off_diagonal),
    Planted("transposed-rs", "v_quats", "S R instead of R S on the way back from the covariance", _transposed_rs),
    Planted(
        "unit-quats-assumed",
        "v_quats",
        "v_q not divided by |q|",
        _change_project_vjp(
            lambda v, quats: v._replace(
                quats=v.quats * np.linalg.norm(quats, axis=1, keepdims=True).astype(quats.dtype)
            )
        ),
    ),
    Planted(
        "transposed-pose",
        "v_R",
        "gradient of the view rotation transposed",
        _change_project_vjp(lambda v, q: v._replace(cam_from_world_R=v.cam_from_world_R.T.copy())),
    ),
    Planted("depth-forgotten", "v_means", "gradient of the depths not handed on to the means", _forgotten_depth),
    Planted("direction-frozen", "v_means", "colours do not move with the viewing direction", _frozen_direction),
)
"""In the order of the pipeline, forward before backward."""
