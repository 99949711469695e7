"""A backend is a value: one function for every stage.

``dataclasses.replace(CPU, name="mine", composite=..., composite_vjp=...)`` swaps a stage and leaves the others. This is
the only module that sees both the reference and the kernels.
"""

import functools
from dataclasses import dataclass, replace
from typing import Any

from minisplat_ref.cpu import adam as cpu_adam
from minisplat_ref.cpu import compositing as cpu_compositing
from minisplat_ref.cpu import depth as cpu_depth
from minisplat_ref.cpu import loss as cpu_loss
from minisplat_ref.cpu import projection as cpu_projection
from minisplat_ref.cpu import removal as cpu_removal
from minisplat_ref.cpu import spherical_harmonics as cpu_spherical_harmonics
from minisplat_ref.cpu import tiling as cpu_tiling
from minisplat_ref.cpu.compositing import exact as cpu_compositing_exact
from minisplat_ref.cpu.compositing import plain_conic as cpu_plain_conic
from minisplat_ref.errors import InputError
from minisplat_ref.reference import (
    adam,
    compositing,
    depth,
    loss,
    projection,
    removal,
    spherical_harmonics,
    tiling,
)
from minisplat_ref.rendering import stages


@dataclass(frozen=True)
class Backend:
    """One function per stage; :mod:`minisplat_ref.rendering.stages` states what each takes and returns.

    Attributes
    ----------
    name : str
        For messages and reports.
    is_compiled : bool
        Whether compiled kernels do the work; an extension with its own stage chooses its implementation by this.
    tile_width, tile_height : int
        Size of the tiles that the image is cut into, pixels.
    residence : module, optional
        Further functions for a training whose arrays stay on a device; None where they are on the host. Its passes
        take the place of the stages from ``project`` to ``composite``.
    is_deterministic : bool
        Whether every run gives the same bytes.
    """

    name: str
    is_compiled: bool
    tile_width: int
    tile_height: int
    project: stages.Project
    project_vjp: stages.ProjectVjp
    sh_colors: stages.SHColors
    sh_colors_vjp: stages.SHColorsVjp
    bin_gaussians: stages.BinGaussians
    composite: stages.Composite
    composite_vjp: stages.CompositeVjp
    removal_changes: stages.RemovalChanges
    surface_points: stages.ComputeSurfacePoints
    surface_points_vjp: stages.SurfacePointsVjp
    photometric_loss: stages.PhotometricLoss
    photometric_loss_vjp: stages.PhotometricLossVjp
    adam_update: stages.AdamUpdate
    residence: Any = None
    is_deterministic: bool = True


REFERENCE = Backend(
    name="reference",
    is_compiled=False,
    tile_width=16,
    tile_height=16,
    project=projection.project,
    project_vjp=projection.project_vjp,
    sh_colors=spherical_harmonics.sh_colors,
    sh_colors_vjp=spherical_harmonics.sh_colors_vjp,
    bin_gaussians=tiling.bin_gaussians,
    composite=compositing.composite,
    composite_vjp=compositing.composite_vjp,
    removal_changes=removal.removal_changes,
    surface_points=depth.surface_points,
    surface_points_vjp=depth.surface_points_vjp,
    photometric_loss=loss.photometric_loss,
    photometric_loss_vjp=loss.photometric_loss_vjp,
    adam_update=adam.adam_update,
)
"""NumPy, written as in the papers, to read and to check against."""

CPU = Backend(
    name="cpu",
    is_compiled=True,
    tile_width=cpu_tiling.TILE_WIDTH,
    tile_height=cpu_tiling.TILE_HEIGHT,
    project=cpu_projection.project,
    project_vjp=cpu_projection.project_vjp,
    sh_colors=cpu_spherical_harmonics.sh_colors,
    sh_colors_vjp=cpu_spherical_harmonics.sh_colors_vjp,
    bin_gaussians=cpu_tiling.bin_gaussians,
    composite=cpu_compositing.composite,
    composite_vjp=cpu_compositing.composite_vjp,
    removal_changes=cpu_removal.removal_changes,
    surface_points=cpu_depth.surface_points,
    surface_points_vjp=cpu_depth.surface_points_vjp,
    photometric_loss=cpu_loss.photometric_loss,
    photometric_loss_vjp=cpu_loss.photometric_loss_vjp,
    adam_update=cpu_adam.adam_update,
)
"""Numba on all cores; for float32 data the exponential is a polynomial."""

CPU_EXACT = replace(
    CPU,
    name="cpu-exact",
    composite=cpu_compositing_exact.composite,
    composite_vjp=cpu_compositing_exact.composite_vjp,
)
"""The same, but with libm's exponential for float32 data too."""

PLAIN = replace(
    CPU,
    name="plain",
    composite=cpu_plain_conic.composite,
    composite_vjp=cpu_plain_conic.composite_vjp,
)
"""The same with the kernels that blend any primitive; slower, so it is not in ``BACKENDS``."""

BACKENDS = {backend.name: backend for backend in (REFERENCE, CPU, CPU_EXACT)}
"""The backends that every machine has."""

CUDA, CUDA_ATOMIC = "cuda", "cuda-atomic"
"""Names of the backends that :func:`load_cuda` and :func:`load_cuda_atomic` load."""


@functools.cache
def load_cuda() -> Backend:
    """Return the backend for an NVIDIA GPU; nothing imports CUDA before.

    Results are where the data are: NumPy arrays are copied to the GPU and back in each stage, arrays of the device stay
    there.

    Raises
    ------
    InputError
        There is no numba-cuda, no GPU, or no driver.
    """
    from minisplat_ref.cuda import (
        adam,
        compositing,
        depth,
        footprints,
        loss,
        projection,
        removal,
        resident,
        spherical_harmonics,
        target,
        tiling,
    )

    target.check_device()
    return replace(
        CPU,
        name="cuda",
        tile_width=footprints.TILE,
        tile_height=footprints.TILE,
        project=projection.project,
        project_vjp=projection.project_vjp,
        sh_colors=spherical_harmonics.sh_colors,
        sh_colors_vjp=spherical_harmonics.sh_colors_vjp,
        bin_gaussians=tiling.bin_gaussians,
        composite=compositing.composite,
        composite_vjp=compositing.composite_vjp,
        removal_changes=removal.removal_changes,
        surface_points=depth.surface_points,
        surface_points_vjp=depth.surface_points_vjp,
        photometric_loss=loss.photometric_loss,
        photometric_loss_vjp=loss.photometric_loss_vjp,
        adam_update=adam.adam_update,
        residence=resident,
    )


@functools.cache
def load_cuda_atomic() -> Backend:
    """Return the same with atomic additions in the gradient of blending: faster, but every run rounds differently."""
    from minisplat_ref.cuda import compositing

    atomic = compositing.composite_vjp_atomic
    return replace(load_cuda(), name=CUDA_ATOMIC, composite_vjp=atomic, is_deterministic=False)


def get_backend(name: str) -> Backend:
    """Return the backend of a name.

    Parameters
    ----------
    name : str
        ``"cpu"``, ``"cpu-exact"``, ``"reference"``, ``"cuda"`` or ``"cuda-atomic"``.

    Returns
    -------
    Backend
        The value of that name in this module, or that of :func:`load_cuda` or :func:`load_cuda_atomic`.

    Raises
    ------
    InputError
        There is none, or its hardware or package is missing.
    """
    if name in (CUDA, CUDA_ATOMIC):
        return load_cuda() if name == CUDA else load_cuda_atomic()
    if name not in BACKENDS:
        raise InputError(
            f"backend {name!r} is unknown; choose one of {', '.join(sorted((*BACKENDS, CUDA, CUDA_ATOMIC)))}"
        )
    return BACKENDS[name]
