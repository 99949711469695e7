"""Which tiles each Gaussian reaches: those with a pixel centre in its visible ellipse.

Nearly all Gaussians reach one tile, or a few in one row or one column; those are a *run*: first tile, step and number.
Only ellipses over several rows and several columns of tiles are followed row by row, which drops most of the tiles that
the bounding box of an oblique ellipse would give, and these tiles are written out.

Gaussians are looked at in blocks, each step for the whole block: a long chain of divisions and roots that ends in an
unforeseeable branch, one Gaussian after the other, would leave the processor waiting.
"""

import math

import numpy as np

from minisplat_ref.scalar._jit import scalar
from minisplat_ref.scalar.compositing import factors
from minisplat_ref.scalar.literals import HALF, ZERO
from minisplat_ref.scalar.tiling import rightmost_offset, visible_ellipse

TILE_WIDTH = 32  # pixels
TILE_HEIGHT = 16
ELLIPSE_MARGIN = np.float32(0.02)  # px and relative: rounding must not lose a pixel that the compositor would blend
BLOCK = 128  # Gaussians; what is noted about them stays in the first-level cache

# Columns of the notes on a block. The first three are the footprint of each Gaussian in turn; where the step is 0 the
# tiles are written out, and the first is a place in that list. The others are two lists of Gaussians that need a closer
# look, the second with their tight boxes of pixels.
FIRST, STEP, N_TILES, SEVERAL, OBLIQUE, LEFT, TOP, RIGHT, BOTTOM = range(9)
N_NOTES = 9


@scalar
def _columns(ellipse, mx, low, high, x0, x1):
    """Tile columns, half-open, that the ellipse reaches in a band of rows at low <= dy <= high."""
    low = max(low, -ellipse.half_height)
    high = min(high, ellipse.half_height)
    right = mx + rightmost_offset(ellipse.outline, low, high, 1) + ELLIPSE_MARGIN
    left = mx - rightmost_offset(ellipse.outline, low, high, -1) - ELLIPSE_MARGIN
    first = max(x0, math.ceil(max(left - HALF, ZERO)))
    end = min(x1, math.floor(min(right + HALF, x1)))
    return (first // TILE_WIDTH, (end - 1) // TILE_WIDTH + 1) if first < end else (0, 0)


@scalar
def _pixels(center, reach, first, end):
    """Pixels of first <= pixel < end whose centres lie within reach of a point."""
    first = math.ceil(max(center - reach - HALF - ELLIPSE_MARGIN, first))
    end = math.floor(min(center + reach + HALF + ELLIPSE_MARGIN, end))
    return first, end


@scalar
def _within_boxes(start, end, boxes, n_tiles_x, notes):
    """Footprints of boxes within one tile; list the Gaussians of larger ones and return their number."""
    n_several = 0
    for n in range(start, end):
        x0, y0, x1, y1 = boxes[n, 0], boxes[n, 1], boxes[n, 2], boxes[n, 3]
        column, row = x0 // TILE_WIDTH, y0 // TILE_HEIGHT
        is_visible = (x0 < x1) & (y0 < y1)
        notes[n - start, FIRST] = row * n_tiles_x + column
        notes[n - start, STEP] = 1
        notes[n - start, N_TILES] = 1 if is_visible else -1
        notes[n_several, SEVERAL] = n
        n_several += is_visible & ((column < (x1 - 1) // TILE_WIDTH) | (row < (y1 - 1) // TILE_HEIGHT))
    return n_several


@scalar
def _within_ellipses(start, n_several, projection, alpha_min, n_tiles_x, notes):
    """Footprints from the ellipses' own boxes; list those over several rows and columns and return their number."""
    boxes, means, conics, opacities = projection.boxes, projection.means2d, projection.conics, projection.opacities
    n_oblique = 0
    for i in range(n_several):
        n = notes[i, SEVERAL]
        a, slope, pivot = factors(conics[n, 0], conics[n, 1], conics[n, 2])
        ellipse = visible_ellipse(a, slope, pivot, opacities[n], alpha_min, ELLIPSE_MARGIN)
        x0, x1 = _pixels(means[n, 0], ellipse.half_width, boxes[n, 0], boxes[n, 2])
        y0, y1 = _pixels(means[n, 1], ellipse.half_height, boxes[n, 1], boxes[n, 3])
        column, row = x0 // TILE_WIDTH, y0 // TILE_HEIGHT
        n_columns, n_rows = (x1 - 1) // TILE_WIDTH - column + 1, (y1 - 1) // TILE_HEIGHT - row + 1
        reaches_any = (x0 < x1) & (y0 < y1)
        notes[n - start, FIRST] = row * n_tiles_x + column
        notes[n - start, STEP] = n_tiles_x if n_rows > 1 else 1
        notes[n - start, N_TILES] = n_columns * n_rows * reaches_any
        notes[n_oblique, OBLIQUE] = n
        notes[n_oblique, LEFT], notes[n_oblique, RIGHT] = x0, x1
        notes[n_oblique, TOP], notes[n_oblique, BOTTOM] = y0, y1
        n_oblique += reaches_any & (n_columns > 1) & (n_rows > 1)
    return n_oblique


@scalar
def _row_by_row(start, n_oblique, projection, alpha_min, n_tiles_x, notes, tiles, place):
    """Write out the tiles of ellipses over several rows and columns; return the place behind them."""
    means, conics, opacities = projection.means2d, projection.conics, projection.opacities
    for i in range(n_oblique):
        n, x0, y0, x1, y1 = notes[i, OBLIQUE], notes[i, LEFT], notes[i, TOP], notes[i, RIGHT], notes[i, BOTTOM]
        a, slope, pivot = factors(conics[n, 0], conics[n, 1], conics[n, 2])
        ellipse = visible_ellipse(a, slope, pivot, opacities[n], alpha_min, ELLIPSE_MARGIN)
        mx, my = means[n, 0], means[n, 1]
        first_place = place
        for row in range(y0 // TILE_HEIGHT, (y1 - 1) // TILE_HEIGHT + 1):
            low = max(row * TILE_HEIGHT, y0) + HALF - my
            high = min((row + 1) * TILE_HEIGHT, y1) - HALF - my
            first, end = _columns(ellipse, mx, low, high, x0, x1)
            for column in range(first, end):
                tiles[place] = row * n_tiles_x + column
                place += 1
        notes[n - start, FIRST] = first_place
        notes[n - start, STEP] = 0
        notes[n - start, N_TILES] = place - first_place
    return place


@scalar
def write_footprints(start, end, projection, alpha_min, n_tiles_x, notes, tiles, place):
    """Write the footprints of Gaussians start <= n < end, a block at most.

    Parameters
    ----------
    start, end : int
    projection : Projection
    alpha_min : float
        In the data's dtype.
    n_tiles_x : int
        Columns of tiles in the image.
    notes : ndarray of shape (BLOCK, N_NOTES), int32
        Receives first tile, step and number of tiles of each Gaussian; the number is -1 where it is culled.
    tiles : ndarray, int32
        Receives, from ``place`` on, the tiles of those whose step is 0.
    place : int

    Returns
    -------
    int
        The place behind the last that was written.
    """
    n_several = _within_boxes(start, end, projection.boxes, n_tiles_x, notes)
    n_oblique = _within_ellipses(start, n_several, projection, alpha_min, n_tiles_x, notes)
    return _row_by_row(start, n_oblique, projection, alpha_min, n_tiles_x, notes, tiles, place)


@scalar
def room_for_tiles(start, end, boxes):
    """Return how many tiles the footprints of Gaussians start <= n < end may write out."""
    room = 0
    for n in range(start, end):
        n_columns = (boxes[n, 2] - 1) // TILE_WIDTH - boxes[n, 0] // TILE_WIDTH + 1
        n_rows = (boxes[n, 3] - 1) // TILE_HEIGHT - boxes[n, 1] // TILE_HEIGHT + 1
        room += n_columns * n_rows * ((n_columns > 1) & (n_rows > 1))
    return room
