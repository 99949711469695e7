"""Lists of the Gaussians that touch each tile, front to back.

The pairs (tile, Gaussian) are never sorted. The Gaussians are dealt into layers of about equal numbers, each behind the
one before; when it is known how many pairs each layer has in each tile, every layer knows where in each tile's list its
pairs start, so that the layers are sorted by depth and written into the lists independently. Three passes:

1. The survey counts the Gaussians of each part of the input by depth, which says where layers begin.
2. Every part finds the tiles of its Gaussians, in the order of the input, and enters each Gaussian into its layer.
3. Every layer is sorted, and fills the lists. Its tiles fit the second-level cache, where random access is cheap; what
   else is needed of a Gaussian is asked for ahead, since memory answers slowly.

Parts and layers are fixed in number, so that no result depends on the number of threads.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.footprints import ELLIPSE_MARGIN, SPARE, TILE_HEIGHT, TILE_WIDTH, tiles_of_box, write_tiles
from minisplat_ref.cpu.sorting import DIGIT_BITS, sort_stably
from minisplat_ref.scalar._jit import kernel, n_threads, prange, scalar
from minisplat_ref.scalar.lanes import WIDTH, prefetch
from minisplat_ref.types import Ints, Projection, TileBins, TileGrid

__all__ = ["ELLIPSE_MARGIN", "TILE_HEIGHT", "TILE_WIDTH", "bin_gaussians"]

N_PARTS = 16  # of the input, and as many layers
BUCKET_SHIFT = 18  # of the bits of a float32: 32 buckets of depth to a factor of two
N_BUCKETS = 1 << (31 - BUCKET_SHIFT)
VISIBLE, TILES = 0, 1  # columns of a count: Gaussians, and tiles under their boxes
FIRST, COUNT, SLOT, PART = range(4)  # columns of a record: the cells of a Gaussian, and its first slot within a part
FETCH_AHEAD = 16  # Gaussians


class Layers(NamedTuple):
    """The visible Gaussians, layer by layer, and within a layer in the order of the input.

    A cell is one tile in one layer.
    """

    keys: Ints
    """[N] bits of the depths: positive floats are ordered as their bits are."""
    ids: Ints
    """[N] int32."""
    cells: Ints
    """layer * n_tiles + tile of each pair, int32; between the parts of a layer places are left over."""


@scalar
def _bucket(depth):
    return np.float32(depth).view(np.int32) >> BUCKET_SHIFT


@scalar
def _survey_part(start, end, boxes, depths, up_to):
    """Count the visible Gaussians below each bucket, and the tiles under their boxes."""
    up_to[:] = 0
    for n in range(start, end):
        _, _, n_columns, n_rows = tiles_of_box(boxes, n)
        behind = _bucket(depths[n]) + 1
        up_to[behind, VISIBLE] += n_columns > 0
        up_to[behind, TILES] += n_columns * n_rows
    for bucket in range(N_BUCKETS):
        for column in (VISIBLE, TILES):
            up_to[bucket + 1, column] += up_to[bucket, column]


@kernel()
def _survey(boxes, depths, n_threads, up_to):
    n = depths.size
    for thread in prange(n_threads):
        for part in range(thread, N_PARTS, n_threads):
            _survey_part(n * part // N_PARTS, n * (part + 1) // N_PARTS, boxes, depths, up_to[part])


@scalar
def _list_part(part, projection, keys, alpha_min, n_tiles_x, layer_of, cursors, layers, records, offsets, counts):
    """Enter each Gaussian of a part into its layer, and count the pairs of each cell."""
    boxes, depths, n_tiles, slot = projection.boxes, projection.depths, counts.size // N_PARTS, 0
    scratch, first_cells = np.empty(WIDTH, depths.dtype), cursors[:, TILES].copy()
    for n in range(keys.size * part // N_PARTS, keys.size * (part + 1) // N_PARTS):
        if (boxes[n, 0] < boxes[n, 2]) & (boxes[n, 1] < boxes[n, 3]):
            layer = layer_of[_bucket(depths[n])]
            row, first = cursors[layer, VISIBLE], cursors[layer, TILES]
            end = write_tiles(n, projection, alpha_min, n_tiles_x, layer * n_tiles, scratch, layers.cells, first)
            cursors[layer, VISIBLE], cursors[layer, TILES] = row + 1, end
            layers.keys[row], layers.ids[row] = keys[n], n
            records[n, FIRST], records[n, COUNT], records[n, SLOT], records[n, PART] = first, end - first, slot, part
            slot += end - first
        offsets[n + 1] = slot
    for layer in range(N_PARTS):
        for i in range(first_cells[layer], cursors[layer, TILES]):
            counts[layers.cells[i]] += 1


@kernel()
def _list_parts(projection, keys, alpha_min, n_tiles_x, layer_of, cursors, layers, records, offsets, counts):
    n_threads = counts.shape[0]
    for thread in prange(n_threads):
        for part in range(thread, N_PARTS, n_threads):
            _list_part(
                part, projection, keys, alpha_min, n_tiles_x, layer_of, cursors[part], layers, records, offsets,
                counts[thread],
            )  # fmt: skip


@scalar
def _fill_layer(layer, edges, layers, records, first_slots, offsets, other_keys, other_ids, digits, starts, ids, slots):
    """Sort one layer and write its pairs."""
    cells, n = layers.cells, other_keys.size
    for i in range(n * layer // N_PARTS, n * (layer + 1) // N_PARTS):
        offsets[i + 1] += first_slots[layer]  # of the part of the same number
    own = slice(edges[layer], edges[layer + 1])
    in_order = sort_stably(layers.keys[own], layers.ids[own], other_keys[own], other_ids[own], digits)
    for i in range(in_order.size):
        prefetch(records, in_order[min(i + FETCH_AHEAD, in_order.size - 1)])
        n = in_order[i]
        first, slot = records[n, FIRST], records[n, SLOT] + first_slots[records[n, PART]]
        for k in range(records[n, COUNT]):
            place = starts[cells[first + k]]
            starts[cells[first + k]] = place + 1
            ids[place] = n
            slots[place] = slot + k


@kernel()
def _fill_layers(edges, layers, records, first_slots, offsets, other_keys, other_ids, digits, starts, ids, slots):
    n_threads = digits.shape[0]
    for thread in prange(n_threads):
        for layer in range(thread, N_PARTS, n_threads):
            _fill_layer(
                layer, edges, layers, records, first_slots, offsets, other_keys, other_ids, digits[thread], starts, ids,
                slots,
            )  # fmt: skip


def _cut_layers(up_to: Ints) -> tuple[Ints, Ints]:
    """Cut the buckets into layers of about equal numbers of Gaussians.

    Parameters
    ----------
    up_to : ndarray of shape (N_PARTS, N_BUCKETS + 1, 2)
        Gaussians of each part below each bucket, and tiles.

    Returns
    -------
    layer_of : ndarray of shape (N_BUCKETS,), int32
        Layer of each bucket.
    edges : ndarray of shape (N_PARTS * N_PARTS + 1, 2)
        Where the Gaussians of each layer and part start in the records, and their tiles in the cells; and the ends.
    """
    total = up_to[:, :, VISIBLE].sum(axis=0, dtype=np.int32)
    wanted = int(total[-1]) * np.arange(1, N_PARTS) // N_PARTS  # Gaussians in front of the second layer, and so on
    cuts = np.concatenate([[0], np.searchsorted(total, wanted), [N_BUCKETS]])
    layer_of = np.repeat(np.arange(N_PARTS, dtype=np.int32), np.diff(cuts))
    sizes = np.diff(up_to[:, cuts], axis=1).swapaxes(0, 1).reshape(-1, 2)  # by layer and part
    return layer_of, np.concatenate([[[0, 0]], np.cumsum(sizes + np.array([0, SPARE]), axis=0)])


def _list_starts(counts: Ints) -> tuple[Ints, Ints]:
    """Where each tile's list starts, and where each layer starts in it.

    Parameters
    ----------
    counts : ndarray of shape (threads, N_PARTS * n_tiles)
        Pairs of each layer and tile; how they are spread over the threads does not matter.

    Returns
    -------
    tile_offsets : ndarray of shape (n_tiles + 1,), int64
    starts : ndarray of shape (N_PARTS * n_tiles,), int32
    """
    of_layers = counts.sum(axis=0, dtype=np.int32).reshape(N_PARTS, -1)
    up_to = np.cumsum(of_layers, axis=0, dtype=np.int32)
    tile_offsets = np.append(0, np.cumsum(up_to[-1], dtype=np.int64))
    return tile_offsets, (up_to - of_layers + tile_offsets[:-1].astype(np.int32)).ravel()


def bin_gaussians(projection: Projection, grid: TileGrid, conventions: Conventions) -> TileBins:
    """List the Gaussians that touch each tile; see ``reference.tiling.bin_gaussians``.

    Of the tiles under a Gaussian's box, those are left out in which no pixel centre can reach
    ``conventions.alpha_min``; a box within one row or one column of tiles is not looked at so closely.
    """
    n, n_tiles = len(projection.depths), grid.n_tiles_x * grid.n_tiles_y
    dtype: np.dtype = projection.depths.dtype
    up_to = np.empty((N_PARTS, N_BUCKETS + 1, 2), np.int32)
    _survey(projection.boxes, projection.depths, n_threads(), up_to)
    layer_of, edges = _cut_layers(up_to)

    keys = projection.depths.view(np.int32 if dtype == np.float32 else np.int64)
    ids, other_ids = np.empty((2, n), np.int32)
    layers = Layers(np.empty_like(keys), ids, np.empty(edges[-1, TILES], np.int32))
    records = np.empty((n, 4), np.int32)
    offsets = np.empty(n + 1, np.int64)
    offsets[0] = 0
    counts = np.zeros((n_threads(), N_PARTS * n_tiles), np.int32)
    cursors = edges[:-1].reshape(N_PARTS, N_PARTS, 2).swapaxes(0, 1).copy()  # by part and layer
    alpha_min = dtype.type(conventions.alpha_min)
    _list_parts(projection, keys, alpha_min, grid.n_tiles_x, layer_of, cursors, layers, records, offsets, counts)

    tile_offsets, starts = _list_starts(counts)
    part_edges = n * np.arange(N_PARTS + 1) // N_PARTS
    n_pairs = np.where(np.diff(part_edges) > 0, offsets[part_edges[1:]], 0)  # offsets count within each part so far
    first_slots = np.cumsum(n_pairs) - n_pairs
    ids, slots = np.empty((2, tile_offsets[-1]), np.int32)
    digits = np.empty((n_threads(), 1 << DIGIT_BITS), np.int32)
    layer_edges, other_keys = edges[::N_PARTS, VISIBLE].copy(), np.empty_like(keys)
    _fill_layers(layer_edges, layers, records, first_slots, offsets, other_keys, other_ids, digits, starts, ids, slots)
    return TileBins(ids, tile_offsets, slots, offsets, grid)
