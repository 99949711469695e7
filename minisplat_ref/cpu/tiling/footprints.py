"""The tiles that each Gaussian reaches.

A box of pixels within one row or one column of tiles reaches all of these tiles, nearly always one or two. Only for a
wide box, over several rows and several columns, is the visible ellipse tested against the tiles: that drops most of the
tiles in the box of a slanted needle. Elsewhere few would be dropped, and blending skips tiles without a row of pixels
to visit anyway.

Ellipses are bounded eight at a time: in each row of tiles, the first column and the one past the last. Branch
mispredictions are expensive, so no branch depends on an ellipse: every tile under the box is written, and the position
advances only if the tile is reached; otherwise the next write overwrites it.
"""

import numpy as np

from minisplat_ref.cpu.gaussian_rows import round_lanes, triple
from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import WIDTH, cast, ceil, floor, gather, maximum, minimum, reduce_max, store
from minisplat_ref.jit.literals import HALF, ONE
from minisplat_ref.scalar.compositing import factors
from minisplat_ref.scalar.tiling import rightmost_offset, visible_outline

COLUMN_BITS, ROW_BITS = 5, 4  # for shifts: // has to handle negative numbers, which boxes do not contain
TILE_WIDTH = 1 << COLUMN_BITS  # pixels
TILE_HEIGHT = 1 << ROW_BITS
COLUMNS_PER_PIXEL, ROWS_PER_PIXEL = np.float32(1 / TILE_WIDTH), np.float32(1 / TILE_HEIGHT)  # exact
ELLIPSE_MARGIN = np.float32(0.02)  # px and relative: rounding must not lose a pixel that the compositor would blend
SPARE = 2  # positions past the last that may be written


@scalar
def tiles_of_box(boxes, n):
    """Return first column and row of the tiles under a box of pixels, and numbers of columns and rows; 0 if empty."""
    x0, y0, x1, y1 = boxes[n, 0], boxes[n, 1], boxes[n, 2], boxes[n, 3]
    column, row = x0 >> COLUMN_BITS, y0 >> ROW_BITS
    is_visible = (x0 < x1) & (y0 < y1)
    n_columns, n_rows = ((x1 - 1) >> COLUMN_BITS) + 1 - column, ((y1 - 1) >> ROW_BITS) + 1 - row
    return column, row, n_columns * is_visible, n_rows


@scalar
def write_line(box, n_tiles_x, base, tiles, place):
    """Write the tiles under a box that is not wide.

    Parameters
    ----------
    box : tuple of int
        As :func:`tiles_of_box` returns it.
    n_tiles_x : int
        Columns of tiles in the image.
    base : int
        Added to the numbers of the tiles.
    tiles : ndarray, int32
        Receives the tiles from ``place`` on, with room for ``SPARE`` more.
    place : int

    Returns
    -------
    int
        The position past the last tile.
    """
    column, row, n_columns, n_rows = box
    first, step = base + row * n_tiles_x + column, n_tiles_x if n_rows > 1 else 1
    tiles[place], tiles[place + 1] = first, first + step
    for k in range(2, n_columns * n_rows):
        tiles[place + k] = first + k * step
    return place + n_columns * n_rows


@scalar
def write_wide(box, spans, i, n_tiles_x, base, tiles, place):
    """Write the tiles that the ellipse in a wide box reaches, the ``i``-th of the eight with these ``spans``.

    Many wide boxes have two columns; a loop that nearly always ends at once is well predicted.
    """
    column, row, n_columns, n_rows = box
    for k in range(n_rows):
        first, end = np.int64(spans[2 * k * WIDTH + i]), np.int64(spans[(2 * k + 1) * WIDTH + i])
        tile = base + (row + k) * n_tiles_x
        tiles[place] = tile + column
        place += (first <= column) & (column < end)
        tiles[place] = tile + column + 1
        place += (first <= column + 1) & (column + 1 < end)
        for further in range(column + 2, column + n_columns):
            tiles[place] = tile + further
            place += (first <= further) & (further < end)
    return place


@scalar
def outlines(rows, projection, alpha_min):
    """Return the visible ellipses of eight Gaussians, and the largest number of rows of tiles in their boxes."""
    zero = projection.opacities.dtype.type(0)
    ellipse = round_lanes(factors(*triple(projection.conics, rows)), zero)
    _, y0, _, y1 = _boxes(projection.boxes, rows, zero)
    n_rows = reduce_max(floor((y1 - ONE) * ROWS_PER_PIXEL) - floor(y0 * ROWS_PER_PIXEL)) + ONE
    opacity = gather(projection.opacities, rows, 0)
    return visible_outline(*ellipse, opacity, alpha_min, ELLIPSE_MARGIN), np.int64(n_rows)


@scalar
def _boxes(boxes, rows, zero):
    """Return the edges of eight boxes in the dtype of a number."""
    x0, y0 = cast(gather(boxes, rows, 0), zero), cast(gather(boxes, rows, 1), zero)
    x1, y1 = cast(gather(boxes, rows, 2), zero), cast(gather(boxes, rows, 3), zero)
    return x0, y0, x1, y1


@scalar
def write_spans(rows, row, outline, projection, spans):
    """Write which columns of tiles eight ellipses reach in a row of tiles, counted from the first row of each box."""
    x0, y0, x1, y1 = _boxes(projection.boxes, rows, projection.opacities.dtype.type(0))
    mx, my = gather(projection.means2d, rows, 0), gather(projection.means2d, rows, 1)
    top = (floor(y0 * ROWS_PER_PIXEL) + row) * TILE_HEIGHT
    low, high = maximum(top, y0) + (HALF - my), minimum(top + TILE_HEIGHT, y1) - (HALF + my)
    left = mx - rightmost_offset(outline, low, high, -ONE) - (HALF + ELLIPSE_MARGIN)
    right = mx + rightmost_offset(outline, low, high, ONE) + (HALF + ELLIPSE_MARGIN)
    store(spans, 2 * row * WIDTH, floor(maximum(ceil(left), x0) * COLUMNS_PER_PIXEL))
    store(spans, (2 * row + 1) * WIDTH, ceil(minimum(floor(right), x1) * COLUMNS_PER_PIXEL))  # behind the last
