"""Lists of the Gaussians that touch each tile, front to back.

The pairs (tile, Gaussian) are never sorted. The Gaussians are dealt into layers of about equal numbers, each behind the
one before; when it is known how many pairs each layer has in each tile, every layer knows where in each tile's list its
pairs start, so that the layers are sorted by depth and written into the lists independently. Three passes:

1. The survey counts the Gaussians of each part of the input by depth, which says where layers begin.
2. Every part finds the tiles of its Gaussians and enters each Gaussian into its layer, in the order of the input.
3. Every layer is sorted, and fills the lists. Its entries and cells fit the second-level cache, where random access is
   cheap.

Parts and layers are fixed in number, so that no result depends on the number of threads.
"""

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.footprints import ELLIPSE_MARGIN, SPARE, TILE_HEIGHT, TILE_WIDTH
from minisplat_ref.cpu.layers import CULLED, GAUSSIANS, N_PARTS, TILES, Layers, fill_layers, list_parts, survey
from minisplat_ref.cpu.sorting import DIGIT_BITS
from minisplat_ref.scalar._jit import n_threads
from minisplat_ref.types import Ints, Projection, TileBins, TileGrid

__all__ = ["ELLIPSE_MARGIN", "TILE_HEIGHT", "TILE_WIDTH", "bin_gaussians"]


def _cut_layers(up_to: Ints) -> tuple[Ints, Ints]:
    """Cut the buckets into layers of about equal numbers of Gaussians, and one of the culled.

    Parameters
    ----------
    up_to : ndarray of shape (N_PARTS, CULLED + 2, 2)
        Gaussians of each part below each bucket, and tiles.

    Returns
    -------
    layer_of : ndarray of shape (CULLED + 1,), int32
        Layer of each bucket.
    edges : ndarray of shape ((N_PARTS + 1) * N_PARTS + 1, 2)
        Where the Gaussians of each layer and part start, and their cells; and the ends.
    """
    total = up_to[:, : CULLED + 1, GAUSSIANS].sum(axis=0, dtype=np.int32)
    wanted = int(total[-1]) * np.arange(1, N_PARTS) // N_PARTS  # Gaussians in front of the second layer, and so on
    cuts = np.concatenate([[0], np.searchsorted(total, wanted), [CULLED, CULLED + 1]])
    layer_of = np.repeat(np.arange(N_PARTS + 1, dtype=np.int32), np.diff(cuts))
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
    up_to = np.empty((N_PARTS, CULLED + 2, 2), np.int32)
    survey(projection.boxes, projection.depths, n_threads(), up_to)
    layer_of, edges = _cut_layers(up_to)

    keys = projection.depths.view(np.int32 if dtype == np.float32 else np.int64)
    layers = Layers(np.empty_like(keys), np.empty((n, 4), np.int32), np.empty(edges[-1, TILES], np.int32))
    offsets = np.empty(n + 1, np.int64)
    offsets[0] = 0
    counts = np.zeros((n_threads(), N_PARTS * n_tiles), np.int32)
    cursors = edges[:-1].reshape(N_PARTS + 1, N_PARTS, 2).swapaxes(0, 1).copy()  # by part and layer
    alpha_min = dtype.type(conventions.alpha_min)
    list_parts(projection, keys, alpha_min, grid.n_tiles_x, layer_of, cursors, layers, offsets, counts)

    tile_offsets, starts = _list_starts(counts)
    part_edges = n * np.arange(N_PARTS + 1) // N_PARTS
    n_pairs = np.where(np.diff(part_edges) > 0, offsets[part_edges[1:]], 0)  # offsets count within each part so far
    first_slots = np.cumsum(n_pairs) - n_pairs
    ids, slots = np.empty((2, tile_offsets[-1]), np.int32)
    places, other_places = np.empty((2, n), np.int32)
    digits = np.empty((n_threads(), 1 << DIGIT_BITS), np.int32)
    gaussian_edges, other_keys = edges[:, GAUSSIANS].copy(), np.empty_like(keys)
    fill_layers(
        gaussian_edges, layers, first_slots, offsets, places, other_keys, other_places, digits, starts, ids, slots
    )
    return TileBins(ids, tile_offsets, slots, offsets, grid)
