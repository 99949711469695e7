"""A backend is a value: one function for every stage.

``dataclasses.replace(CPU, name="mine", composite=..., composite_vjp=...)`` swaps a stage and leaves the others. This is
the only module that sees both the reference and the kernels.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import minisplat_ref.cpu.adam
import minisplat_ref.cpu.compositing
import minisplat_ref.cpu.compositing.exact
import minisplat_ref.cpu.compositing.plain_conic
import minisplat_ref.cpu.depth
import minisplat_ref.cpu.geometric_loss
import minisplat_ref.cpu.loss
import minisplat_ref.cpu.projection
import minisplat_ref.cpu.spherical_harmonics
import minisplat_ref.cpu.tiling
import minisplat_ref.reference.adam
import minisplat_ref.reference.compositing
import minisplat_ref.reference.depth
import minisplat_ref.reference.geometric_loss
import minisplat_ref.reference.hits
import minisplat_ref.reference.loss
import minisplat_ref.reference.projection
import minisplat_ref.reference.spherical_harmonics
import minisplat_ref.reference.tiling  # noqa: F401  (the linter sees only the last import of a package)
from minisplat_ref import cpu, reference
from minisplat_ref.cpu.tiling import TILE_HEIGHT, TILE_WIDTH
from minisplat_ref.errors import InputError
from minisplat_ref.types import (
    CompositeGradient,
    Floats,
    PrimitiveGradient,
    Projection,
    RenderOutput,
    SHGradient,
    SurfacePoints,
    TileBins,
)


@dataclass(frozen=True)
class Backend:
    """One function per stage, with the signatures of the functions of the same names in :mod:`minisplat_ref.reference`.

    Attributes
    ----------
    name : str
        For messages and reports.
    tile_width, tile_height : int
        Size of the tiles that the image is cut into, pixels.
    """

    name: str
    tile_width: int
    tile_height: int
    project: Callable[..., Projection]
    project_vjp: Callable[..., PrimitiveGradient]
    sh_colors: Callable[..., Floats]
    sh_colors_vjp: Callable[..., SHGradient]
    bin_gaussians: Callable[..., TileBins]
    composite: Callable[..., RenderOutput]
    composite_vjp: Callable[..., CompositeGradient]
    surface_points: Callable[..., SurfacePoints]
    surface_points_vjp: Callable[..., tuple[Floats, Floats, Floats]]
    photometric_loss: Callable[..., tuple[float, Any]]
    photometric_loss_vjp: Callable[..., Floats]
    geometric_loss: Callable[..., tuple[float, Any]]
    geometric_loss_vjp: Callable[..., tuple[Floats, Floats]]
    adam_update: Callable[..., None]


def _from_package(name: str, package: ModuleType, tile_width: int, tile_height: int) -> Backend:
    """Collect the stages of a package whose modules and functions bear the reference's names."""
    return Backend(
        name=name,
        tile_width=tile_width,
        tile_height=tile_height,
        project=package.projection.project,
        project_vjp=package.projection.project_vjp,
        sh_colors=package.spherical_harmonics.sh_colors,
        sh_colors_vjp=package.spherical_harmonics.sh_colors_vjp,
        bin_gaussians=package.tiling.bin_gaussians,
        composite=package.compositing.composite,
        composite_vjp=package.compositing.composite_vjp,
        surface_points=package.depth.surface_points,
        surface_points_vjp=package.depth.surface_points_vjp,
        photometric_loss=package.loss.photometric_loss,
        photometric_loss_vjp=package.loss.photometric_loss_vjp,
        geometric_loss=package.geometric_loss.geometric_loss,
        geometric_loss_vjp=package.geometric_loss.geometric_loss_vjp,
        adam_update=package.adam.adam_update,
    )


REFERENCE = _from_package("reference", reference, tile_width=16, tile_height=16)
"""NumPy, as in the papers: to read and to check against."""

CPU = _from_package("cpu", cpu, TILE_WIDTH, TILE_HEIGHT)
"""Numba on all cores; float32 data use a polynomial exponential."""

CPU_EXACT = replace(
    CPU,
    name="cpu-exact",
    composite=cpu.compositing.exact.composite,
    composite_vjp=cpu.compositing.exact.composite_vjp,
)
"""The same with libm's exponential in float32 too."""

PLAIN = replace(
    CPU,
    name="plain",
    composite=cpu.compositing.plain_conic.composite,
    composite_vjp=cpu.compositing.plain_conic.composite_vjp,
)
"""The same with the kernels that blend any primitive; without statistics, therefore not among ``BACKENDS``."""

BACKENDS = {backend.name: backend for backend in (REFERENCE, CPU, CPU_EXACT)}


def get_backend(name: str) -> Backend:
    """Backend of a name.

    Parameters
    ----------
    name : str
        ``"cpu"``, ``"cpu-exact"`` or ``"reference"``.

    Returns
    -------
    Backend
        The value of that name in this module.

    Raises
    ------
    InputError
        If there is none.
    """
    if name not in BACKENDS:
        raise InputError(f"backend {name!r} is unknown; choose one of {', '.join(sorted(BACKENDS))}")
    return BACKENDS[name]
