"""The baseline: blending as a textbook writes it, one loop per pixel over the Gaussians of its tile.

This is deliberately the only other implementation of blending besides the reference and the kernels: a careful student
would write it after reading 3DGS, and it measures the gain of the real kernels' design. It is correct, parallel over
tiles, and uses none of their tricks: it has scalar ``math.exp``, branches, 16 x 16 tiles listed by boxes, and a
backward pass from back to front that recovers the transmittance by division. Literals are float64, so float32 data are
blended in float64. Projection, colours and loss are those of the CPU backend, the tile lists those of the reference.
Left out: blend statistics, conventions other than the default's.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.jit.compile import kernel, n_threads, prange
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.types import CompositeGradient, Floats, Ints, Projection, RenderOutput, TileBins


class Splats(NamedTuple):
    """The Gaussians as the loops read them."""

    means2d: Floats
    """[N, 2] pixels."""
    conics: Floats
    """[N, 3] px^-2."""
    opacities: Floats
    """[N]."""
    colors: Floats
    """[N, D]."""


class Tiles(NamedTuple):
    """The tiles and their lists; see :class:`~minisplat_ref.types.TileBins`."""

    offsets: Ints
    """[n_tiles + 1]."""
    ids: Ints
    """[M]."""
    width: int
    """Of a tile, pixels."""
    height: int
    """Pixels."""
    n_x: int
    """Columns of tiles."""


class Thresholds(NamedTuple):
    """Those of the conventions, float64."""

    alpha_min: float
    alpha_max: float
    transmittance_min: float


@kernel()
def _draw(  # type: ignore[no-untyped-def]
    splats,  # Splats
    background,  # [D]
    tiles,  # Tiles
    thresholds,
    image,  # [H, W, D] zeros
    alpha,  # [H, W]
):
    means2d, conics, opacities, colors = splats
    tile_offsets, ids, tile_width, tile_height, n_tiles_x = tiles
    alpha_min, alpha_max, transmittance_min = thresholds
    height, width, n_channels = image.shape
    for tile in prange(tile_offsets.size - 1):
        x0, y0 = tile % n_tiles_x * tile_width, tile // n_tiles_x * tile_height
        for y in range(y0, min(y0 + tile_height, height)):
            for x in range(x0, min(x0 + tile_width, width)):
                T = 1.0
                for m in range(tile_offsets[tile], tile_offsets[tile + 1]):
                    n = ids[m]
                    dx, dy = means2d[n, 0] - (x + 0.5), means2d[n, 1] - (y + 0.5)
                    sigma = 0.5 * (conics[n, 0] * dx * dx + conics[n, 2] * dy * dy) + conics[n, 1] * dx * dy
                    a = min(alpha_max, opacities[n] * math.exp(-sigma))
                    if sigma < 0 or a < alpha_min:
                        continue
                    if T * (1.0 - a) <= transmittance_min:
                        break
                    for k in range(n_channels):
                        image[y, x, k] += a * T * colors[n, k]
                    T *= 1.0 - a
                for k in range(n_channels):
                    image[y, x, k] += T * background[k]
                alpha[y, x] = 1.0 - T


@kernel()
def _differentiate(  # type: ignore[no-untyped-def]
    splats,  # Splats
    background,  # [D]
    tiles,  # Tiles
    thresholds,
    v_image,  # [H, W, D]
    v_alpha,  # [H, W]
    sums,  # [threads, N, 6 + D] zeros
):
    means2d, conics, opacities, colors = splats
    tile_offsets, ids, tile_width, tile_height, n_tiles_x = tiles
    alpha_min, alpha_max, transmittance_min = thresholds
    height, width, n_channels = v_image.shape
    n_workers, n_tiles = sums.shape[0], tile_offsets.size - 1
    for worker in prange(n_workers):
        total = sums[worker]  # each thread has its own array
        for tile in range(worker, n_tiles, n_workers):
            x0, y0 = tile % n_tiles_x * tile_width, tile // n_tiles_x * tile_height
            for y in range(y0, min(y0 + tile_height, height)):
                for x in range(x0, min(x0 + tile_width, width)):
                    T = 1.0
                    end = tile_offsets[tile]
                    for m in range(tile_offsets[tile], tile_offsets[tile + 1]):
                        n = ids[m]
                        dx, dy = means2d[n, 0] - (x + 0.5), means2d[n, 1] - (y + 0.5)
                        sigma = 0.5 * (conics[n, 0] * dx * dx + conics[n, 2] * dy * dy) + conics[n, 1] * dx * dy
                        a = min(alpha_max, opacities[n] * math.exp(-sigma))
                        if sigma < 0 or a < alpha_min:
                            continue
                        if T * (1.0 - a) <= transmittance_min:
                            break
                        T *= 1.0 - a
                        end = m + 1
                    behind = -T * v_alpha[y, x]
                    for k in range(n_channels):
                        behind += T * background[k] * v_image[y, x, k]
                    for m in range(end - 1, tile_offsets[tile] - 1, -1):
                        n = ids[m]
                        dx, dy = means2d[n, 0] - (x + 0.5), means2d[n, 1] - (y + 0.5)
                        sigma = 0.5 * (conics[n, 0] * dx * dx + conics[n, 2] * dy * dy) + conics[n, 1] * dx * dy
                        falloff = math.exp(-sigma)
                        a = min(alpha_max, opacities[n] * falloff)
                        if sigma < 0 or a < alpha_min:
                            continue
                        T /= 1.0 - a
                        shade = 0.0
                        for k in range(n_channels):
                            shade += colors[n, k] * v_image[y, x, k]
                            total[n, 6 + k] += a * T * v_image[y, x, k]
                        v_a = T * shade - behind / (1.0 - a)
                        behind += a * T * shade
                        if opacities[n] * falloff > alpha_max:
                            continue  # a clamped alpha has no derivative
                        v_sigma = -opacities[n] * falloff * v_a
                        total[n, 0] += v_sigma * (conics[n, 0] * dx + conics[n, 1] * dy)
                        total[n, 1] += v_sigma * (conics[n, 1] * dx + conics[n, 2] * dy)
                        total[n, 2] += 0.5 * v_sigma * dx * dx
                        total[n, 3] += v_sigma * dx * dy
                        total[n, 4] += 0.5 * v_sigma * dy * dy
                        total[n, 5] += falloff * v_a


def composite(
    projection: Projection,
    colors: Floats,
    background: Floats,
    bins: TileBins,
    conventions: Conventions,
    *,
    with_stats: bool = False,
    with_median_depth: bool = False,
) -> RenderOutput:
    """Blend every tile's Gaussians front to back; see ``reference.compositing.composite``."""
    if with_stats or with_median_depth:
        raise InputError("the textbook loop collects no statistics: use backend cpu or reference")
    grid = bins.grid
    image = np.zeros((grid.height, grid.width, colors.shape[1]), colors.dtype)
    alpha = np.zeros((grid.height, grid.width), colors.dtype)
    _draw(*_inputs(projection, colors, background, bins, conventions), image, alpha)
    return RenderOutput(image, alpha, None, None)


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
    """Chain the gradient of the image to its inputs; see ``reference.compositing.composite_vjp``."""
    sums = np.zeros((n_threads(), len(colors), 6 + colors.shape[1]), colors.dtype)
    _differentiate(*_inputs(projection, colors, background, bins, conventions), v_image, v_alpha, sums)
    total = sums.sum(axis=0)
    v_background = np.einsum("yx,yxk->k", 1 - output.alpha, v_image).astype(colors.dtype)
    parts = (total[:, :2], total[:, 2:5], total[:, 5], total[:, 6:])
    return CompositeGradient._make([*map(np.ascontiguousarray, parts), v_background])


def _inputs(
    projection: Projection, colors: Floats, background: Floats, bins: TileBins, conventions: Conventions
) -> tuple[Splats, Floats, Tiles, Thresholds]:
    grid = bins.grid
    return (
        Splats(projection.means2d, projection.conics, projection.opacities, colors),
        background,
        Tiles(bins.tile_offsets, bins.gaussian_ids, grid.tile_width, grid.tile_height, grid.n_tiles_x),
        Thresholds(conventions.alpha_min, conventions.alpha_max, conventions.transmittance_min),
    )


TEXTBOOK = replace(
    CPU,
    name="textbook",
    tile_width=REFERENCE.tile_width,
    tile_height=REFERENCE.tile_height,
    bin_gaussians=REFERENCE.bin_gaussians,
    composite=composite,
    composite_vjp=composite_vjp,
)
"""The CPU backend with textbook blending over the reference's tile lists."""
