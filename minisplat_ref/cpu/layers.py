"""The loops behind the tile lists: the survey, the parts of the input that enter Gaussians into layers, the layers.

:mod:`minisplat_ref.cpu.tiling` tells the plan. A guess that fails and memory that answers late are dear. So there are
no branches on what cannot be foreseen: the culled are a layer of their own, behind all others, and boxes that are wide
are listed first and measured together. What is about to be written or read at random is asked for ahead.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.cpu.footprints import outlines, tiles_of_box, write_line, write_spans, write_wide
from minisplat_ref.cpu.gaussian_rows import listed_rows
from minisplat_ref.cpu.sorting import sort_stably
from minisplat_ref.scalar._jit import kernel, prange, scalar
from minisplat_ref.scalar.lanes import WIDTH, prefetch
from minisplat_ref.types import Ints

N_PARTS = 16  # of the input, and as many layers
BUCKET_SHIFT = 18  # of the bits of a float32: 32 buckets of depth to a factor of two
N_BUCKETS = 1 << 10  # from 1/128 to 2^25; the first and the last also take what lies beyond
FIRST_BUCKET = int(np.float32(1 / 128).view(np.int32)) >> BUCKET_SHIFT
CULLED = N_BUCKETS  # the bucket behind them all
GAUSSIANS, TILES = 0, 1  # columns of a count; the tiles are those under boxes
ID, FIRST, COUNT, SLOT = range(4)  # columns of an entry: a Gaussian, its cells, its first slot within its part
FETCH_AHEAD = 8  # entries


class Layers(NamedTuple):
    """The Gaussians, layer by layer, and within a layer in the order of the input; the culled come last.

    A cell is one tile in one layer.
    """

    keys: Ints
    """[N] bits of the depths: positive floats are ordered as their bits are."""
    entries: Ints
    """[N, 4] int32."""
    cells: Ints
    """layer * n_tiles + tile of each pair, int32; between the parts of a layer places are left over."""


@scalar
def _bucket(depth, is_visible):
    bucket = (np.float32(depth).view(np.int32) >> BUCKET_SHIFT) - FIRST_BUCKET
    return min(max(bucket, 0), N_BUCKETS - 1) if is_visible else CULLED


@scalar
def _survey_part(start, end, boxes, depths, up_to):
    """Count the Gaussians below each bucket, and the tiles under their boxes."""
    up_to[:] = 0
    for n in range(start, end):
        _, _, n_columns, n_rows = tiles_of_box(boxes, n)
        behind = _bucket(depths[n], n_columns > 0) + 1
        up_to[behind, GAUSSIANS] += 1
        up_to[behind, TILES] += n_columns * n_rows
    for bucket in range(CULLED + 1):
        for column in (GAUSSIANS, TILES):
            up_to[bucket + 1, column] += up_to[bucket, column]


@kernel()
def survey(boxes, depths, n_threads, up_to):
    """First pass; writes ``up_to`` [N_PARTS, CULLED + 2, 2]."""
    n = depths.size
    for thread in prange(n_threads):
        for part in range(thread, N_PARTS, n_threads):
            _survey_part(n * part // N_PARTS, n * (part + 1) // N_PARTS, boxes, depths, up_to[part])


@scalar
def _list_wide(start, end, projection, alpha_min, n_tiles_x, n_tiles, layer_of, cursors, cells, wide):
    """Write the cells of the Gaussians of a part whose boxes are wide; ``wide`` gets the first of each and the end."""
    boxes, depths = projection.boxes, projection.depths
    ids, spans = np.empty(end - start + WIDTH, np.int64), np.empty(2 * WIDTH * (n_tiles // n_tiles_x), depths.dtype)
    count = 0
    for n in range(start, end):  # without branches: which are wide cannot be foreseen
        _, _, n_columns, n_rows = tiles_of_box(boxes, n)
        ids[count] = n
        count += (n_columns > 1) & (n_rows > 1)
    ids[count : count + WIDTH] = ids[max(count - 1, 0)]
    for i in range(0, count, WIDTH):
        rows = listed_rows(ids, i)
        outline, most_rows = outlines(rows, projection, alpha_min)
        for row in range(most_rows):
            write_spans(rows, row, outline, projection, spans)
        for k in range(min(WIDTH, count - i)):
            layer = layer_of[_bucket(depths[rows[k]], True)]
            first = cursors[layer, TILES]
            behind = write_wide(tiles_of_box(boxes, rows[k]), spans, k, n_tiles_x, layer * n_tiles, cells, first)
            cursors[layer, TILES] = behind
            wide[i + k, 0], wide[i + k, 1] = first, behind


@scalar
def _list_part(part, projection, keys, alpha_min, n_tiles_x, layer_of, cursors, layers, offsets, counts):
    """Enter each Gaussian of a part into its layer, and count the pairs of each cell."""
    boxes, cells = projection.boxes, layers.cells
    start, end, n_tiles = keys.size * part // N_PARTS, keys.size * (part + 1) // N_PARTS, counts.size // N_PARTS
    first_cells, wide = cursors[:, TILES].copy(), np.empty((end - start + 1, 2), np.int32)
    _list_wide(start, end, projection, alpha_min, n_tiles_x, n_tiles, layer_of, cursors, cells, wide)
    slot = n_wide = 0
    for n in range(start, end):  # without branches: what can be seen cannot be foreseen either
        column, row, n_columns, n_rows = tiles_of_box(boxes, n)
        layer = layer_of[_bucket(projection.depths[n], n_columns > 0)]
        is_wide = (n_columns > 1) & (n_rows > 1)
        place, first = cursors[layer, GAUSSIANS], cursors[layer, TILES]
        line = (column, row, n_columns * (not is_wide), n_rows)
        behind = write_line(line, n_tiles_x, layer * n_tiles, cells, first)
        cursors[layer, GAUSSIANS], cursors[layer, TILES] = place + 1, behind
        first, behind = (wide[n_wide, 0], wide[n_wide, 1]) if is_wide else (first, behind)
        n_wide += is_wide
        layers.keys[place] = keys[n]
        entries = layers.entries
        prefetch(entries, place + FETCH_AHEAD)
        entries[place, ID], entries[place, FIRST], entries[place, COUNT] = n, first, behind - first
        entries[place, SLOT] = slot
        slot += behind - first
        offsets[n + 1] = slot
    for layer in range(N_PARTS):
        for i in range(first_cells[layer], cursors[layer, TILES]):
            counts[cells[i]] += 1


@kernel()
def list_parts(projection, keys, alpha_min, n_tiles_x, layer_of, cursors, layers, offsets, counts):
    """Second pass; writes the layers, the offsets of the slots within each part, and the pairs of each cell."""
    n_threads = counts.shape[0]
    for thread in prange(n_threads):
        for part in range(thread, N_PARTS, n_threads):
            _list_part(
                part, projection, keys, alpha_min, n_tiles_x, layer_of, cursors[part], layers, offsets, counts[thread]
            )


@scalar
def _fill_layer(
    layer, edges, layers, first_slots, offsets, places, other_keys, other_places, digits, starts, ids, slots
):
    """Sort one layer and write its pairs."""
    entries, cells, n = layers.entries, layers.cells, other_keys.size
    for i in range(n * layer // N_PARTS, n * (layer + 1) // N_PARTS):
        offsets[i + 1] += first_slots[layer]  # of the part of the same number
    for part in range(N_PARTS):
        for place in range(edges[layer * N_PARTS + part], edges[layer * N_PARTS + part + 1]):
            places[place] = place
            entries[place, SLOT] += first_slots[part]
    own = slice(edges[layer * N_PARTS], edges[(layer + 1) * N_PARTS])
    in_order = sort_stably(layers.keys[own], places[own], other_keys[own], other_places[own], digits)
    for i in range(in_order.size):
        prefetch(entries, in_order[min(i + FETCH_AHEAD, in_order.size - 1)])
        n, first = entries[in_order[i], ID], entries[in_order[i], FIRST]
        count, slot = entries[in_order[i], COUNT], entries[in_order[i], SLOT]
        for k in range(count):
            place = starts[cells[first + k]]
            starts[cells[first + k]] = place + 1
            ids[place] = n
            slots[place] = slot + k


@kernel()
def fill_layers(edges, layers, first_slots, offsets, places, other_keys, other_places, digits, starts, ids, slots):
    """Third pass; writes the lists and the slots of their pairs, and completes the offsets."""
    n_threads = digits.shape[0]
    for thread in prange(n_threads):
        for layer in range(thread, N_PARTS, n_threads):
            _fill_layer(
                layer, edges, layers, first_slots, offsets, places, other_keys, other_places, digits[thread], starts,
                ids, slots,
            )  # fmt: skip
