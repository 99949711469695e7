"""Lists of the Gaussians that touch each tile, front to back, as 3DGS section 6 makes them: a key per pair, one sort.

The lists are the reference's, byte for byte. The CPU's kernels also drop the tiles of a box that its ellipse misses.
"""

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cuda.arrays import empty, is_on_device, to_device, to_host
from minisplat_ref.cuda.scanning import exclusive_sums
from minisplat_ref.cuda.sorting import sort_pairs
from minisplat_ref.cuda.target import check_room, cuda, device_function, gpu_kernel, launch_rows
from minisplat_ref.memory import BYTES_PER_PAIR
from minisplat_ref.types import Projection, TileBins, TileGrid

TILE = 16  # pixels, width and height: a block of 256 threads


@device_function
def tiles_of_box(boxes, n):
    """Return first column and row of the tiles under a box of pixels, and numbers of columns and rows; 0 if empty."""
    x0, y0, x1, y1 = boxes[n, 0], boxes[n, 1], boxes[n, 2], boxes[n, 3]
    column, row = x0 // TILE, y0 // TILE
    n_columns = (x1 + TILE - 1) // TILE - column if x1 > x0 else 0
    n_rows = (y1 + TILE - 1) // TILE - row if y1 > y0 else 0
    return column, row, n_columns, n_rows


@gpu_kernel
def count_tiles(boxes, counts):
    """Write the number of tiles under the box of one Gaussian."""
    n = cuda.grid(1)
    if n < counts.shape[0]:
        _, _, n_columns, n_rows = tiles_of_box(boxes, n)
        counts[n] = n_columns * n_rows


@gpu_kernel
def write_pairs(boxes, depth_bits, offsets, n_tiles_x, ids, tiles, bits):
    """Write the pairs of one Gaussian, from ``offsets[n]`` on."""
    n = cuda.grid(1)
    if n >= offsets.shape[0] - 1:
        return
    column, row, n_columns, n_rows = tiles_of_box(boxes, n)
    for k in range(n_columns * n_rows):
        place = offsets[n] + k
        ids[place] = n
        tiles[place] = (row + k // n_columns) * n_tiles_x + column + k % n_columns
        bits[place] = depth_bits[n]


@gpu_kernel
def gather_pairs(order, ids, tiles, listed, offsets):
    """Write the Gaussian of the i-th pair of all lists, and the offsets of tiles that begin with it."""
    i, n_pairs = cuda.grid(1), order.shape[0]
    if i > n_pairs:
        return
    before = tiles[order[i - 1]] if i > 0 else -1
    tile = offsets.shape[0] - 1
    if i < n_pairs:
        listed[i] = ids[order[i]]
        tile = tiles[order[i]]
    for t in range(before + 1, tile + 1):
        offsets[t] = i


def bin_gaussians(projection: Projection, grid: TileGrid, conventions: Conventions) -> TileBins:
    """List the Gaussians that touch each tile; see ``reference.tiling.bin_gaussians``."""
    n, n_tiles, boxes = len(projection.depths), grid.n_tiles_x * grid.n_tiles_y, to_device(projection.boxes)
    counts = empty(n, np.int64)
    launch_rows(count_tiles, n, boxes, counts)
    offsets = exclusive_sums(counts) if n else to_device(np.zeros(1, np.int64))
    n_pairs = int(to_host(offsets[n:])[0])
    check_room(n_pairs * BYTES_PER_PAIR, f"{n_pairs:,} pairs (tile, Gaussian)")
    depth_bits = projection.depths.view(np.int32 if projection.depths.dtype == np.float32 else np.int64)
    ids, tiles, bits = empty(n_pairs, np.int32), empty(n_pairs, np.int32), empty(n_pairs, depth_bits.dtype)
    launch_rows(write_pairs, n, boxes, to_device(depth_bits), offsets, grid.n_tiles_x, ids, tiles, bits)
    order, listed, tile_offsets = (
        sort_pairs(tiles, bits, n_tiles),
        empty(n_pairs, np.int32),
        empty(n_tiles + 1, np.int64),
    )
    launch_rows(gather_pairs, n_pairs + 1, order, ids, tiles, listed, tile_offsets)
    bins = TileBins(listed, tile_offsets, order, offsets, grid)
    return bins if is_on_device(projection.depths) else to_host(bins)
