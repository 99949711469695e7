"""Backends with a wrong forward formula and its derivative; the error has a given size."""

import inspect
from collections.abc import Callable
from dataclasses import replace
from types import FunctionType
from typing import Any

import numpy as np

from minisplat_ref.constants import SH_C0, Conventions
from minisplat_ref.oracle.planted import Stage, change_camera, change_stages
from minisplat_ref.reference import projection as reference_projection
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.rendering.backends import REFERENCE, Backend
from minisplat_ref.types import (
    Camera,
    Floats,
    PrimitiveGradient,
    Projection,
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


def with_positions(move: Callable[[Floats, Camera], Floats]) -> Backend:
    """Return a backend whose projection puts the centres elsewhere, by an image that is moved as a whole."""

    def project(stage: Stage, *args: Any) -> Projection:
        p = stage(*args)
        return p._replace(means2d=np.where(p.radii > 0, move(p.means2d, args[4]), 0))

    return change_stages(REFERENCE, project=project)


def with_camera(change: Callable[[Camera], Camera]) -> Backend:
    """Return a backend that projects and shades by another camera."""
    shaded = change_camera(REFERENCE, change)

    def sh_colors(stage: Stage, means: Floats, sh_dc: Floats, sh_rest: Floats, camera: Camera, *rest: Any) -> Any:
        return stage(means, sh_dc, sh_rest, change(camera), *rest)

    return change_stages(shaded, sh_colors=sh_colors, sh_colors_vjp=sh_colors)


def with_covariances(change: Callable[[Floats, Conventions], Floats]) -> Backend:
    """Return a backend whose covariances [N, 2, 2] in the image are others, the low-pass included."""

    def project(stage: Stage, *args: Any) -> Projection:
        p = stage(*args)
        shown = p.radii[:, 0] > 0
        Q = np.where(shown[:, None], p.conics, (1, 0, 1))[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
        changed = np.linalg.inv(change(np.linalg.inv(Q), args[5]))
        conics = np.column_stack([changed[:, 0, 0], changed[:, 0, 1], changed[:, 1, 1]])
        return p._replace(conics=np.where(shown[:, None], conics, 0))

    return change_stages(REFERENCE, project=project)


def with_jacobians(change: Callable[[Floats], Floats]) -> Backend:
    """Return a backend with other Jacobians [N, 2, 3]."""
    right = vars(reference_projection)["pinhole_jacobians"]
    return rebuilt(pinhole_jacobians=lambda *args: change(right(*args)))


def with_rotations(change: Callable[[Floats], Floats]) -> Backend:
    """Return a backend with other rotations [N, 3, 3] of the Gaussians, by their quaternions [N, 4]."""

    def covariances(quats: Floats, scales: Floats) -> Floats:
        M = change(quats) * scales[:, None, :]
        return np.asarray(M @ np.swapaxes(M, 1, 2))

    return rebuilt(covariances=covariances)


def unnormalised_rotations(quats: Floats) -> Floats:
    """Return ``1 - 2 (y^2 + z^2)`` and so on of quaternions that are not divided by their length."""
    squares = np.sum(quats**2, axis=1)[:, None, None]
    return np.asarray(np.eye(3) + squares * (rotation_matrices(quats) - np.eye(3)))


def with_projected_opacities(change: Callable[[Floats], Floats]) -> Backend:
    """Return a backend whose projection returns other opacities."""

    def project(stage: Stage, *args: Any) -> Projection:
        p = stage(*args)
        return p._replace(opacities=np.where(p.radii[:, 0] > 0, change(p.opacities), 0))

    return change_stages(REFERENCE, project=project)


def with_compensations(power: float) -> Backend:
    """Return a backend that multiplies opacities by a power of the right compensation, where there is one."""

    def project(stage: Stage, *args: Any) -> Projection:
        p = stage(*args)
        plain = np.where(args[3] > 0, args[3], 1)
        ratios = np.where(p.opacities > 0, p.opacities / plain, 1)
        return p._replace(opacities=np.where(p.radii[:, 0] > 0, args[3] * ratios**power, 0))

    return change_stages(REFERENCE, project=project)


def with_depths(change: Callable[[Floats], Floats]) -> Backend:
    """Return a backend whose projection returns other depths."""

    def project(stage: Stage, *args: Any) -> Projection:
        p = stage(*args)
        return p._replace(depths=np.where(p.radii[:, 0] > 0, change(np.where(p.depths > 0, p.depths, 1)), 0))

    return change_stages(REFERENCE, project=project)


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


def with_primitives(scales: Callable[[Floats], Floats]) -> Backend:
    """Return a backend that projects other scales."""

    def project(stage: Stage, means: Floats, quats: Floats, given: Floats, *rest: Any) -> Projection:
        p: Projection = stage(means, quats, scales(given), *rest)
        return p

    return change_stages(REFERENCE, project=project)


def sorted_by_distances(_: float) -> Backend:
    """Return a backend that sorts by distances from the camera's centre; depths themselves are right."""

    def bin_gaussians(stage: Stage, projection: Projection, *rest: Any) -> Any:
        p = projection
        rays = (p.means2d - memory["c"]) / memory["f"]
        return stage(p._replace(depths=p.depths * np.sqrt(1 + np.sum(rays**2, axis=1))), *rest)

    def project(stage: Stage, *args: Any) -> Projection:
        memory.update(c=np.array([args[4].cx, args[4].cy]), f=np.array([args[4].fx, args[4].fy]))
        p: Projection = stage(*args)
        return p

    memory: dict[str, Floats] = {}  # of the camera, which the lists are made without
    return change_stages(REFERENCE, project=project, bin_gaussians=bin_gaussians)


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


def with_coefficient(k: int, factor: float) -> Backend:
    """Return a backend with coefficient ``k`` of :attr:`sh_rest` multiplied by a factor, where there is one."""

    def changed(sh_rest: Floats) -> Floats:
        factors = np.where(np.arange(sh_rest.shape[1]) == k, factor, 1)
        return (sh_rest * factors[None, :, None]).astype(sh_rest.dtype)

    return _change_coefficients(
        lambda sh_dc, sh_rest: (sh_dc, changed(sh_rest)), lambda v: v._replace(sh_rest=changed(v.sh_rest))
    )


def with_coefficients(change: Callable[[Floats, Floats], tuple[Floats, Floats]]) -> Backend:
    """Return a backend that shades other coefficients; its gradient is that of these."""
    return _change_coefficients(change, lambda v: v)


def with_colors(change: Callable[[Floats], Floats]) -> Backend:
    """Return a backend with other colours [N, 3], after they are clamped at 0."""
    return change_stages(REFERENCE, sh_colors=lambda stage, *args: change(stage(*args)))


def with_directions(change: Callable[[Floats, Camera], tuple[Floats, Camera]]) -> Backend:
    """Return a backend that shades means [N, 3] seen by a camera, both changed."""

    def sh_colors(stage: Stage, means: Floats, sh_dc: Floats, sh_rest: Floats, camera: Camera, *rest: Any) -> Floats:
        seen, by = change(means, camera)
        return np.asarray(stage(seen, sh_dc, sh_rest, by, *rest))

    return change_stages(REFERENCE, sh_colors=sh_colors)


def with_unnormalised_directions(_: float) -> Backend:
    """Return a backend whose harmonics take ``mu - o`` itself: those of degree l grow by its length to the l."""

    def sh_colors(stage: Stage, means: Floats, sh_dc: Floats, sh_rest: Floats, camera: Camera, *rest: Any) -> Floats:
        lengths = np.linalg.norm(means + camera.cam_from_world_t @ camera.cam_from_world_R, axis=1)[:, None, None]
        degrees = np.floor(np.sqrt(np.arange(1, sh_rest.shape[1] + 1)))[None, :, None]
        return np.asarray(stage(means, sh_dc, sh_rest * lengths**degrees, camera, *rest))

    return change_stages(REFERENCE, sh_colors=sh_colors)


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
