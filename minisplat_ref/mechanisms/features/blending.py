"""Any number of channels through the compositor, three at a time, with one projection for all.

A pixel blends the channels c_i of its Gaussians as it does colours, ``F(p) = sum_i w_i(p) c_i``, over zero. Three at a
time are as many as colours are, so that no further kernel is compiled.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.jit.forking import check_fork
from minisplat_ref.rendering import Request
from minisplat_ref.types import (
    Camera,
    Floats,
    PrimitiveGradient,
    Primitives,
    Projection,
    ProjectionGradient,
    RenderOutput,
    TileBins,
    TileGrid,
)

WIDTH = 3  # channels of a pass


class BlendTape(NamedTuple):
    """The values that :func:`blend_channels` keeps for its gradient."""

    primitives: Primitives
    camera: Camera
    request: Request
    projection: Projection
    bins: TileBins
    passes: tuple[tuple[Floats, RenderOutput], ...]
    """[N, 3] channels, the last ones padded with zeros, and their blended image."""
    n_channels: int


def blend_channels(
    primitives: Primitives, channels: Floats, camera: Camera, request: Request
) -> tuple[Floats, BlendTape]:
    """Return the blended channels of a view.

    Parameters
    ----------
    primitives : Primitives
        N activated Gaussians.
    channels : ndarray of shape (N, C)
        Of any sign and size.
    camera : Camera
    request : Request
        Backend and conventions count.

    Returns
    -------
    blended : ndarray of shape (H, W, C)
        F.
    tape : BlendTape
        For :func:`blend_channels_vjp`.
    """
    backend, conventions = request.backend, request.conventions
    if backend.is_compiled:
        check_fork()
    projection = backend.project(*primitives, camera, conventions)
    grid = TileGrid(camera.width, camera.height, backend.tile_width, backend.tile_height)
    bins = backend.bin_gaussians(projection, grid, conventions)
    black = np.zeros(WIDTH, channels.dtype)
    passes = []
    for part in _parts(channels):
        output = backend.composite(
            projection, part, black, bins, conventions, with_stats=False, with_median_depth=False
        )
        passes.append((part, output))
    n = channels.shape[1]
    blended = np.concatenate([output.image for _, output in passes], axis=2)[..., :n]
    return blended, BlendTape(primitives, camera, request, projection, bins, tuple(passes), n)


def blend_channels_vjp(tape: BlendTape, v_blended: Floats) -> tuple[Floats, PrimitiveGradient]:
    """Gradient of :func:`blend_channels` with respect to the channels, and to the Gaussians and the pose.

    ::

        v_c_i = sum_p w_i(p) v_F(p),   v_w_i(p) = c_i . v_F(p), a sum over the passes

    Parameters
    ----------
    tape : BlendTape
    v_blended : ndarray of shape (H, W, C)
        Derivative with respect to F.
    """
    backend, conventions, projection = tape.request.backend, tape.request.conventions, tape.projection
    black, no_alpha = np.zeros(WIDTH, v_blended.dtype), np.zeros(v_blended.shape[:2], v_blended.dtype)
    v_channels = []
    v_projection = ProjectionGradient(
        *(np.zeros_like(getattr(projection, name)) for name in ProjectionGradient._fields)
    )
    for (part, output), v_part in zip(tape.passes, _parts(v_blended), strict=True):
        v = backend.composite_vjp(projection, part, black, tape.bins, conventions, output, v_part, no_alpha)
        v_channels.append(v.colors)
        v_projection = v_projection._replace(
            means2d=v_projection.means2d + v.means2d,
            conics=v_projection.conics + v.conics,
            opacities=v_projection.opacities + v.opacities,
        )
    v_primitives = backend.project_vjp(*tape.primitives, tape.camera, conventions, projection, v_projection)
    return np.concatenate(v_channels, axis=1)[:, : tape.n_channels], v_primitives


def _parts(channels: Floats) -> list[Floats]:
    """Return the last axis in contiguous parts of WIDTH, the last one padded with zeros."""
    n = channels.shape[-1]
    padding = [(0, 0)] * (channels.ndim - 1) + [(0, -n % WIDTH)]
    padded = np.pad(channels, padding)
    return [np.ascontiguousarray(padded[..., first : first + WIDTH]) for first in range(0, n, WIDTH)]
