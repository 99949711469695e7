"""Backends with right images and a wrong gradient, whose error has a given size."""

from collections.abc import Callable
from dataclasses import replace
from types import FunctionType
from typing import Any

import numpy as np

from minisplat_ref.oracle.faults.forward import rebuilt
from minisplat_ref.oracle.planted import Stage, change_stages, plant
from minisplat_ref.reference import compositing, spherical_harmonics
from minisplat_ref.reference import projection as reference_projection
from minisplat_ref.rendering.backends import REFERENCE, Backend
from minisplat_ref.types import CompositeGradient, PrimitiveGradient, ProjectionGradient, SHGradient


def scale_gradient(stage: str, *fields: str, columns: tuple[float, ...] | None = None) -> Callable[[float], Backend]:
    """Return a fault that scales fields of a stage's gradient, in the columns where ``columns`` is 1."""

    def plant_factor(factor: float) -> Backend:
        by: Any = factor if columns is None else np.where(np.array(columns) == 1, factor, 1.0)

        def scale(right: Stage, *args: Any) -> Any:
            v = right(*args)
            return v._replace(**{field: (getattr(v, field) * by).astype(getattr(v, field).dtype) for field in fields})

        return change_stages(REFERENCE, **{stage: scale})

    return plant_factor


def changed_project_vjp(change: Callable[[PrimitiveGradient, tuple[Any, ...]], PrimitiveGradient]) -> Backend:
    """Return a backend whose gradient of the projection is changed; the change also gets the arguments."""

    def project_vjp(stage: Stage, *args: Any) -> PrimitiveGradient:
        return change(stage(*args), args)

    return change_stages(REFERENCE, project_vjp=project_vjp)


def with_v_alpha(factor: float) -> Backend:
    """Return a backend that multiplies the derivative with respect to alpha's image."""

    def composite_vjp(stage: Stage, *args: Any) -> CompositeGradient:
        return stage(*args[:-1], factor * args[-1])

    return change_stages(REFERENCE, composite_vjp=composite_vjp)


def with_v_depths(factor: float) -> Backend:
    """Return a backend that multiplies the derivative with respect to the depths."""

    def project_vjp(stage: Stage, *args: Any) -> PrimitiveGradient:
        v: ProjectionGradient = args[-1]
        return stage(*args[:-1], v._replace(depths=factor * v.depths))

    return change_stages(REFERENCE, project_vjp=project_vjp)


def scale_share(name: str) -> Callable[[float], Backend]:
    """Return a fault that multiplies one function of the projection's gradient by the size."""
    right = getattr(reference_projection, name)

    def plant_factor(factor: float) -> Backend:
        project_vjp = rebuilt(**{name: lambda *args: factor * right(*args)}).project_vjp
        return replace(REFERENCE, project_vjp=project_vjp)

    return plant_factor


def scale_band(degree: int) -> Callable[[float], Backend]:
    """Return a fault that multiplies the gradient of one degree of the harmonics by the size."""

    def plant_factor(factor: float) -> Backend:
        def sh_colors_vjp(stage: Stage, *args: Any) -> SHGradient:
            v = stage(*args)
            own = np.floor(np.sqrt(np.arange(1, v.sh_rest.shape[1] + 1)))[None, :, None]
            return v._replace(sh_rest=np.where(own == degree, factor * v.sh_rest, v.sh_rest))

        return change_stages(REFERENCE, sh_colors_vjp=sh_colors_vjp)

    return plant_factor


def without_clamp_of_colors(_: float) -> Backend:
    """Return a backend whose colours pass their gradient on where they are clamped at 0."""

    def sh_colors_vjp(stage: Stage, *args: Any) -> SHGradient:
        names = {**vars(spherical_harmonics), "_unclamped": lambda *_: 1.0}
        changed = FunctionType(spherical_harmonics.sh_colors_vjp.__code__, names)
        v: SHGradient = changed(*args)
        return v

    return change_stages(REFERENCE, sh_colors_vjp=sh_colors_vjp)


def without_what_is_behind(_: float) -> Backend:
    """Return a backend whose gradient of alpha leaves out that a hit dims what is behind it."""

    def composite_vjp(stage: Stage, *args: Any) -> CompositeGradient:
        names = {**vars(compositing), "_suffix_sums": np.zeros_like}
        for name in ("blend_tile_vjp", "composite_hits_vjp", "composite_vjp"):
            names[name] = FunctionType(getattr(compositing, name).__code__, names)
        v: CompositeGradient = names["composite_vjp"](*args)
        return v

    return change_stages(REFERENCE, composite_vjp=composite_vjp)


def as_planted(name: str) -> Callable[[float], Backend]:
    """Return a fault that plants one of :data:`minisplat_ref.oracle.planted.PLANTED` in the reference."""
    return lambda _: plant(name, REFERENCE)
