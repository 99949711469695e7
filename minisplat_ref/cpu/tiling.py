"""Lists of the Gaussians that touch each tile, front to back.

The Gaussians are sorted once, by depth; the pairs (tile, Gaussian) never are. A counting pass and a filling pass go
over the sorted Gaussians in a fixed number of chunks: with the counts of each chunk in each tile known, every chunk
knows where in each tile's list its pairs start, so the chunks fill the lists independently and the order in each is
by depth.

A pair is made only where the visible ellipse reaches a pixel centre of the tile, row of tiles by row of tiles; that
drops most of the pairs that the bounding box of an oblique ellipse would give.
"""

import math

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.sorting import depth_order
from minisplat_ref.scalar._jit import kernel, prange
from minisplat_ref.scalar.literals import HALF, ZERO
from minisplat_ref.scalar.tiling import rightmost_offset, support
from minisplat_ref.types import Projection, TileBins, TileGrid

TILE_WIDTH = 8  # one row of a tile is one AVX2 register of float32; divides INRIA's 16
TILE_HEIGHT = 16
N_CHUNKS = 16  # fixed, so that the lists do not depend on the number of threads
MARGIN = np.float32(0.02)  # px and relative: rounding must not lose a pixel that the compositor would blend
OBLIQUE_MIN = np.float32(1e-3)  # det / (a c) below this has lost its digits in float32: fall back to the box


@kernel()
def _count_or_fill(projection, order, alpha_min, n_tiles_x, offsets, gaussian_offsets, ids, slots):
    fills = ids.size > 0
    for chunk in prange(N_CHUNKS):
        for rank in range(order.size * chunk // N_CHUNKS, order.size * (chunk + 1) // N_CHUNKS):
            n = order[rank]
            x0, y0, x1, y1 = (
                projection.boxes[n, 0],
                projection.boxes[n, 1],
                projection.boxes[n, 2],
                projection.boxes[n, 3],
            )
            mx, my = projection.means2d[n, 0], projection.means2d[n, 1]
            a, b, c = projection.conics[n, 0], projection.conics[n, 1], projection.conics[n, 2]
            q = support(projection.opacities[n], alpha_min)
            q += MARGIN * (q + MARGIN)
            det = a * c - b * b
            is_ellipse = det > OBLIQUE_MIN * a * c
            half_height = math.sqrt(max(q * a / det, ZERO)) if is_ellipse else ZERO * a
            n_pairs = 0
            for row in range(y0 // TILE_HEIGHT, (y1 - 1) // TILE_HEIGHT + 1):
                first, last = x0, x1
                if is_ellipse:
                    low = max(row * TILE_HEIGHT, y0) + HALF - my
                    high = min((row + 1) * TILE_HEIGHT, y1) - HALF - my
                    if low > half_height or high < -half_height:
                        continue
                    low = max(low, -half_height)
                    high = min(high, half_height)
                    right = mx + rightmost_offset(a, b, c, det, q, low, high) + MARGIN
                    left = mx - rightmost_offset(a, b, c, det, q, -high, -low) - MARGIN
                    first = max(first, math.ceil(max(left - HALF, ZERO)))
                    last = min(last, math.floor(min(right + HALF, x1)))
                    if first >= last:
                        continue
                for column in range(first // TILE_WIDTH, (last - 1) // TILE_WIDTH + 1):
                    tile = row * n_tiles_x + column
                    if fills:
                        place = offsets[chunk, tile]
                        offsets[chunk, tile] = place + 1
                        ids[place] = n
                        slots[place] = gaussian_offsets[n] + n_pairs
                    else:
                        offsets[chunk, tile] += 1
                    n_pairs += 1
            if not fills:
                gaussian_offsets[n + 1] = n_pairs


@kernel(parallel=False)
def _starts_from_counts(counts, tile_offsets):
    total = 0
    for tile in range(counts.shape[1]):
        tile_offsets[tile] = total
        for chunk in range(counts.shape[0]):
            count = counts[chunk, tile]
            counts[chunk, tile] = total
            total += count
    tile_offsets[counts.shape[1]] = total


def bin_gaussians(projection: Projection, grid: TileGrid, conventions: Conventions) -> TileBins:
    """List the Gaussians that touch each tile; see ``reference.tiling.bin_gaussians``.

    Pairs in which no pixel centre of the tile can reach ``conventions.alpha_min`` are left out.
    """
    n_tiles = grid.n_tiles_x * grid.n_tiles_y
    order = depth_order(projection.depths, projection.radii)
    alpha_min = projection.depths.dtype.type(conventions.alpha_min)
    starts = np.zeros((N_CHUNKS, n_tiles), np.int64)
    tile_offsets = np.empty(n_tiles + 1, np.int64)
    gaussian_offsets = np.zeros(len(projection.depths) + 1, np.int64)
    nothing = np.empty(0, np.int32)
    _count_or_fill(projection, order, alpha_min, grid.n_tiles_x, starts, gaussian_offsets, nothing, nothing)
    _starts_from_counts(starts, tile_offsets)
    np.cumsum(gaussian_offsets, out=gaussian_offsets)
    ids = np.empty(tile_offsets[-1], np.int32)
    slots = np.empty(tile_offsets[-1], np.int32)
    if ids.size:
        _count_or_fill(projection, order, alpha_min, grid.n_tiles_x, starts, gaussian_offsets, ids, slots)
    return TileBins(ids, tile_offsets, slots, gaussian_offsets, grid)
