"""Render one view of activated Gaussians: project, shade, sort into tiles, composite; and the same backwards.

The order of the stages is that of 3DGS section 6. The caller decides what the Gaussians are before their activations
and where their colours come from: :mod:`minisplat_ref.rendering` has trained parameters and spherical harmonics,
:mod:`minisplat_ref.gsplat.call` takes what it is given.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.jit.forking import check_fork
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.types import (
    Camera,
    Floats,
    Ints,
    PrimitiveGradient,
    Primitives,
    Projection,
    ProjectionGradient,
    RenderOutput,
    TileBins,
    TileGrid,
)

__all__ = ["Primitives", "SplatGradient", "SplatTape", "splat", "splat_vjp"]


class SplatTape(NamedTuple):
    """Record of a call of :func:`splat`, for :func:`splat_vjp`."""

    primitives: Primitives
    camera: Camera
    conventions: Conventions
    backend: Backend
    projection: Projection  # radii are 0 where culled
    channels: Floats  # [N, D] colours, then the depth if requested
    background: Floats  # [D] 0 in a depth channel
    has_depth: bool
    bins: TileBins
    output: RenderOutput


class SplatGradient(NamedTuple):
    """Gradient of the loss with respect to the inputs of :func:`splat` and the projected centres."""

    primitives: PrimitiveGradient  # and the pose, as far as the projection depends on it
    colors: Floats  # [N, D] without the depth channel
    background: Floats  # [D] without the depth channel
    means2d: Floats  # [N, 2] per pixel: input of density control


def splat(
    primitives: Primitives,
    shade: Callable[[Ints], Floats],
    camera: Camera,
    background: Floats,
    conventions: Conventions,
    backend: Backend,
    *,
    with_depth: bool = False,
    with_stats: bool = False,
    with_median_depth: bool = False,
) -> SplatTape:
    """Render one view of activated Gaussians.

    Parameters
    ----------
    primitives : Primitives
        Activated Gaussians; may be none.
    shade : callable
        Maps the radii [N, 2] of the projection, 0 where culled, to colours [N, D].
    camera : Camera
        View.
    background : ndarray of shape (D,)
        Behind everything.
    conventions : Conventions
        Profile of the rasteriser.
    backend : Backend
        Implementation of the stages.
    with_depth : bool
        Append the accumulated depth, ``sum w z``, as the last channel; its background is 0.
    with_stats, with_median_depth : bool
        As for :func:`composite`.

    Returns
    -------
    SplatTape
        Its ``output`` is the view.

    Raises
    ------
    InputError
        The process was forked after kernels had run in parallel.
    """
    if backend.is_compiled:
        check_fork()
    projection = backend.project(*primitives, camera, conventions)
    channels = shade(projection.radii)  # [N, D]
    if with_depth:
        channels, background = append_depths(channels, background, projection.depths)
    grid = TileGrid(camera.width, camera.height, backend.tile_width, backend.tile_height)
    bins = backend.bin_gaussians(projection, grid, conventions)
    output = backend.composite(
        projection, channels, background, bins, conventions, with_stats=with_stats, with_median_depth=with_median_depth
    )
    return SplatTape(
        primitives, camera, conventions, backend, projection, channels, background, with_depth, bins, output
    )


def append_depths(channels: Floats, background: Floats, depths: Floats) -> tuple[Floats, Floats]:
    """Return channels [N, D + 1] and a background [D + 1] with depths [N] as the last channel, behind which is 0."""
    with_depths = np.column_stack([channels, depths.astype(channels.dtype)])
    return with_depths, np.append(background, background.dtype.type(0))


def splat_vjp(tape: SplatTape, v_image: Floats, v_alpha: Floats) -> SplatGradient:
    """Gradient of :func:`splat`: the stages' gradients in reverse order; the caller chains on through its ``shade``.

    Parameters
    ----------
    tape : SplatTape
        From the forward function.
    v_image : ndarray of shape (H, W, D)
        Derivative with respect to the image, including its depth channel if it has one.
    v_alpha : ndarray of shape (H, W)
        Derivative with respect to the accumulated opacity.

    Returns
    -------
    SplatGradient
        Zeros for Gaussians that were not visible.
    """
    projection, conventions, backend = tape.projection, tape.conventions, tape.backend
    if backend.is_compiled:
        check_fork()
    v = backend.composite_vjp(
        projection, tape.channels, tape.background, tape.bins, conventions, tape.output, v_image, v_alpha
    )
    v_colors, v_background, v_depths = v.colors, v.background, np.zeros_like(projection.depths)
    if tape.has_depth:
        v_colors, v_depths = np.ascontiguousarray(v.colors[:, :-1]), v.colors[:, -1].copy()
        v_background = v.background[:-1]
    v_projection = ProjectionGradient(v.means2d, v_depths, v.conics, v.opacities)
    v_primitives = backend.project_vjp(*tape.primitives, tape.camera, conventions, projection, v_projection)
    return SplatGradient(v_primitives, v_colors, v_background, v.means2d)
