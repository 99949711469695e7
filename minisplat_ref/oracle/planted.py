"""Would an error be found? Backends that are wrong in one formula, on purpose.

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

from minisplat_ref.constants import SH_C2, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.reference.covariance import rotation_matrices, rotation_matrices_vjp
from minisplat_ref.reference.projection import project_vjp as reference_project_vjp
from minisplat_ref.rendering.backends import CPU, Backend
from minisplat_ref.rendering.stages import CompositeVjp
from minisplat_ref.types import (
    Camera,
    CompositeGradient,
    Floats,
    Ints,
    PrimitiveGradient,
    Projection,
    ProjectionGradient,
    RenderOutput,
    SHGradient,
    TileBins,
    TileGrid,
)

Change = Callable[[Backend], Backend]


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


def _corner_pixels(base: Backend) -> Backend:
    @wraps(base.project)
    def project(
        means: Floats, quats: Floats, scales: Floats, opacities: Floats, camera: Camera, conventions: Conventions
    ) -> Projection:
        return base.project(means, quats, scales, opacities, _shift(camera), conventions)

    @wraps(base.project_vjp)
    def project_vjp(
        means: Floats, quats: Floats, scales: Floats, opacities: Floats, camera: Camera, *rest: Any, **named: Any
    ) -> PrimitiveGradient:
        return base.project_vjp(means, quats, scales, opacities, _shift(camera), *rest, **named)

    return replace(base, project=project, project_vjp=project_vjp)


def _shift(camera: Camera) -> Camera:
    return camera._replace(cx=camera.cx - 0.5, cy=camera.cy - 0.5)


def _transposed_view(base: Backend) -> Backend:
    """With means R R mu and the rotation R^T, a point's camera coordinates are still R mu + t: only J R^T differs."""

    def turned(means: Floats, camera: Camera) -> tuple[Floats, Camera, Floats]:
        R = np.asarray(camera.cam_from_world_R, means.dtype)
        return means @ (R @ R).T, camera._replace(cam_from_world_R=R.T.copy()), R

    @wraps(base.project)
    def project(
        means: Floats, quats: Floats, scales: Floats, opacities: Floats, camera: Camera, conventions: Conventions
    ) -> Projection:
        turned_means, turned_camera, _ = turned(means, camera)
        return base.project(turned_means, quats, scales, opacities, turned_camera, conventions)

    @wraps(base.project_vjp)
    def project_vjp(
        means: Floats, quats: Floats, scales: Floats, opacities: Floats, camera: Camera, *rest: Any, **named: Any
    ) -> PrimitiveGradient:
        turned_means, turned_camera, R = turned(means, camera)
        v = base.project_vjp(turned_means, quats, scales, opacities, turned_camera, *rest, **named)
        v_RR = v.means.T @ means
        v_R = v.cam_from_world_R.T + v_RR @ R.T + R.T @ v_RR
        return v._replace(means=v.means @ (R @ R), cam_from_world_R=v_R)

    return replace(base, project=project, project_vjp=project_vjp)


def _three_sigma(base: Backend) -> Backend:
    @wraps(base.project)
    def project(
        means: Floats, quats: Floats, scales: Floats, opacities: Floats, camera: Camera, conventions: Conventions
    ) -> Projection:
        p = base.project(means, quats, scales, opacities, camera, conventions)
        a, b, c = np.where(p.radii[:, :1] > 0, p.conics, (1, 0, 1)).T  # [N]; rows that are culled stay so
        sigmas = np.sqrt(np.column_stack([c, a]) / (a * c - b * b)[:, None])
        radii = np.minimum(p.radii, np.ceil(3 * sigmas)).astype(np.int32)
        size = np.array([camera.width, camera.height])
        low, high = (np.clip(edge, 0, size) for edge in (np.floor(p.means2d - radii), np.ceil(p.means2d + radii)))
        boxes = np.where(radii[:, :1] > 0, np.hstack([low, high]), 0).astype(np.int32)
        return p._replace(radii=radii, boxes=boxes)

    return replace(base, project=project)


def _negated_band(base: Backend) -> Backend:
    def negated(sh_rest: Floats) -> Floats:
        flipped = sh_rest.copy()
        flipped[:, 4:5] *= -1  # Y_2-1, the second of degree 2, where there is one
        return flipped

    @wraps(base.sh_colors)
    def sh_colors(means: Floats, sh_dc: Floats, sh_rest: Floats, *rest: Any, **named: Any) -> Floats:
        return base.sh_colors(means, sh_dc, negated(sh_rest), *rest, **named)

    @wraps(base.sh_colors_vjp)
    def sh_colors_vjp(means: Floats, sh_dc: Floats, sh_rest: Floats, *rest: Any, **named: Any) -> SHGradient:
        v = base.sh_colors_vjp(means, sh_dc, negated(sh_rest), *rest, **named)
        return v._replace(sh_rest=negated(v.sh_rest))

    return replace(base, sh_colors=sh_colors, sh_colors_vjp=sh_colors_vjp)


def _unsorted_depth(base: Backend) -> Backend:
    @wraps(base.bin_gaussians)
    def bin_gaussians(projection: Projection, grid: TileGrid, conventions: Conventions) -> TileBins:
        keys = np.roll(projection.depths, 1)
        return base.bin_gaussians(projection._replace(depths=keys), grid, conventions)

    return replace(base, bin_gaussians=bin_gaussians)


def _clamp(alpha_max: float) -> Change:
    def plant(base: Backend) -> Backend:
        @wraps(base.composite)
        def composite(
            projection: Projection,
            colors: Floats,
            background: Floats,
            bins: TileBins,
            conventions: Conventions,
            **asked: bool,
        ) -> RenderOutput:
            conventions = conventions._replace(alpha_max=alpha_max)
            return base.composite(projection, colors, background, bins, conventions, **asked)

        return replace(base, composite=composite, composite_vjp=_with_conventions(base, alpha_max=alpha_max))

    return plant


def _with_conventions(base: Backend, **changes: Any) -> CompositeVjp:
    @wraps(base.composite_vjp)
    def composite_vjp(
        projection: Projection,
        colors: Floats,
        background: Floats,
        bins: TileBins,
        conventions: Conventions,
        *rest: Any,
        **named: Any,
    ) -> CompositeGradient:
        conventions = conventions._replace(**changes)
        return base.composite_vjp(projection, colors, background, bins, conventions, *rest, **named)

    return composite_vjp


def _unclamped_mean_gradient(base: Backend) -> Backend:
    return replace(base, composite_vjp=_with_conventions(base, clamp_stops_mean_gradient=False))


def _half_off_diagonal(base: Backend) -> Backend:
    @wraps(base.composite_vjp)
    def composite_vjp(*args: Any, **named: Any) -> CompositeGradient:
        v = base.composite_vjp(*args, **named)
        return v._replace(conics=v.conics * np.array([1, 0.5, 1], v.conics.dtype))

    return replace(base, composite_vjp=composite_vjp)


def _forgotten_background(base: Backend) -> Backend:
    """dL/dT_end is ``v . background - v_alpha``, so this v_alpha takes the first term out."""

    @wraps(base.composite_vjp)
    def composite_vjp(
        projection: Projection,
        colors: Floats,
        background: Floats,
        bins: TileBins,
        conventions: Conventions,
        output: RenderOutput,
        v_image: Floats,
        v_alpha: Floats,
    ) -> CompositeGradient:
        v_alpha = v_alpha + v_image @ background
        return base.composite_vjp(projection, colors, background, bins, conventions, output, v_image, v_alpha)

    return replace(base, composite_vjp=composite_vjp)


def _transposed_rs(base: Backend) -> Backend:
    """The reference's gradient with one function exchanged: v_M is passed on to M = diag(s) R, not to R diag(s)."""

    def covariances_vjp(quats: Floats, scales: Floats, v_covariances: Floats) -> tuple[Floats, Floats]:
        R, rows = rotation_matrices(quats), scales[:, :, None]
        v_M = (v_covariances + np.swapaxes(v_covariances, 1, 2)) @ (rows * R)
        return rotation_matrices_vjp(quats, rows * v_M), np.sum(R * v_M, axis=2)

    names = {**reference_project_vjp.__globals__, "covariances_vjp": covariances_vjp}
    changed = FunctionType(reference_project_vjp.__code__, names)

    @wraps(base.project_vjp)
    def project_vjp(means: Floats, *rest: Any, **named: Any) -> PrimitiveGradient:
        return PrimitiveGradient._make(field.astype(means.dtype) for field in changed(means, *rest, **named))

    return replace(base, project_vjp=project_vjp)


def _changed_project_vjp(change: Callable[[PrimitiveGradient, Floats], PrimitiveGradient]) -> Change:
    def plant(base: Backend) -> Backend:
        @wraps(base.project_vjp)
        def project_vjp(means: Floats, quats: Floats, *rest: Any, **named: Any) -> PrimitiveGradient:
            return change(base.project_vjp(means, quats, *rest, **named), quats)

        return replace(base, project_vjp=project_vjp)

    return plant


def _forgotten_depth(base: Backend) -> Backend:
    @wraps(base.project_vjp)
    def project_vjp(
        means: Floats,
        quats: Floats,
        scales: Floats,
        opacities: Floats,
        camera: Camera,
        conventions: Conventions,
        projection: Projection,
        v_projection: ProjectionGradient,
    ) -> PrimitiveGradient:
        v_projection = v_projection._replace(depths=np.zeros_like(v_projection.depths))
        return base.project_vjp(means, quats, scales, opacities, camera, conventions, projection, v_projection)

    return replace(base, project_vjp=project_vjp)


def _frozen_direction(base: Backend) -> Backend:
    @wraps(base.sh_colors_vjp)
    def sh_colors_vjp(
        means: Floats, sh_dc: Floats, sh_rest: Floats, camera: Camera, degree: int | Ints, radii: Ints, v_colors: Floats
    ) -> SHGradient:
        v = base.sh_colors_vjp(means, sh_dc, sh_rest, camera, degree, radii, v_colors)
        return v._replace(means=np.zeros_like(v.means))

    return replace(base, sh_colors_vjp=sh_colors_vjp)


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
        _changed_project_vjp(
            lambda v, quats: v._replace(
                quats=v.quats * np.linalg.norm(quats, axis=1, keepdims=True).astype(quats.dtype)
            )
        ),
    ),
    Planted(
        "transposed-pose",
        "v_R",
        "gradient of the view rotation transposed",
        _changed_project_vjp(lambda v, q: v._replace(cam_from_world_R=v.cam_from_world_R.T.copy())),
    ),
    Planted("depth-forgotten", "v_means", "gradient of the depths not handed on to the means", _forgotten_depth),
    Planted("direction-frozen", "v_means", "colours do not move with the viewing direction", _frozen_direction),
)
"""In the order of the pipeline, forward before backward."""
