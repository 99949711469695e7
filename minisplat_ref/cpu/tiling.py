"""Lists of the Gaussians that touch each tile, front to back.

The Gaussians are sorted once, by depth; the pairs (tile, Gaussian) never are. A fixed number of chunks of the sorted
Gaussians each write down the tiles of their Gaussians and count them per tile. With the counts of all chunks known,
every chunk knows where in each tile's list its pairs start, so that the chunks fill the lists independently, and the
order in each list is by depth.

A pair is made only where the visible ellipse reaches a pixel centre of the tile, row of tiles by row of tiles; that
drops most of the pairs that the bounding box of an oblique ellipse would give.
"""

import math

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.sorting import depth_order
from minisplat_ref.scalar._jit import kernel, prange, scalar
from minisplat_ref.scalar.compositing import factors
from minisplat_ref.scalar.literals import HALF, ZERO
from minisplat_ref.scalar.tiling import rightmost_offset, visible_ellipse
from minisplat_ref.types import Ints, Projection, TileBins, TileGrid

TILE_WIDTH = 32
TILE_HEIGHT = 16
N_CHUNKS = 16  # fixed, so that the lists do not depend on the number of threads
ELLIPSE_MARGIN = np.float32(0.02)  # px and relative: rounding must not lose a pixel that the compositor would blend


@scalar
def _columns(ellipse, mx, low, high, x0, x1):
    """Tile columns, half-open, that the ellipse reaches in a band of rows at low <= dy <= high."""
    if low > ellipse.half_height or high < -ellipse.half_height:
        return 0, 0
    low = max(low, -ellipse.half_height)
    high = min(high, ellipse.half_height)
    right = mx + rightmost_offset(ellipse, low, high, 1) + ELLIPSE_MARGIN
    left = mx - rightmost_offset(ellipse, low, high, -1) - ELLIPSE_MARGIN
    first = max(x0, math.ceil(max(left - HALF, ZERO)))
    end = min(x1, math.floor(min(right + HALF, x1)))
    return (first // TILE_WIDTH, (end - 1) // TILE_WIDTH + 1) if first < end else (0, 0)


@scalar
def _write_tiles(n, projection, alpha_min, n_tiles_x, tiles, place, counts):
    """Write the tiles of one Gaussian from ``place`` on and count them; return how many there are."""
    x0, y0, x1, y1 = projection.boxes[n, 0], projection.boxes[n, 1], projection.boxes[n, 2], projection.boxes[n, 3]
    mx, my = projection.means2d[n, 0], projection.means2d[n, 1]
    a, slope, pivot = factors(projection.conics[n, 0], projection.conics[n, 1], projection.conics[n, 2])
    ellipse = visible_ellipse(a, slope, pivot, projection.opacities[n], alpha_min, ELLIPSE_MARGIN)
    n_pairs = 0
    for row in range(y0 // TILE_HEIGHT, (y1 - 1) // TILE_HEIGHT + 1):
        low = max(row * TILE_HEIGHT, y0) + HALF - my
        high = min((row + 1) * TILE_HEIGHT, y1) - HALF - my
        first, end = _columns(ellipse, mx, low, high, x0, x1)
        for column in range(first, end):
            tile = row * n_tiles_x + column
            tiles[place + n_pairs] = tile
            counts[tile] += 1
            n_pairs += 1
    return n_pairs


@kernel()
def _list_tiles(projection, order, alpha_min, n_tiles_x, chunk_starts, tiles, counts, n_pairs):
    for chunk in prange(N_CHUNKS):
        place = chunk_starts[chunk]
        for rank in range(order.size * chunk // N_CHUNKS, order.size * (chunk + 1) // N_CHUNKS):
            n = order[rank]
            n_pairs[n] = _write_tiles(n, projection, alpha_min, n_tiles_x, tiles, place, counts[chunk])
            place += n_pairs[n]


@kernel()
def _fill(order, chunk_starts, tiles, starts, gaussian_offsets, ids, slots):
    for chunk in prange(N_CHUNKS):
        source = chunk_starts[chunk]
        for rank in range(order.size * chunk // N_CHUNKS, order.size * (chunk + 1) // N_CHUNKS):
            n = order[rank]
            for slot in range(gaussian_offsets[n], gaussian_offsets[n + 1]):
                place = starts[chunk, tiles[source]]
                starts[chunk, tiles[source]] = place + 1
                source += 1
                ids[place] = n
                slots[place] = slot


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
    chunk_starts = _room_for_boxes(projection.boxes[order])
    tiles = np.empty(chunk_starts[-1], np.int32)
    starts = np.zeros((N_CHUNKS, n_tiles), np.int64)
    tile_offsets = np.empty(n_tiles + 1, np.int64)
    gaussian_offsets = np.zeros(len(projection.depths) + 1, np.int64)
    alpha_min = projection.depths.dtype.type(conventions.alpha_min)
    _list_tiles(projection, order, alpha_min, grid.n_tiles_x, chunk_starts, tiles, starts, gaussian_offsets[1:])
    _starts_from_counts(starts, tile_offsets)
    np.cumsum(gaussian_offsets, out=gaussian_offsets)
    ids = np.empty(tile_offsets[-1], np.int32)
    slots = np.empty(tile_offsets[-1], np.int32)
    _fill(order, chunk_starts, tiles, starts, gaussian_offsets, ids, slots)
    return TileBins(ids, tile_offsets, slots, gaussian_offsets, grid)


def _room_for_boxes(boxes: Ints) -> Ints:
    """Where each chunk of the sorted boxes starts to write, with room for every tile under its boxes."""
    columns = (boxes[:, 2] - 1) // TILE_WIDTH - boxes[:, 0] // TILE_WIDTH + 1
    rows = (boxes[:, 3] - 1) // TILE_HEIGHT - boxes[:, 1] // TILE_HEIGHT + 1
    room = np.concatenate([[0], np.cumsum(columns.astype(np.int64) * rows)])
    return room[len(boxes) * np.arange(N_CHUNKS + 1) // N_CHUNKS]
