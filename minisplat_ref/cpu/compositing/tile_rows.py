"""The part of a tile that a Gaussian reaches, and its alpha there.

The rows that the visible ellipse reaches are found strip by strip, so that a slanted ellipse covers a staircase of rows
rather than its box. Terms that all pixels of a line share are computed once, for all lines of the tile together.

Alpha is computed for all rows before any is blended. The exponential is a long chain of dependent operations, and
blending is another. A processor hides their latency by executing other pixels out of order, and its window spans more
pixels if there is less to do for each.
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
    transpose_outline,
)
from minisplat_ref.cpu.compositing.tile_state import N_ROWS, N_STRIPS, marked_rows
from minisplat_ref.cpu.tiling import ELLIPSE_MARGIN, TILE_HEIGHT
from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import (
    WIDTH,
    broadcast,
    floor,
    iota,
    load,
    maximum,
    minimum,
    prefetch,
    range_mask,
    select,
    store,
)
from minisplat_ref.jit.literals import FOUR, HALF, ONE
from minisplat_ref.scalar.compositing import mahalanobis
from minisplat_ref.scalar.tiling import rightmost_offset

FETCH_AHEAD = 8  # Gaussians

# Offsets into a thread's scratch buffer, which fits a page of memory: a load waits for a recent store if their
# addresses differ by a multiple of the page size.
ALPHAS = 0  # of the rows that the current Gaussian reaches
CENTRES_X = N_ROWS * WIDTH  # pixel centres of a row of each strip, counted from the tile's edge
CENTRES_Y = CENTRES_X + N_STRIPS * WIDTH  # the same for every line of pixels
TO_MEAN_Y = CENTRES_Y + TILE_HEIGHT  # dy of each line
RIDGE = TO_MEAN_Y + TILE_HEIGHT  # where sigma is least on each line
LEAST = RIDGE + TILE_HEIGHT  # that least sigma
SCRATCH_SIZE = LEAST + TILE_HEIGHT


@scalar
def start_scratch(scratch):
    """Write the pixel centres of a tile."""
    as_data = scratch.dtype.type
    for strip in range(N_STRIPS):
        store(scratch, CENTRES_X + strip * WIDTH, iota(as_data(0)) + (HALF + as_data(strip * WIDTH)))
    for line in range(TILE_HEIGHT):
        scratch[CENTRES_Y + line] = HALF + as_data(line)


@scalar
def write_lines(scratch, mx, my, slope, half_pivot):
    """Write the terms that all pixels of a line share: with e = dx + slope dy, sigma is (a e^2 + pivot dy^2) / 2.

    On each line it is least at mx + slope dy, and e is the distance from there.
    """
    for i in range(0, TILE_HEIGHT, WIDTH):
        dy = my - load(scratch, CENTRES_Y + i)
        store(scratch, TO_MEAN_Y + i, dy)
        store(scratch, RIDGE + i, mx + slope * dy)
        store(scratch, LEAST + i, half_pivot * dy * dy)


@scalar
def ridge_offsets(scratch, row):
    """Return e at the pixel centres of a row."""
    return scratch[RIDGE + row % TILE_HEIGHT] - load(scratch, CENTRES_X + row // TILE_HEIGHT * WIDTH)


@scalar
def mean_offset_y(scratch, row):
    """Return dy of a row, a single number."""
    return scratch[TO_MEAN_Y + row % TILE_HEIGHT]


@scalar
def row_sigma(scratch, row, half_a):
    """Return sigma at the pixel centres of a row."""
    return mahalanobis(ridge_offsets(scratch, row), half_a, scratch[LEAST + row % TILE_HEIGHT])


@scalar
def find_reached_rows(records, ids, m, x0, y0):
    """Return as bits the rows of eight pixels that the visible ellipse of the tile's m-th Gaussian reaches.

    It computes eight bounds at once: the extent of the ellipse up and down in each of the four strips. A kernel calls
    it one Gaussian ahead: while the one before is blended, the record is fetched and the root computed.
    """
    if m >= ids.size:
        return np.uint64(0)
    prefetch(records, ids[min(m + FETCH_AHEAD, ids.size - 1)])
    as_data = records.dtype.type
    n = ids[m]
    mx, my = records[n, MEAN_X] - as_data(x0), records[n, MEAN_Y] - as_data(y0)
    k, zero = iota(mx), broadcast(as_data(0))
    is_up = k < FOUR
    left = (k - select(is_up, zero, FOUR)) * as_data(WIDTH)  # edges of the strips
    side = select(is_up, broadcast(as_data(-1)), ONE)
    low = left + (HALF - mx)
    offset = rightmost_offset(transpose_outline(records, n), low, low + as_data(WIDTH - 1), side)
    bound = floor(side * my + offset + (HALF + ELLIPSE_MARGIN))  # minus the first row, or the one after the last
    bound = side * maximum(as_data(-TILE_HEIGHT), minimum(select(is_up, zero, as_data(TILE_HEIGHT)), bound))
    is_in_box = (left < records[n, COLUMN_END] - as_data(x0)) & (left > records[n, COLUMN_FIRST] - as_data(x0 + WIDTH))
    return range_mask(select(is_in_box, bound, zero))  # no branches, which would be unpredictable


def alpha_writer(exp: Callable) -> Callable:
    """Return a function that writes a Gaussian's opacity exp(-sigma) for the rows that it reaches."""

    @scalar
    def write_alphas(scratch, rows, records, n, x0, y0):
        as_data = scratch.dtype.type
        mx, my = records[n, MEAN_X] - as_data(x0), records[n, MEAN_Y] - as_data(y0)
        write_lines(scratch, mx, my, records[n, SLOPE], records[n, HALF_PIVOT])
        half_a, opacity = records[n, HALF_A], records[n, OPACITY]
        for row in marked_rows(rows):
            store(scratch, ALPHAS + row * WIDTH, opacity * exp(-row_sigma(scratch, row, half_a)))

    return write_alphas
