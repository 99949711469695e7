"""The stages whose kernels are compiled ahead of their use, each with a call that compiles it.

A single stage needs arguments of the types that the stages before it return; these come from the reference, which
compiles nothing.

Left out: other numbers of channels than training and rendering use (3, and 4 with depth), which gsplat's signature
allows, and the kernels of ``bench``. They are compiled at their first use.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import ParamSpec, TypeVar

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.compositing.records import record_size
from minisplat_ref.jit.warm_up import Dtype
from minisplat_ref.rendering.backends import CPU, REFERENCE, Backend
from minisplat_ref.rendering.renderer import RenderTape, render, render_vjp
from minisplat_ref.types import (
    AdamStep,
    Camera,
    CompositeGradient,
    Floats,
    Gaussians,
    Projection,
    RenderOutput,
    TileBins,
)

WIDTH, HEIGHT = 24, 18
N_GAUSSIANS = 4
DEGREE = 1  # of the spherical harmonics: known only at run time, so any value will do

Arguments = ParamSpec("Arguments")
HasConics = TypeVar("HasConics", Projection, CompositeGradient)


def _stage(name: str, with_depth: bool = False, with_stats: bool = False) -> Callable[[Dtype], None]:
    """Return a task that renders and differentiates a view with one stage compiled."""

    def compile_stage(dtype: Dtype) -> None:
        backend = replace(TYPED_REFERENCE, **{name: getattr(CPU, name)})
        tape = _render_view(dtype, backend, with_depth, with_stats)
        if name.endswith("_vjp"):
            render_vjp(tape, np.ones_like(tape.splats.output.image))

    return compile_stage


def _surface_points(dtype: Dtype) -> None:
    tape = _render_view(dtype, TYPED_REFERENCE, False, with_stats=True)
    primitives, stats = tape.splats.primitives, tape.splats.output.stats
    assert stats is not None
    CPU.surface_points(primitives.means, primitives.quats, primitives.scales, tape.splats.camera, stats.dominant_ids)


def _removal_changes(dtype: Dtype) -> None:
    s = _render_view(dtype, TYPED_REFERENCE, False, with_stats=False).splats
    CPU.removal_changes(s.projection, s.channels, s.bins, s.conventions, s.output)


def _photometric_loss(dtype: Dtype) -> None:
    image, photograph = np.zeros((HEIGHT, WIDTH, 3), dtype), np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    CPU.photometric_loss_vjp(CPU.photometric_loss(image, photograph, 0.2)[1])


def _adam(dtype: Dtype) -> None:
    for rows in (None, np.arange(N_GAUSSIANS)):  # all, and the visible
        values, gradient, first, second = np.zeros((4, N_GAUSSIANS, 3), dtype)
        CPU.adam_update(values, gradient, first, second, rows, AdamStep(0.1, 0.9, 0.999, 1e-15))


STAGES: dict[str, Callable[[Dtype], None]] = {
    "tile lists": _stage("bin_gaussians"),
    "blending": _stage("composite"),
    "blending, backward": _stage("composite_vjp"),
    "photometric loss, both ways": _photometric_loss,
    "colours, backward": _stage("sh_colors_vjp"),
    "projection, backward": _stage("project_vjp"),
    "projection": _stage("project"),
    "colours": _stage("sh_colors"),
    "Adam": _adam,
    # Those below are not used by every training, nor by ordinary rendering.
    "blending with depth, backward": _stage("composite_vjp", with_depth=True),
    "blending with depth": _stage("composite", with_depth=True),
    "blend statistics": _stage("composite", with_stats=True),
    "surface points": _surface_points,
    "removal of Gaussians": _removal_changes,
}
"""Calls that compile functions together, by name; slow ones first, so that no process ends up with a slow one last."""

FIRST_ITERATION = tuple(STAGES)[:9]
"""Those that the first iteration of every training needs."""


def compile_stage(name: str, dtype: Dtype) -> str:
    """Compile a stage, a key of ``STAGES``; there is no problem to return."""
    STAGES[name](dtype)
    return ""


def _widen_conics(function: Callable[Arguments, HasConics]) -> Callable[Arguments, HasConics]:
    """Return a stage of the reference whose conics, or their gradient, are float64 as in the kernels."""

    def stage(*args: Arguments.args, **named: Arguments.kwargs) -> HasConics:
        bundle = function(*args, **named)
        bundle = bundle._replace(conics=bundle.conics.astype(np.float64))
        return type(bundle)._make(map(np.ascontiguousarray, bundle))

    return stage


def _with_records(
    projection: Projection, colors: Floats, background: Floats, bins: TileBins, conventions: Conventions, **asked: bool
) -> RenderOutput:
    """Composite with the reference and add the kernels' records, which their gradient would otherwise have to make."""
    records = np.zeros((len(colors), record_size(colors.shape[1])), colors.dtype)
    output = REFERENCE.composite(projection, colors, background, bins, conventions, **asked)
    return output._replace(saved=records)


TYPED_REFERENCE = replace(
    REFERENCE,
    tile_width=CPU.tile_width,
    tile_height=CPU.tile_height,
    project=_widen_conics(REFERENCE.project),
    composite=_with_records,
    composite_vjp=_widen_conics(REFERENCE.composite_vjp),
)
"""The reference with results of the types that kernels return."""


def _render_view(dtype: Dtype, backend: Backend, with_depth: bool = False, with_stats: bool = False) -> RenderTape:
    return render(tiny_gaussians(dtype), tiny_camera(), backend=backend, with_depth=with_depth, with_stats=with_stats)[
        1
    ]


def tiny_camera() -> Camera:
    """Return the camera of the calls."""
    return Camera(np.eye(3), np.zeros(3), 20.0, 20.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)


def tiny_gaussians(dtype: Dtype) -> Gaussians:
    """Return a few Gaussians, one behind the other in the middle of the view."""
    n = N_GAUSSIANS

    def full(value: float, *shape: int) -> Floats:
        return np.full((n, *shape), value, dtype)

    means = np.zeros((n, 3), dtype)
    means[:, 2] = 2 + np.arange(n)
    return Gaussians(means, full(0.5, 4), full(-2, 3), full(0), full(0.5, 3), full(0.1, (DEGREE + 1) ** 2 - 1, 3))
