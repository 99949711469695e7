"""Lists of the Gaussians that touch each tile, front to back, as 3DGS section 6 has them.

There a pair has one key, of tile and depth, and pairs are sorted once. Here Gaussians are sorted by depth first, and
their pairs, written in that order, by tile: the same lists, since the sort is stable, but 13 bits of a pair are sorted
instead of 45. The lists are the reference's, byte for byte. The CPU's kernels also drop the tiles of a box that its
ellipse misses.
"""

from typing import Any

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cuda.arrays import empty, is_on_device, to_device, to_host
from minisplat_ref.cuda.scanning import exclusive_sums
from minisplat_ref.cuda.sorting import initial_order, sort_by_key
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
def gather_counts(counts, order, gathered):
    """Write the counts in another order."""
    i = cuda.grid(1)
    if i < order.shape[0]:
        gathered[i] = counts[order[i]]


@gpu_kernel
def write_pairs(boxes, by_depth, starts, offsets, n_tiles_x, ids, tiles, slots):
    """Write the pairs of the Gaussian that is the i-th by depth, from ``starts[i]`` on; its slots are at its offset."""
    i = cuda.grid(1)
    if i >= by_depth.shape[0]:
        return
    n = by_depth[i]
    column, row, n_columns, n_rows = tiles_of_box(boxes, n)
    for k in range(n_columns * n_rows):
        place, slot = starts[i] + k, offsets[n] + k
        ids[slot] = n
        tiles[place] = (row + k // n_columns) * n_tiles_x + column + k % n_columns
        slots[place] = slot


@gpu_kernel
def gather_pairs(slots, tiles, ids, listed, offsets):
    """Write the Gaussian of the i-th pair of all lists, and the offsets of tiles that begin with it."""
    i, n_pairs = cuda.grid(1), slots.shape[0]
    if i > n_pairs:
        return
    before = tiles[i - 1] if i > 0 else -1
    tile = offsets.shape[0] - 1
    if i < n_pairs:
        listed[i] = ids[slots[i]]
        tile = tiles[i]
    for t in range(before + 1, tile + 1):
        offsets[t] = i


def bin_gaussians(projection: Projection, grid: TileGrid, conventions: Conventions) -> TileBins:
    """List the Gaussians that touch each tile; see ``reference.tiling.bin_gaussians``."""
    n, n_tiles, boxes = len(projection.depths), grid.n_tiles_x * grid.n_tiles_y, to_device(projection.boxes)
    counts, gathered = empty(n, np.int64), empty(n, np.int64)
    launch_rows(count_tiles, n, boxes, counts)
    offsets = exclusive_sums(counts) if n else to_device(np.zeros(1, np.int64))
    n_pairs = int(to_host(offsets[n:])[0])
    check_room(n_pairs * BYTES_PER_PAIR, f"{n_pairs:,} pairs (tile, Gaussian)")
    by_depth = order_by_depth(projection.depths)
    launch_rows(gather_counts, n, counts, by_depth, gathered)
    starts = exclusive_sums(gathered) if n else offsets
    ids, tiles, slots, listed = (empty(n_pairs, np.int32) for _ in range(4))
    tile_offsets = empty(n_tiles + 1, np.int64)
    launch_rows(write_pairs, n, boxes, by_depth, starts, offsets, grid.n_tiles_x, ids, tiles, slots)
    tiles, slots = sort_by_key(tiles, slots, (n_tiles - 1).bit_length())
    launch_rows(gather_pairs, n_pairs + 1, slots, tiles, ids, listed, tile_offsets)
    bins = TileBins(listed, tile_offsets, slots, offsets, grid)
    return bins if is_on_device(projection.depths) else to_host(bins)


def order_by_depth(depths: Any) -> Any:
    """Return the order [N] of Gaussians by depth, which may be negative."""
    n_bits = 8 * depths.dtype.itemsize
    dtype = np.int32 if n_bits == 32 else np.int64
    keys = empty(len(depths), dtype)
    launch_rows(write_keys, len(depths), to_device(depths.view(dtype)), dtype(np.iinfo(dtype).min), keys)
    return sort_by_key(keys, initial_order(len(depths)), n_bits)[1]


@gpu_kernel
def write_keys(bits, sign, keys):
    """Write integers whose order, unsigned, is that of the floats with these bits; both zeros are equal.

    Positive floats are ordered as their bits, negative ones the opposite way. With the sign flipped, the former come
    after the latter.
    """
    i = cuda.grid(1)
    if i < keys.shape[0]:
        key = bits[i]
        if key < 0:
            key = sign - key
        keys[i] = key ^ sign
