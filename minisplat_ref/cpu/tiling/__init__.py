"""Lists of the Gaussians that touch each tile, front to back.

The pairs (tile, Gaussian) are never sorted. The Gaussians are split by depth into layers of about equal numbers, each
behind the one before. The counts of each layer's pairs in each tile determine where in the tile's list they start, so
that the layers can be sorted by depth and written into the lists independently. There are three passes:

1. The survey makes a histogram of depths for each part of the input, which says where layers begin, and finds the wide
   boxes.
2. Every part finds the tiles of its Gaussians and enters each Gaussian into its layer, in the order of the input.
3. Every layer is sorted and fills the lists. Its entries and cells fit the second-level cache, where random access is
   cheap.

The numbers of parts and layers are fixed, so that no result depends on the threads.
"""

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.tiling.footprints import ELLIPSE_MARGIN, TILE_HEIGHT, TILE_WIDTH
from minisplat_ref.cpu.tiling.layers import (
    CULLED,
    N_PARTS,
    TILES,
    Layers,
    Scratch,
    Screen,
    Survey,
    cut_layers,
    fill_layer,
    list_part,
    start_lists,
    survey_part,
)
from minisplat_ref.cpu.tiling.sorting import depth_keys
from minisplat_ref.jit.compile import kernel, n_threads, prange
from minisplat_ref.jit.lanes import WIDTH
from minisplat_ref.jit.scheduling import dynamic_range, make_shared_counter
from minisplat_ref.types import Projection, TileBins, TileGrid

__all__ = ["ELLIPSE_MARGIN", "TILE_HEIGHT", "TILE_WIDTH", "bin_gaussians"]


@kernel()
def _list_tiles(
    projection,  # Projection
    screen,
    survey,  # Survey
    layers,  # Layers
    offsets,  # [N + 1]
    counts,  # [threads, N_PARTS * n_tiles] zeros
    tile_offsets,  # [n_tiles + 1]
    scratch,  # Scratch
):
    """Write the offsets, and return the lists and the slots of their pairs. The three passes are one kernel."""
    n_threads = len(counts)
    taken = make_shared_counter()
    for _ in prange(n_threads):
        for part in dynamic_range(taken, N_PARTS):
            survey_part(part, projection.boxes, projection.depths, survey)
    cut_layers(survey.up_to, layers.of_buckets, layers.edges)

    cells = np.empty(layers.edges[-1, TILES], np.int32)
    taken = make_shared_counter()
    for thread in prange(n_threads):
        for part in dynamic_range(taken, N_PARTS):
            list_part(part, survey, projection, screen, layers, cells, offsets, counts[thread])
    first_slots = np.empty(N_PARTS, np.int64)
    start_lists(counts, offsets, first_slots, tile_offsets)

    lists = np.empty((2, tile_offsets[-1]), np.int32)
    taken = make_shared_counter()
    for _ in prange(n_threads):
        for i in dynamic_range(taken, N_PARTS):
            layer = i % 2 * (N_PARTS // 2) + i // 2  # neighbours share cache lines: far apart in time
            fill_layer(layer, layers, cells, first_slots, offsets, scratch, counts[0], lists)
    return lists


def bin_gaussians(projection: Projection, grid: TileGrid, conventions: Conventions) -> TileBins:
    """List the Gaussians that touch each tile; see ``reference.tiling.bin_gaussians``.

    Tiles under a Gaussian's box are left out if no pixel centre in them can reach ``conventions.alpha_min``; a box
    within one row or one column of tiles is not examined that closely.
    """
    n, n_tiles, dtype = len(projection.depths), grid.n_tiles_x * grid.n_tiles_y, projection.depths.dtype
    keys = depth_keys(projection.depths)
    screen = Screen(grid.n_tiles_x, n_tiles, dtype.type(conventions.alpha_min))
    survey = Survey(
        keys,
        np.empty((N_PARTS, CULLED + 2), np.int64),
        np.empty(n, np.int16),
        np.empty((N_PARTS, 2, n // N_PARTS + 2 * WIDTH), np.int32),
    )
    layers = Layers(
        np.empty(CULLED + 1, np.int32),
        np.empty(((N_PARTS + 1) * N_PARTS + 1, 2), np.int64),
        np.empty_like(keys),
        np.empty((n, 4), np.int32),
    )
    offsets, tile_offsets = np.empty(n + 1, np.int64), np.empty(n_tiles + 1, np.int64)
    offsets[0] = 0
    counts = np.zeros((n_threads(), N_PARTS * n_tiles), np.int32)
    scratch = Scratch(np.empty(n, np.int32), np.empty_like(keys), np.empty(n, np.int32))
    ids, slots = _list_tiles(projection, screen, survey, layers, offsets, counts, tile_offsets, scratch)
    return TileBins(ids, tile_offsets, slots, offsets, grid)
