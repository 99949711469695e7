"""Which part of a tile a Gaussian reaches, and its alpha there.

The rows that the visible ellipse reaches are found strip by strip, so that a slanted ellipse is a staircase of rows
rather than its box. What all pixels of a line share is computed once, for all lines of the tile together.

Alpha is written down for all rows before any is blended: the exponential is a long chain of operations of which each
waits for the one before, and blending another. A processor hides the waiting behind other pixels, as far ahead as it
can look, and it looks further ahead if there is less to do for each pixel.
"""

from collections.abc import Callable

import numpy as np

from minisplat_ref.cpu.compositing.records import (
    COLUMN_END,
    COLUMN_FIRST,
    HALF_A,
    HALF_PIVOT,
    MEAN_X,
    MEAN_Y,
    OPACITY,
    SLOPE,
    turned_outline,
)
from minisplat_ref.cpu.compositing.tile_state import N_ROWS, N_STRIPS, rows_of
from minisplat_ref.cpu.tiling import ELLIPSE_MARGIN, TILE_HEIGHT
from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import (
    WIDTH,
    bits_between,
    counted,
    filled,
    floor,
    larger,
    load,
    prefetch,
    select,
    smaller,
    store,
)
from minisplat_ref.jit.literals import FOUR, HALF, ONE
from minisplat_ref.scalar.compositing import mahalanobis
from minisplat_ref.scalar.tiling import rightmost_offset

FETCH_AHEAD = 8  # Gaussians

# Places in the scratch of a thread, which fits a page of memory: a load from an address that lies whole pages from
# where something has just been stored waits for it.
ALPHAS = 0  # of the rows that the current Gaussian reaches
CENTRES_X = N_ROWS * WIDTH  # pixel centres of a row of each strip, counted from the tile's edge
CENTRES_Y = CENTRES_X + N_STRIPS * WIDTH  # and of every line of pixels
TO_MEAN_Y = CENTRES_Y + TILE_HEIGHT  # dy of each line
RIDGE = TO_MEAN_Y + TILE_HEIGHT  # where sigma is least on each line
LEAST = RIDGE + TILE_HEIGHT  # and that sigma
SCRATCH_SIZE = LEAST + TILE_HEIGHT


@scalar
def start_scratch(scratch):
    """Write the pixel centres of a tile."""
    as_data = scratch.dtype.type
    for strip in range(N_STRIPS):
        store(scratch, CENTRES_X + strip * WIDTH, counted(as_data(0)) + (HALF + as_data(strip * WIDTH)))
    for line in range(TILE_HEIGHT):
        scratch[CENTRES_Y + line] = HALF + as_data(line)


@scalar
def write_lines(scratch, mx, my, slope, half_pivot):
    """Write what all pixels of a line share: with e = dx + slope dy, sigma is (a e^2 + pivot dy^2) / 2.

    On each line it is least at mx + slope dy, and e is the way from there.
    """
    for i in range(0, TILE_HEIGHT, WIDTH):
        dy = my - load(scratch, CENTRES_Y + i)
        store(scratch, TO_MEAN_Y + i, dy)
        store(scratch, RIDGE + i, mx + slope * dy)
        store(scratch, LEAST + i, half_pivot * dy * dy)


@scalar
def to_ridge(scratch, row):
    """Return e at the pixel centres of a row."""
    return scratch[RIDGE + row % TILE_HEIGHT] - load(scratch, CENTRES_X + row // TILE_HEIGHT * WIDTH)


@scalar
def to_mean_y(scratch, row):
    """Return dy of a row, a single number."""
    return scratch[TO_MEAN_Y + row % TILE_HEIGHT]


@scalar
def sigma_of(scratch, row, half_a):
    """Return sigma at the pixel centres of a row."""
    return mahalanobis(to_ridge(scratch, row), half_a, scratch[LEAST + row % TILE_HEIGHT])


@scalar
def reached_rows(records, ids, m, x0, y0):
    """Rows of eight pixels that the visible ellipse of the tile's m-th Gaussian reaches, as bits.

    Eight bounds at once: how far it reaches up in each of the four strips, and how far down. A kernel asks one Gaussian
    ahead: the record is then on its way from memory, and the root computed, while the one before is blended.
    """
    if m >= ids.size:
        return np.uint64(0)
    prefetch(records, ids[min(m + FETCH_AHEAD, ids.size - 1)])
    as_data = records.dtype.type
    n = ids[m]
    mx, my = records[n, MEAN_X] - as_data(x0), records[n, MEAN_Y] - as_data(y0)
    k, zero = counted(mx), filled(as_data(0))
    is_up = k < FOUR
    left = (k - select(is_up, zero, FOUR)) * as_data(WIDTH)  # edges of the strips
    side = select(is_up, filled(as_data(-1)), ONE)
    low = left + (HALF - mx)
    offset = rightmost_offset(turned_outline(records, n), low, low + as_data(WIDTH - 1), side)
    bound = floor(side * my + offset + (HALF + ELLIPSE_MARGIN))  # minus the first row, or the one after the last
    bound = side * larger(as_data(-TILE_HEIGHT), smaller(select(is_up, zero, as_data(TILE_HEIGHT)), bound))
    is_in_box = (left < records[n, COLUMN_END] - as_data(x0)) & (left > records[n, COLUMN_FIRST] - as_data(x0 + WIDTH))
    return bits_between(select(is_in_box, bound, zero))  # no branches: what is reached cannot be foreseen


def alpha_writer(exp: Callable) -> Callable:
    """Return the function that writes opacity exp(-sigma) of a Gaussian, to the places of the rows it reaches."""

    @scalar
    def write_alphas(scratch, rows, records, n, x0, y0):
        as_data = scratch.dtype.type
        mx, my = records[n, MEAN_X] - as_data(x0), records[n, MEAN_Y] - as_data(y0)
        write_lines(scratch, mx, my, records[n, SLOPE], records[n, HALF_PIVOT])
        half_a, opacity = records[n, HALF_A], records[n, OPACITY]
        for row in rows_of(rows):
            store(scratch, ALPHAS + row * WIDTH, opacity * exp(-sigma_of(scratch, row, half_a)))

    return write_alphas
