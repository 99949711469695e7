"""The steps of making tile lists, for each part of the input and for each layer.

:mod:`minisplat_ref.cpu.tiling` explains the algorithm. Branch mispredictions and cache misses are expensive. So there
are no unpredictable branches: the culled Gaussians are their own layer, behind all others, and wide boxes are
listed first and processed together. Random accesses are prefetched.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.cpu.gaussian_rows import load_rows
from minisplat_ref.cpu.tiling.footprints import SPARE, outlines, tiles_of_box, write_line, write_spans, write_wide
from minisplat_ref.cpu.tiling.sorting import DIGIT_BITS, sort_stably
from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import WIDTH, prefetch
from minisplat_ref.types import Ints

N_PARTS = 16  # of the input, and as many layers
BUCKET_SHIFT = 18  # of the bits of a float32: 32 buckets of depth per factor of two
N_BUCKETS = 1 << 10  # from 1/128 to 2^25; the first and the last also hold all depths beyond
FIRST_BUCKET = int(np.float32(1 / 128).view(np.int32)) >> BUCKET_SHIFT
CULLED = N_BUCKETS  # the bucket behind them all
GAUSSIANS, TILES = 0, 1  # columns of a count; the tiles are those under boxes
TILES_BIT, GAUSSIANS_MASK = 32, (1 << 32) - 1  # both counts packed into one integer
SQUARES, OTHERS = 0, 1  # lists of Gaussians with wide boxes
ID, FIRST, COUNT, SLOT = range(4)  # columns of an entry: a Gaussian, its cells, its first slot within its part
FETCH_AHEAD = 8  # entries


class Screen(NamedTuple):
    """The tiles of the image, and the alpha below which nothing is seen."""

    n_tiles_x: int
    n_tiles: int
    alpha_min: np.floating
    """In the data's dtype."""


class Survey(NamedTuple):
    """Results of the first pass for each part, and the depths as integers."""

    keys: Ints
    """[N] integers in the order of the depths, :func:`~minisplat_ref.cpu.tiling.sorting.depth_keys`."""

    up_to: Ints
    """[N_PARTS, CULLED + 2] Gaussians of each part below each bucket, and 2^32 times the tiles under their boxes, so
    that both are added, and subtracted, at once; int64."""
    buckets: Ints
    """[N] bucket of each Gaussian, int16."""
    wide: Ints
    """[N_PARTS, 2, at least Gaussians of a part + 9] those with wide boxes, int32: in the first list those over two
    columns and two rows of tiles, as most are, in the second the others. The last number of a list is its length."""


class Layers(NamedTuple):
    """The Gaussians, layer by layer, and within a layer in the order of the input; the culled come last.

    A cell is one tile in one layer. Another array has the cells of all pairs, layer * n_tiles + tile as int32, with
    gaps between the parts of a layer.
    """

    of_buckets: Ints
    """[CULLED + 1] layer of each bucket, int32."""
    edges: Ints
    """[(N_PARTS + 1) * N_PARTS + 1, 2] where the Gaussians of each layer and part start, and their cells; the ends."""
    keys: Ints
    """[N] those of the survey."""
    entries: Ints
    """[N, 4] int32."""


class Scratch(NamedTuple):
    """Memory for the sorting of a layer."""

    places: Ints
    """[N] int32."""
    other_keys: Ints
    """[N] of the dtype of the keys."""
    other_places: Ints
    """[N] int32."""


@scalar
def part_range(n, i):
    """Return the range [first, end) of part ``i`` of ``n`` elements."""
    return n * i // N_PARTS, n * (i + 1) // N_PARTS


@scalar
def _bucket(depth, is_visible):
    bucket = (np.float32(depth).view(np.int32) >> BUCKET_SHIFT) - FIRST_BUCKET
    return min(max(bucket, 0), N_BUCKETS - 1) if is_visible else CULLED


# --- first pass ---


@scalar
def survey_part(part, boxes, depths, survey):
    """Count the Gaussians of a part and their tiles, and list those whose boxes are wide."""
    up_to, squares, others = survey.up_to[part], survey.wide[part, SQUARES], survey.wide[part, OTHERS]
    start, end = part_range(depths.size, part)
    up_to[:] = 0
    n_squares = n_others = 0
    for n in range(start, end):
        _, _, n_columns, n_rows = tiles_of_box(boxes, n)
        is_square = (n_columns == 2) & (n_rows == 2)
        bucket = _bucket(depths[n], n_columns > 0)
        survey.buckets[n] = bucket
        up_to[bucket + 1] += 1 + (np.int64(n_columns * n_rows) << TILES_BIT)
        squares[n_squares], others[n_others] = n, n
        n_squares += is_square
        n_others += (n_columns > 1) & (n_rows > 1) & (not is_square)
    for bucket in range(CULLED + 1):
        up_to[bucket + 1] += up_to[bucket]
    _end_list(squares, n_squares)
    _end_list(others, n_others)


@scalar
def _end_list(ids, count):
    """Pad the last eight of a list, and write its length after them all."""
    ids[count : count + WIDTH] = ids[max(count - 1, 0)]
    ids[-1] = count


@scalar
def cut_layers(up_to, of_buckets, edges):
    """Cut the buckets into layers of about equal numbers of Gaussians, and one of the culled.

    Parameters
    ----------
    up_to : ndarray
        That of :class:`Survey`.
    of_buckets, edges : ndarray
        Those of :class:`Layers`; overwritten.
    """
    total, cuts = np.empty(CULLED + 1, np.int64), np.empty(N_PARTS + 2, np.int64)
    total[:] = 0  # Gaussians below each bucket
    for part in range(N_PARTS):
        for bucket in range(CULLED + 1):
            total[bucket] += up_to[part, bucket] & GAUSSIANS_MASK
    cuts[:] = CULLED  # the buckets at which layers begin
    cuts[0], cuts[N_PARTS + 1] = 0, CULLED + 1
    of_buckets[CULLED], layer = N_PARTS, 0
    for bucket in range(CULLED):
        while layer + 1 < N_PARTS and total[bucket] >= total[CULLED] * (layer + 1) // N_PARTS:
            layer += 1
            cuts[layer] = bucket
        of_buckets[bucket] = layer
    edges[0] = 0
    for i in range((N_PARTS + 1) * N_PARTS):
        layer, part = i // N_PARTS, i % N_PARTS
        size = up_to[part, cuts[layer + 1]] - up_to[part, cuts[layer]]
        edges[i + 1, GAUSSIANS] = edges[i, GAUSSIANS] + (size & GAUSSIANS_MASK)
        edges[i + 1, TILES] = edges[i, TILES] + (size >> TILES_BIT) + SPARE


# --- second pass ---


@scalar
def _write_wide(part, survey, projection, screen, layers, cells, cursors, wide):
    """Write the cells of the wide boxes of a part, eight at a time; ``wide`` gets the first of each and the end."""
    n_tiles_x, n_tiles, alpha_min = screen
    start, _ = part_range(projection.depths.size, part)
    spans = np.empty(2 * WIDTH * (n_tiles // n_tiles_x), projection.depths.dtype)
    for kind in (SQUARES, OTHERS):
        ids = survey.wide[part, kind]
        for i in range(0, ids[-1], WIDTH):
            rows = load_rows(ids, i)
            outline, max_rows = outlines(rows, projection, alpha_min)
            for row in range(max_rows):
                write_spans(rows, row, outline, projection, spans)
            for k in range(min(WIDTH, ids[-1] - i)):
                n = ids[i + k]
                box, layer = tiles_of_box(projection.boxes, n), layers.of_buckets[survey.buckets[n]]
                first, base = cursors[layer, TILES], layer * n_tiles
                if kind == SQUARES:  # predictable, and then the loops of write_wide have a fixed length
                    behind = write_wide((box[0], box[1], 2, 2), spans, k, n_tiles_x, base, cells, first)
                else:
                    behind = write_wide(box, spans, k, n_tiles_x, base, cells, first)
                cursors[layer, TILES], wide[n - start, 0], wide[n - start, 1] = behind, first, behind


@scalar
def list_part(part, survey, projection, screen, layers, cells, offsets, counts):
    """Enter each Gaussian of a part into its layer, and count the pairs of each cell."""
    keys, boxes, entries = survey.keys, projection.boxes, layers.entries
    n_tiles_x, n_tiles = screen.n_tiles_x, screen.n_tiles
    start, end = part_range(keys.size, part)
    cursors, wide = layers.edges[part:-1:N_PARTS].copy(), np.empty((end - start, 2), np.int32)
    _write_wide(part, survey, projection, screen, layers, cells, cursors, wide)
    slot = 0
    for n in range(start, end):  # without branches: visibility would be unpredictable
        column, row, n_columns, n_rows = tiles_of_box(boxes, n)
        layer = layers.of_buckets[survey.buckets[n]]
        is_wide = (n_columns > 1) & (n_rows > 1)
        place, first = cursors[layer, GAUSSIANS], cursors[layer, TILES]
        line = (column, row, n_columns * (not is_wide), n_rows)
        behind = write_line(line, n_tiles_x, layer * n_tiles, cells, first)
        cursors[layer, GAUSSIANS], cursors[layer, TILES] = place + 1, behind
        wide_first, wide_behind = wide[n - start, 0], wide[n - start, 1]
        first, behind = wide_first if is_wide else first, wide_behind if is_wide else behind
        layers.keys[place] = keys[n]
        prefetch(entries, place + FETCH_AHEAD)
        entries[place, ID], entries[place, FIRST], entries[place, COUNT] = n, first, behind - first
        entries[place, SLOT] = slot
        slot += behind - first
        offsets[n + 1] = slot
    for layer in range(N_PARTS):
        for i in range(layers.edges[layer * N_PARTS + part, TILES], cursors[layer, TILES]):
            counts[cells[i]] += 1


@scalar
def start_lists(counts, offsets, first_slots, tile_offsets):
    """Find where each tile's list starts, and the slots of each part.

    Parameters
    ----------
    counts : ndarray of shape (threads, N_PARTS * n_tiles)
        Pairs of each cell; how they are spread over the threads does not matter. The first row receives where each cell
        starts, a layer's share of a tile's list.
    offsets : ndarray of shape (N + 1,)
        Pairs of each part, up to each Gaussian.
    first_slots, tile_offsets : ndarrays of shapes (N_PARTS,) and (n_tiles + 1,)
        Overwritten.
    """
    n_tiles, starts = tile_offsets.size - 1, counts[0]
    for thread in range(1, len(counts)):
        for cell in range(starts.size):
            starts[cell] += counts[thread, cell]
    tile_offsets[:] = 0
    for layer in range(N_PARTS):
        for tile in range(n_tiles):
            count = starts[layer * n_tiles + tile]
            starts[layer * n_tiles + tile] = tile_offsets[tile + 1]
            tile_offsets[tile + 1] += count
    for tile in range(n_tiles):
        tile_offsets[tile + 1] += tile_offsets[tile]
    for layer in range(N_PARTS):
        for tile in range(n_tiles):
            starts[layer * n_tiles + tile] += tile_offsets[tile]
    slot = 0
    for part in range(N_PARTS):
        first_slots[part] = slot
        start, end = part_range(offsets.size - 1, part)
        if end > start:
            slot += offsets[end]


# --- third pass ---


@scalar
def fill_layer(layer, layers, cells, first_slots, offsets, scratch, starts, lists):
    """Sort one layer and write its pairs; also complete the offsets of the part with the same number.

    Parameters
    ----------
    layer : int
        Its number.
    layers : Layers
        Their edges, keys and entries.
    cells : ndarray of shape (pairs and what is left over,)
        Those of the entries.
    first_slots, offsets : ndarrays of shapes (N_PARTS,) and (N + 1,)
        First slot of each part, and pairs of the part up to each Gaussian; to the latter the former is added.
    scratch : Scratch
        Overwritten, where the layer and the part have their Gaussians.
    starts : ndarray of shape (N_PARTS * n_tiles,)
        Where the next pair of each cell goes in the lists; those of the layer advance to their ends.
    lists : ndarray of shape (2, M)
        Receives Gaussians and slots.
    """
    edges, entries = layers.edges[:, GAUSSIANS], layers.entries
    places, other_keys, other_places = scratch
    digits = np.empty((2, 1 << DIGIT_BITS), np.int32)
    ids, slots = lists[0], lists[1]
    start, end = part_range(other_keys.size, layer)
    for i in range(start, end):
        offsets[i + 1] += first_slots[layer]
    for part in range(N_PARTS):
        for place in range(edges[layer * N_PARTS + part], edges[layer * N_PARTS + part + 1]):
            places[place] = place
            entries[place, SLOT] += first_slots[part]
    own = slice(edges[layer * N_PARTS], edges[(layer + 1) * N_PARTS])
    in_order = places[own]
    sort_stably(layers.keys[own], in_order, other_keys[own], other_places[own], digits)
    for i in range(in_order.size):
        prefetch(entries, in_order[min(i + FETCH_AHEAD, in_order.size - 1)])
        n, first = entries[in_order[i], ID], entries[in_order[i], FIRST]
        count, slot = entries[in_order[i], COUNT], entries[in_order[i], SLOT]
        for k in range(count):
            place = starts[cells[first + k]]
            starts[cells[first + k]] = place + 1
            ids[place], slots[place] = n, slot + k
