"""A backend is a value: one function for every stage.

``dataclasses.replace(CPU, name="mine", composite=..., composite_vjp=...)`` swaps a stage and leaves the others. This is
the only module that sees both the reference and the kernels.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from minisplat_ref.errors import InputError
from minisplat_ref.reference.compositing import composite, composite_vjp
from minisplat_ref.reference.depth import surface_points
from minisplat_ref.reference.loss import photometric_loss, photometric_loss_vjp
from minisplat_ref.reference.projection import project, project_vjp
from minisplat_ref.reference.spherical_harmonics import sh_colors, sh_colors_vjp
from minisplat_ref.reference.tiling import bin_gaussians
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
    photometric_loss: Callable[..., tuple[float, Any]]
    photometric_loss_vjp: Callable[..., Floats]


REFERENCE = Backend(
    name="reference",
    tile_width=16,
    tile_height=16,
    project=project,
    project_vjp=project_vjp,
    sh_colors=sh_colors,
    sh_colors_vjp=sh_colors_vjp,
    bin_gaussians=bin_gaussians,
    composite=composite,
    composite_vjp=composite_vjp,
    surface_points=surface_points,
    photometric_loss=photometric_loss,
    photometric_loss_vjp=photometric_loss_vjp,
)
"""NumPy, as in the papers: to read and to check against."""

BACKENDS = {backend.name: backend for backend in (REFERENCE,)}


def get_backend(name: str) -> Backend:
    """Backend of a name.

    Parameters
    ----------
    name : str
        ``"cpu"`` or ``"reference"``.

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
