"""Which tiles each Gaussian reaches.

A box of pixels within one row or one column of tiles reaches all of these tiles, nearly always one or two. Only where
it lies over several rows and several columns it is asked which of the tiles the visible ellipse reaches: that drops
most of those that the box of a slanted needle would give. Elsewhere few would be dropped, and blending finds out by
itself that there is no row of pixels to visit.

A processor guesses which way a branch goes and works ahead; a wrong guess costs as much as it worked ahead, and that is
most where the answer is the end of a long chain of divisions and roots. So no branch depends on the ellipse: every tile
under the box is written, and the place moves on where it is reached. The others are overwritten by what follows.
"""

import numpy as np

from minisplat_ref.scalar._jit import scalar
from minisplat_ref.scalar.compositing import factors
from minisplat_ref.scalar.lanes import WIDTH, counted, filled, floor, larger, select, smaller, store
from minisplat_ref.scalar.literals import FOUR, HALF, ONE
from minisplat_ref.scalar.tiling import rightmost_offset, visible_outline

TILE_WIDTH = 32  # pixels
TILE_HEIGHT = 16
ELLIPSE_MARGIN = np.float32(0.02)  # px and relative: rounding must not lose a pixel that the compositor would blend
ROWS_AT_ONCE = WIDTH // 2  # of tiles, each with a right and a left end
SPARE = 1  # places behind the last that may be written


@scalar
def tiles_of_box(boxes, n):
    """First column and row of tiles under a box of pixels, and the numbers of columns and rows; none if it is empty."""
    x0, y0, x1, y1 = boxes[n, 0], boxes[n, 1], boxes[n, 2], boxes[n, 3]
    column, row = x0 // TILE_WIDTH, y0 // TILE_HEIGHT
    is_visible = (x0 < x1) & (y0 < y1)
    return column, row, ((x1 - 1) // TILE_WIDTH + 1 - column) * is_visible, (y1 - 1) // TILE_HEIGHT + 1 - row


@scalar
def _write_ellipse(n, column, row, n_columns, n_rows, projection, alpha_min, n_tiles_x, base, bounds, tiles, place):
    """Write the tiles that a visible ellipse reaches: how far to the right and to the left in four rows at once."""
    boxes, conics, opacity = projection.boxes, projection.conics, projection.opacities[n]
    as_data = projection.opacities.dtype.type
    a, slope, pivot = factors(conics[n, 0], conics[n, 1], conics[n, 2])
    outline = visible_outline(as_data(a), as_data(slope), as_data(pivot), opacity, alpha_min, ELLIPSE_MARGIN)
    mx, my = projection.means2d[n, 0], projection.means2d[n, 1]
    lanes, zero = counted(mx), filled(as_data(0))
    is_right = lanes < FOUR
    side = select(is_right, filled(as_data(1)), -ONE)
    limit = select(is_right, filled(as_data(boxes[n, 2])), as_data(-boxes[n, 0]))
    for first_row in range(row, row + n_rows, ROWS_AT_ONCE):
        top = (lanes - select(is_right, zero, FOUR) + as_data(first_row)) * as_data(TILE_HEIGHT)
        low = larger(top, as_data(boxes[n, 1])) + (HALF - my)
        high = smaller(top + as_data(TILE_HEIGHT), as_data(boxes[n, 3])) - (HALF + my)
        reach = side * mx + rightmost_offset(outline, low, high, side) + (HALF + ELLIPSE_MARGIN)
        pixel = smaller(limit, floor(reach))  # behind the last, or minus the first
        store(bounds, 0, -floor(pixel * as_data(-1 / TILE_WIDTH)))
        for i in range(min(ROWS_AT_ONCE, row + n_rows - first_row)):
            first, end = -np.int64(bounds[ROWS_AT_ONCE + i]), np.int64(bounds[i])
            for k in range(column, column + n_columns):
                tiles[place] = base + (first_row + i) * n_tiles_x + k
                place += (first <= k) & (k < end)
    return place


@scalar
def write_tiles(n, projection, alpha_min, n_tiles_x, base, bounds, tiles, place):
    """Write the tiles that a Gaussian reaches.

    Parameters
    ----------
    n : int
    projection : Projection
    alpha_min : float
        In the data's dtype.
    n_tiles_x : int
        Columns of tiles in the image.
    base : int
        Added to the numbers of the tiles.
    bounds : ndarray of shape (WIDTH,)
        Scratch.
    tiles : ndarray, int32
        Receives the tiles from ``place`` on, with room for ``SPARE`` more.
    place : int

    Returns
    -------
    int
        The place behind the last tile.
    """
    column, row, n_columns, n_rows = tiles_of_box(projection.boxes, n)
    if (n_columns > 1) & (n_rows > 1):
        return _write_ellipse(
            n, column, row, n_columns, n_rows, projection, alpha_min, n_tiles_x, base, bounds, tiles, place
        )
    first, step = base + row * n_tiles_x + column, n_tiles_x if n_rows > 1 else 1
    tiles[place], tiles[place + 1] = first, first + step
    for k in range(2, n_columns * n_rows):
        tiles[place + k] = first + k * step
    return place + n_columns * n_rows
