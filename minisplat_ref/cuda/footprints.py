"""The tiles that each Gaussian reaches.

The reference lists all tiles under a Gaussian's box, and so does the stage. The passes of a training leave out the
tiles that the visible ellipse misses, as the CPU's lists do: most of the tiles in the box of a slanted needle. A box
within one row or one column of tiles is not examined, nor is one of more than eight tiles in either direction.

What is found is kept as a set of bits, so that counting the pairs and writing them cannot disagree: compiled twice, the
same formula may round differently.
"""

import numpy as np

from minisplat_ref.cpu.tiling import ELLIPSE_MARGIN
from minisplat_ref.cuda.target import device_function
from minisplat_ref.jit.lanes import ceil, floor, maximum, minimum
from minisplat_ref.jit.literals import HALF, ONE
from minisplat_ref.scalar.compositing import factors
from minisplat_ref.scalar.tiling import rightmost_offset, visible_outline

TILE = 16  # pixels, width and height: a block of 256 threads
SIDE = 8  # tiles: a set has a bit for each of 8 x 8
WHOLE_BOX = -1  # all bits: every tile under the box


@device_function
def tiles_of_box(box):
    """Return first column and row of the tiles under a box of pixels, and numbers of columns and rows; 0 if empty."""
    x0, y0, x1, y1 = box
    column, row = x0 // TILE, y0 // TILE
    n_columns = (x1 + TILE - 1) // TILE - column if x1 > x0 else 0
    n_rows = (y1 + TILE - 1) // TILE - row if y1 > y0 else 0
    return column, row, n_columns, n_rows


@device_function
def reached_tiles(box, center, conic, opacity, alpha_min):
    """Return the set of tiles under a box that the visible ellipse reaches, and their number.

    Bit ``SIDE * row + column`` is the tile in that row and column, counted from those of the box.

    Parameters
    ----------
    box : tuple of int
        Pixels, not empty.
    center, conic, opacity : tuples of float64, and float64
        Of the footprint.
    alpha_min : float64
        Alpha below which nothing is seen.
    """
    column, row, n_columns, n_rows = tiles_of_box(box)
    if n_columns < 2 or n_rows < 2 or n_columns > SIDE or n_rows > SIDE:
        return np.int64(WHOLE_BOX), n_columns * n_rows
    x0, y0, x1, y1 = box
    a, slope, pivot = factors(conic[0], conic[1], conic[2])
    outline = visible_outline(a, slope, pivot, opacity, alpha_min, np.float64(ELLIPSE_MARGIN))
    reach = np.float64(HALF) + ELLIPSE_MARGIN
    tiles, count = np.int64(0), 0
    for k in range(n_rows):
        top = (row + k) * TILE
        low = np.float64(max(top, y0)) + HALF - center[1]
        high = np.float64(min(top + TILE, y1)) - HALF - center[1]
        left = center[0] - rightmost_offset(outline, low, high, -np.float64(ONE)) - reach
        right = center[0] + rightmost_offset(outline, low, high, np.float64(ONE)) + reach
        first = int(maximum(ceil(left), np.float64(x0))) // TILE
        end = (int(minimum(floor(right), np.float64(x1))) + TILE - 1) // TILE
        for c in range(n_columns):
            if first <= column + c and column + c < end:
                tiles |= np.int64(1) << np.int64(SIDE * k + c)
                count += 1
    return tiles, count


@device_function
def has_tile(tiles, k, n_columns, n_rows):
    """Return whether a set has the ``k``-th tile under the box, row by row."""
    if n_columns > SIDE or n_rows > SIDE:
        return True
    row = k // n_columns
    return (tiles >> np.int64(SIDE * row + k - row * n_columns)) & 1 == 1
