"""Lists of the Gaussians that touch each tile, front to back.

The pairs (tile, Gaussian) are never sorted. The Gaussians are dealt into layers of about equal numbers, each behind the
one before; when it is known how many pairs each layer has in each tile, every layer knows where in each tile's list its
pairs start, so that the layers are sorted by depth and written into the lists independently. Three passes:

1. The survey counts the Gaussians of each part of the input by depth, which says where layers begin.
2. Every part finds the tiles of its Gaussians, in the order of the input, and notes a record of each in its layer.
3. Every layer is sorted, and fills the lists. Its records fit the second-level cache, where random access is cheap.

Parts and layers are fixed in number, so that no result depends on the number of threads.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.footprints import (
    BLOCK,
    ELLIPSE_MARGIN,
    FIRST,
    N_NOTES,
    N_TILES,
    STEP,
    TILE_HEIGHT,
    TILE_WIDTH,
    room_for_tiles,
    write_footprints,
)
from minisplat_ref.cpu.sorting import DIGIT_BITS, sort_stably
from minisplat_ref.scalar._jit import kernel, n_threads, prange, scalar
from minisplat_ref.types import Ints, Projection, TileBins, TileGrid

__all__ = ["ELLIPSE_MARGIN", "TILE_HEIGHT", "TILE_WIDTH", "bin_gaussians"]

N_PARTS = 16  # of the input, and as many layers
BUCKET_SHIFT = 18  # of the bits of a float32: 32 buckets of depth to a factor of two
N_BUCKETS = 1 << (31 - BUCKET_SHIFT)
GAUSSIAN, SLOT = 3, 4  # columns of a record, behind those of a footprint; the slot is the Gaussian's first
N_COLUMNS = 5


class Layers(NamedTuple):
    """What is noted about the visible Gaussians, layer by layer, and within a layer in the order of the input."""

    keys: Ints
    """[N] bits of the depths: positive floats are ordered as their bits are."""
    records: Ints
    """[N, N_COLUMNS] int32."""
    tiles: Ints
    """Tiles of the footprints that are written out."""
    edges: Ints
    """[N_PARTS, N_PARTS + 1] where in each layer the records of each part start, and where the layer ends."""
    notes: Ints
    """[threads, BLOCK, N_NOTES] int32 scratch."""


@scalar
def _bucket(depth):
    return np.float32(depth).view(np.int32) >> BUCKET_SHIFT


@scalar
def _count_depths(start, end, boxes, depths, up_to):
    """Count the visible Gaussians below each bucket; the last entry is their number."""
    up_to[:] = 0
    for n in range(start, end):
        up_to[_bucket(depths[n]) + 1] += (boxes[n, 0] < boxes[n, 2]) & (boxes[n, 1] < boxes[n, 3])
    for bucket in range(N_BUCKETS):
        up_to[bucket + 1] += up_to[bucket]


@kernel()
def _survey(boxes, depths, n_threads, up_to, rooms):
    n = depths.size
    for thread in prange(n_threads):
        for part in range(thread, N_PARTS, n_threads):
            start, end = n * part // N_PARTS, n * (part + 1) // N_PARTS
            rooms[part] = room_for_tiles(start, end, boxes)
            _count_depths(start, end, boxes, depths, up_to[part])


@scalar
def _list_part(
    part, thread, projection, keys, alpha_min, n_tiles_x, places, layer_of, all_cursors, layers, offsets, all_counts
):
    """Write a record of each Gaussian of a part into its layer, and count the pairs of each layer and tile."""
    depths, cursors, counts = projection.depths, all_cursors[part], all_counts[thread]
    layer_keys, records, tiles, notes = layers.keys, layers.records, layers.tiles, layers.notes[thread]
    place, slot = places[part], 0
    end = keys.size * (part + 1) // N_PARTS
    for first_n in range(keys.size * part // N_PARTS, end, BLOCK):
        end_n = min(first_n + BLOCK, end)
        place = write_footprints(first_n, end_n, projection, alpha_min, n_tiles_x, notes, tiles, place)
        for n in range(first_n, end_n):
            first, step, n_tiles = notes[n - first_n, FIRST], notes[n - first_n, STEP], notes[n - first_n, N_TILES]
            if n_tiles >= 0:
                layer = layer_of[_bucket(depths[n])]
                for k in range(n_tiles):
                    counts[layer, first + k * step if step > 0 else tiles[first + k]] += 1
                cursor = cursors[layer]
                cursors[layer] = cursor + 1
                layer_keys[cursor] = keys[n]
                records[cursor, FIRST], records[cursor, STEP], records[cursor, N_TILES] = first, step, n_tiles
                records[cursor, GAUSSIAN], records[cursor, SLOT] = n, slot
                slot += n_tiles
            offsets[n + 1] = slot


@kernel()
def _list_parts(projection, keys, alpha_min, n_tiles_x, places, layer_of, cursors, layers, offsets, counts):
    n_threads = counts.shape[0]
    for thread in prange(n_threads):
        for part in range(thread, N_PARTS, n_threads):
            _list_part(
                part, thread, projection, keys, alpha_min, n_tiles_x, places, layer_of, cursors, layers, offsets, counts
            )


@scalar
def _fill_layer(
    layer, thread, layers, first_slots, offsets, other_keys, rows, other_rows, digits, all_starts, ids, slots
):
    """Sort one layer and write its pairs."""
    records, tiles, notes, starts = layers.records, layers.tiles, layers.notes[thread], all_starts[layer]
    n = other_keys.size
    for i in range(n * layer // N_PARTS, n * (layer + 1) // N_PARTS):
        offsets[i + 1] += first_slots[layer]  # of the part of the same number
    for part in range(N_PARTS):
        for row in range(layers.edges[layer, part], layers.edges[layer, part + 1]):
            records[row, SLOT] += first_slots[part]
            rows[row] = row
    own = slice(layers.edges[layer, 0], layers.edges[layer, N_PARTS])
    in_order = sort_stably(layers.keys[own], rows[own], other_keys[own], other_rows[own], digits[thread])
    for first_row in range(0, in_order.size, BLOCK):
        n_rows = min(BLOCK, in_order.size - first_row)
        for i in range(n_rows):  # without branches, so that the cache is waited for many times at once
            for column in range(N_COLUMNS):
                notes[i, column] = records[in_order[first_row + i], column]
        for i in range(n_rows):
            first, step, n, slot = notes[i, FIRST], notes[i, STEP], notes[i, GAUSSIAN], notes[i, SLOT]
            for k in range(notes[i, N_TILES]):
                tile = first + k * step if step > 0 else tiles[first + k]
                place = starts[tile]
                starts[tile] = place + 1
                ids[place] = n
                slots[place] = slot + k


@kernel()
def _fill_layers(layers, first_slots, offsets, other_keys, rows, other_rows, digits, starts, ids, slots):
    n_threads = digits.shape[0]
    for thread in prange(n_threads):
        for layer in range(thread, N_PARTS, n_threads):
            _fill_layer(
                layer, thread, layers, first_slots, offsets, other_keys, rows, other_rows, digits, starts, ids, slots
            )


def _cut_layers(up_to: Ints) -> tuple[Ints, Ints]:
    """Cut the buckets into layers of about equal numbers of Gaussians.

    Parameters
    ----------
    up_to : ndarray of shape (N_PARTS, N_BUCKETS + 1)
        Gaussians of each part below each bucket.

    Returns
    -------
    layer_of : ndarray of shape (N_BUCKETS,), int32
        Layer of each bucket.
    edges : ndarray of shape (N_PARTS, N_PARTS + 1)
        As in :class:`Layers`.
    """
    total = up_to.sum(axis=0, dtype=np.int32)
    wanted = int(total[-1]) * np.arange(1, N_PARTS) // N_PARTS  # Gaussians in front of the second layer, and so on
    cuts = np.concatenate([[0], np.searchsorted(total, wanted), [N_BUCKETS]])
    layer_of = np.repeat(np.arange(N_PARTS, dtype=np.int32), np.diff(cuts))
    ends = np.cumsum(np.diff(up_to[:, cuts], axis=1).T).reshape(N_PARTS, N_PARTS)  # [layer, part]
    return layer_of, np.column_stack([np.append(0, ends[:-1, -1]), ends])


def _list_starts(counts: Ints) -> tuple[Ints, Ints]:
    """Where each tile's list starts, and where each layer starts in it.

    Parameters
    ----------
    counts : ndarray of shape (threads, N_PARTS, n_tiles)
        Pairs of each layer and tile; how they are spread over the threads does not matter.

    Returns
    -------
    tile_offsets : ndarray of shape (n_tiles + 1,), int64
    starts : ndarray of shape (N_PARTS, n_tiles), int32
    """
    of_layers = counts.sum(axis=0, dtype=np.int32)
    up_to = np.cumsum(of_layers, axis=0, dtype=np.int32)
    tile_offsets = np.append(0, np.cumsum(up_to[-1], dtype=np.int64))
    return tile_offsets, up_to - of_layers + tile_offsets[:-1].astype(np.int32)


def bin_gaussians(projection: Projection, grid: TileGrid, conventions: Conventions) -> TileBins:
    """List the Gaussians that touch each tile; see ``reference.tiling.bin_gaussians``.

    Of the tiles under a Gaussian's box, those are left out in which no pixel centre can reach
    ``conventions.alpha_min``; a box within one tile is not looked at so closely.
    """
    n, n_tiles = len(projection.depths), grid.n_tiles_x * grid.n_tiles_y
    dtype: np.dtype = projection.depths.dtype
    up_to, rooms = np.empty((N_PARTS, N_BUCKETS + 1), np.int32), np.empty(N_PARTS, np.int64)
    _survey(projection.boxes, projection.depths, n_threads(), up_to, rooms)
    layer_of, edges = _cut_layers(up_to)

    keys = projection.depths.view(np.int32 if dtype == np.float32 else np.int64)
    layers = Layers(
        keys=np.empty_like(keys),
        records=np.empty((n, N_COLUMNS), np.int32),
        tiles=np.empty(rooms.sum(), np.int32),
        edges=edges,
        notes=np.empty((n_threads(), BLOCK, N_NOTES), np.int32),
    )
    offsets = np.empty(n + 1, np.int64)
    offsets[0] = 0
    counts = np.zeros((n_threads(), N_PARTS, n_tiles), np.int32)
    places, cursors = np.cumsum(rooms) - rooms, edges[:, :-1].T.copy()
    alpha_min = dtype.type(conventions.alpha_min)
    _list_parts(projection, keys, alpha_min, grid.n_tiles_x, places, layer_of, cursors, layers, offsets, counts)

    tile_offsets, starts = _list_starts(counts)
    part_edges = n * np.arange(N_PARTS + 1) // N_PARTS
    n_pairs = np.where(np.diff(part_edges) > 0, offsets[part_edges[1:]], 0)  # offsets count within each part so far
    ids, slots, rows, other_rows = (np.empty(size, np.int32) for size in (*[tile_offsets[-1]] * 2, n, n))
    digits = np.empty((n_threads(), 1 << DIGIT_BITS), np.int32)
    first_slots = np.cumsum(n_pairs) - n_pairs
    _fill_layers(layers, first_slots, offsets, np.empty_like(keys), rows, other_rows, digits, starts, ids, slots)
    return TileBins(ids, tile_offsets, slots, offsets, grid)
