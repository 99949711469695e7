"""Backends with a wrong forward formula and its derivative; the error has a given size."""

import inspect
from collections.abc import Callable
from dataclasses import replace
from types import FunctionType
from typing import Any

import numpy as np

from minisplat_ref.constants import SH_C0
from minisplat_ref.oracle.planted import Stage, change_stages
from minisplat_ref.reference import projection as reference_projection
from minisplat_ref.rendering.backends import REFERENCE, Backend
from minisplat_ref.types import (
    Camera,
    CompositeGradient,
    Floats,
    PrimitiveGradient,
    Projection,
    RenderOutput,
    SHGradient,
)


def _change_projection(
    change: Callable[..., tuple[Any, ...]], change_back: Callable[[PrimitiveGradient, tuple[Any, ...]], Any]
) -> Backend:
    """Return a backend that projects other primitives, or with another camera or conventions.

    ``change`` maps the six arguments of ``project`` to those that are used; ``change_back`` maps the gradient with
    respect to the latter, and the former, to that with respect to the former.
    """

    def project(stage: Stage, *args: Any) -> Projection:
        return stage(*change(*args))

    def project_vjp(stage: Stage, *args: Any) -> PrimitiveGradient:
        return change_back(stage(*change(*args[:6]), *args[6:]), args)

    return change_stages(REFERENCE, project=project, project_vjp=project_vjp)


def with_rules(change: Callable[[Any], dict[str, Any]]) -> Backend:
    """Return a backend that projects and blends by other conventions."""

    def follow(stage: Stage, *args: Any, **named: Any) -> Any:
        position = list(inspect.signature(stage).parameters).index("conventions")
        rules = args[position]._replace(**change(args[position]))
        return stage(*args[:position], rules, *args[position + 1 :], **named)

    names = ("project", "project_vjp", "bin_gaussians", "composite", "composite_vjp")
    return change_stages(REFERENCE, **dict.fromkeys(names, follow))


def with_scales(factor: float) -> Backend:
    """Return a backend whose scales are too large by a factor."""

    def change(means: Floats, quats: Floats, scales: Floats, *rest: Any) -> tuple[Any, ...]:
        return means, quats, factor * scales, *rest

    return _change_projection(change, lambda v, args: v._replace(scales=factor * v.scales))


def with_unsquared_scales(_: float) -> Backend:
    """Return a backend with ``R diag(s) R^T`` for the covariance."""

    def change(means: Floats, quats: Floats, scales: Floats, *rest: Any) -> tuple[Any, ...]:
        return means, quats, np.sqrt(scales), *rest

    return _change_projection(change, lambda v, args: v._replace(scales=v.scales / (2 * np.sqrt(args[2]))))


def with_unnormalised_quats(_: float) -> Backend:
    """R of a quaternion that is not divided by its length is |q|^2 R."""

    def change(means: Floats, quats: Floats, scales: Floats, *rest: Any) -> tuple[Any, ...]:
        return means, quats, scales * np.sum(quats**2, axis=1, keepdims=True), *rest

    def back(v: PrimitiveGradient, args: tuple[Any, ...]) -> PrimitiveGradient:
        squares, along = np.sum(args[1] ** 2, axis=1, keepdims=True), np.sum(v.scales * args[2], axis=1, keepdims=True)
        return v._replace(scales=v.scales * squares, quats=v.quats + 2 * along * args[1])

    return _change_projection(change, back)


def with_rolled_quats(_: float) -> Backend:
    """Return a backend that reads wxyz as xyzw."""

    def change(means: Floats, quats: Floats, *rest: Any) -> tuple[Any, ...]:
        return means, np.roll(quats, 1, axis=1), *rest

    return _change_projection(change, lambda v, args: v._replace(quats=np.roll(v.quats, -1, axis=1)))


def without_rotation(_: float) -> Backend:
    """Return a backend with the covariance ``diag(s)^2``."""

    def change(means: Floats, quats: Floats, *rest: Any) -> tuple[Any, ...]:
        return means, np.tile([1.0, 0.0, 0.0, 0.0], (len(quats), 1)).astype(quats.dtype), *rest

    return _change_projection(change, lambda v, args: v._replace(quats=np.zeros_like(v.quats)))


def with_conics(factors: tuple[float, float, float], order: tuple[int, int, int] = (0, 1, 2)) -> Backend:
    """Return a backend whose projection returns other conics."""

    def project(stage: Stage, *args: Any) -> Projection:
        p = stage(*args)
        return p._replace(conics=p.conics[:, order] * np.array(factors, p.conics.dtype))

    def project_vjp(stage: Stage, *args: Any) -> PrimitiveGradient:
        v = args[-1]
        return stage(*args[:-1], v._replace(conics=(v.conics * np.array(factors))[:, order]))

    return change_stages(REFERENCE, project=project, project_vjp=project_vjp)


def with_distances(_: float) -> Backend:
    """Return a backend whose depths are distances from the camera's centre."""

    def distances(means: Floats, camera: Camera) -> tuple[Floats, Floats]:
        x = means @ camera.cam_from_world_R.T + camera.cam_from_world_t
        return x, np.linalg.norm(x, axis=1)

    def project(stage: Stage, *args: Any) -> Projection:
        p = stage(*args)
        return p._replace(depths=np.where(p.depths > 0, distances(args[0], args[4])[1], 0).astype(p.depths.dtype))

    def project_vjp(stage: Stage, *args: Any) -> PrimitiveGradient:
        x, lengths = distances(args[0], args[4])
        v_depths = np.where(args[6].depths > 0, args[7].depths, 0)
        v = stage(*args[:7], args[7]._replace(depths=np.zeros_like(v_depths)))
        v_x = (v_depths / lengths)[:, None] * x
        return v._replace(
            means=v.means + v_x @ args[4].cam_from_world_R,
            cam_from_world_R=v.cam_from_world_R + v_x.T @ args[0],
            cam_from_world_t=v.cam_from_world_t + v_x.sum(axis=0),
        )

    return change_stages(REFERENCE, project=project, project_vjp=project_vjp)


def rebuilt(**functions: Any) -> Backend:
    """Return a backend whose projection uses other formulas in place of those of these names."""
    names = {**vars(reference_projection)}
    for name, value in vars(reference_projection).items():
        original = inspect.unwrap(value) if callable(value) else value
        if isinstance(original, FunctionType) and original.__module__ == reference_projection.__name__:
            names[name] = FunctionType(original.__code__, names, name, original.__defaults__)
    names |= functions
    return replace(REFERENCE, project=names["project"], project_vjp=names["project_vjp"])


def with_slope_limits(factor: float) -> Backend:
    """Return a backend whose Jacobian's clamp is wider by a factor."""
    right = vars(reference_projection)["slope_limits"]

    def slope_limits(*args: Any) -> tuple[Floats, Floats]:
        low, high = right(*args)
        return factor * low, factor * high

    return rebuilt(slope_limits=slope_limits)


def _change_coefficients(
    change: Callable[[Floats, Floats], tuple[Floats, Floats]], back: Callable[[SHGradient], SHGradient]
) -> Backend:
    """Return a backend that shades other coefficients."""

    def sh_colors(stage: Stage, means: Floats, sh_dc: Floats, sh_rest: Floats, *rest: Any) -> Floats:
        return stage(means, *change(sh_dc, sh_rest), *rest)

    def sh_colors_vjp(stage: Stage, means: Floats, sh_dc: Floats, sh_rest: Floats, *rest: Any) -> SHGradient:
        return back(stage(means, *change(sh_dc, sh_rest), *rest))

    return change_stages(REFERENCE, sh_colors=sh_colors, sh_colors_vjp=sh_colors_vjp)


def with_bands(factors: Callable[[int], float]) -> Backend:
    """Return a backend with every coefficient of a degree multiplied by a factor."""

    def changed(sh_rest: Floats) -> Floats:
        degrees = np.floor(np.sqrt(np.arange(1, sh_rest.shape[1] + 1)))
        return sh_rest * np.array([factors(int(degree)) for degree in degrees])[None, :, None].astype(sh_rest.dtype)

    return _change_coefficients(
        lambda sh_dc, sh_rest: (sh_dc, changed(sh_rest)), lambda v: v._replace(sh_rest=changed(v.sh_rest))
    )


def without_highest_band(_: float) -> Backend:
    """Return a backend that leaves out the highest degree of the harmonics."""

    def cut(sh_rest: Floats) -> Floats:
        degree = round(np.sqrt(sh_rest.shape[1] + 1)) - 1
        return np.where(np.arange(1, sh_rest.shape[1] + 1)[None, :, None] < degree**2, sh_rest, 0)

    return _change_coefficients(
        lambda sh_dc, sh_rest: (sh_dc, cut(sh_rest)), lambda v: v._replace(sh_rest=cut(v.sh_rest))
    )


def with_lighter_colors(by: float) -> Backend:
    """Return a backend that adds a constant to colours, before they are clamped."""
    return _change_coefficients(lambda sh_dc, sh_rest: (sh_dc + by / SH_C0, sh_rest), lambda v: v)


def with_directions_from_the_origin(_: float) -> Backend:
    """Return a backend that shades as if the camera's centre were the origin."""

    def at_origin(camera: Camera) -> Camera:
        return camera._replace(cam_from_world_t=np.zeros(3))

    def sh_colors(stage: Stage, means: Floats, sh_dc: Floats, sh_rest: Floats, camera: Camera, *rest: Any) -> Floats:
        return stage(means, sh_dc, sh_rest, at_origin(camera), *rest)

    def sh_colors_vjp(
        stage: Stage, means: Floats, sh_dc: Floats, sh_rest: Floats, camera: Camera, *rest: Any
    ) -> SHGradient:
        v = stage(means, sh_dc, sh_rest, at_origin(camera), *rest)
        nothing = np.zeros_like(v.cam_from_world_R), np.zeros_like(v.cam_from_world_t)
        return v._replace(cam_from_world_R=nothing[0], cam_from_world_t=nothing[1])

    return change_stages(REFERENCE, sh_colors=sh_colors, sh_colors_vjp=sh_colors_vjp)


def with_negative_colors(_: float) -> Backend:
    """Return a backend without the clamp at 0: ``c = 1 - max(0, 1 - c)`` where c is below 0."""

    def sh_colors(stage: Stage, means: Floats, sh_dc: Floats, sh_rest: Floats, *rest: Any) -> Floats:
        upper = stage(means, sh_dc, sh_rest, *rest)
        shown = (rest[-1][:, :1] > 0) & (upper == 0)
        return np.where(shown, 1 - stage(means, -sh_dc, -sh_rest, *rest), upper)

    def sh_colors_vjp(stage: Stage, means: Floats, sh_dc: Floats, sh_rest: Floats, *rest: Any) -> SHGradient:
        upper = REFERENCE.sh_colors(means, sh_dc, sh_rest, *rest[:-1])
        v = stage(means, sh_dc, sh_rest, *rest)
        lower = stage(means, -sh_dc, -sh_rest, *rest[:-1], np.where(upper == 0, -rest[-1], 0))
        lower = lower._replace(sh_dc=-lower.sh_dc, sh_rest=-lower.sh_rest)
        return SHGradient._make(a + b for a, b in zip(v, lower, strict=True))

    return change_stages(REFERENCE, sh_colors=sh_colors, sh_colors_vjp=sh_colors_vjp)


def _change_footprints(
    change: Callable[[Projection], Projection], back: Callable[[CompositeGradient], CompositeGradient]
) -> Backend:
    """Return a backend that blends other footprints."""

    def composite(stage: Stage, projection: Projection, *rest: Any, **asked: bool) -> RenderOutput:
        return stage(change(projection), *rest, **asked)

    def composite_vjp(stage: Stage, projection: Projection, *rest: Any) -> CompositeGradient:
        return back(stage(change(projection), *rest))

    return change_stages(REFERENCE, composite=composite, composite_vjp=composite_vjp)


def with_blended_conics(*factors: float) -> Backend:
    """Return a backend that blends conics times three factors."""
    by = np.array(factors)
    return _change_footprints(
        lambda p: p._replace(conics=(p.conics * by).astype(p.conics.dtype)), lambda v: v._replace(conics=v.conics * by)
    )


def with_blended_opacities(factor: float) -> Backend:
    """Return a backend that blends opacities times a factor."""
    return _change_footprints(
        lambda p: p._replace(opacities=p.opacities * p.opacities.dtype.type(factor)),
        lambda v: v._replace(opacities=factor * v.opacities),
    )


def with_background(factor: float) -> Backend:
    """Return a backend with the background times a factor."""

    def composite(
        stage: Stage, p: Projection, colors: Floats, background: Floats, *rest: Any, **asked: bool
    ) -> RenderOutput:
        return stage(p, colors, factor * background, *rest, **asked)

    def composite_vjp(stage: Stage, p: Projection, colors: Floats, background: Floats, *rest: Any) -> CompositeGradient:
        v = stage(p, colors, factor * background, *rest)
        return v._replace(background=factor * v.background)

    return change_stages(REFERENCE, composite=composite, composite_vjp=composite_vjp)


def sorted_from_behind(_: float) -> Backend:
    """Return a backend that blends the farthest Gaussian first."""

    def bin_gaussians(stage: Stage, projection: Projection, *rest: Any) -> Any:
        return stage(projection._replace(depths=-projection.depths), *rest)

    return change_stages(REFERENCE, bin_gaussians=bin_gaussians)
