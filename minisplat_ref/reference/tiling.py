"""Stage 4: the lists of the Gaussians that each tile of the image has to blend, in their order.

3DGS section 6 makes one key (tile, depth) for every tile that a Gaussian touches, and sorts once. The order is that of
the depths of the means, the same for all pixels: an approximation that is exact only for Gaussians that do not overlap
along the ray. Left out: dropping pairs that no pixel of the tile needs, which changes no image.
"""

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.types import Projection, TileBins, TileGrid


def bin_gaussians(projection: Projection, grid: TileGrid, conventions: Conventions) -> TileBins:
    """List for every tile the Gaussians whose box overlaps it, nearest first; equal depths in the order of the rows.

    Parameters
    ----------
    projection : Projection
        Boxes and depths; an empty box is in no list.
    grid : TileGrid
        The tiling.
    conventions : Conventions
        Not needed here: kernels use ``alpha_min`` to drop pairs that reach no pixel centre.

    Returns
    -------
    TileBins
        The lists, one after the other.
    """
    x0, y0, x1, y1 = projection.boxes.astype(np.int64).T  # [N] each
    first_x, first_y = x0 // grid.tile_width, y0 // grid.tile_height
    n_x = np.where(x1 > x0, -(-x1 // grid.tile_width) - first_x, 0)  # columns of tiles under the box
    n_y = np.where(y1 > y0, -(-y1 // grid.tile_height) - first_y, 0)

    n_pairs = n_x * n_y  # [N]
    ids = np.repeat(np.arange(len(n_pairs)), n_pairs)  # [M] Gaussian of each pair
    k = np.arange(len(ids)) - np.repeat(np.cumsum(n_pairs) - n_pairs, n_pairs)  # [M] 0, 1, ... within a Gaussian
    row, column = np.divmod(k, n_x[ids])
    tiles = (first_y[ids] + row) * grid.n_tiles_x + first_x[ids] + column  # [M]

    order = np.lexsort((ids, projection.depths[ids], tiles))  # the last key is the first to sort by
    n_tiles = grid.n_tiles_x * grid.n_tiles_y
    offsets = np.searchsorted(tiles[order], np.arange(n_tiles + 1))
    gaussian_offsets = np.append(0, np.cumsum(n_pairs))  # before the sort, pairs are grouped by Gaussian
    return TileBins(
        ids[order].astype(np.int32), offsets.astype(np.int64), order.astype(np.int32), gaussian_offsets, grid
    )
