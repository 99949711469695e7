"""What the pixels of one tile remember while its Gaussians pass by, and how tiles are dealt out to threads.

A tile is 8 pixels wide, so any run of its rows is one contiguous run of pixels, and one flat loop per Gaussian covers
the rows that its box touches. All that the pixels remember lies in ONE array, field after field at a compile-time
distance: the compiler then proves that stores do not overlap loads and turns the loop into vector code; separate
arrays exceed its alias checks. The pixel centres are fields too: two loads are cheaper than integer arithmetic on the
loop index.
"""

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.tiling import TILE_HEIGHT, TILE_WIDTH
from minisplat_ref.scalar._jit import n_threads, scalar
from minisplat_ref.scalar.compositing import Frame
from minisplat_ref.scalar.literals import HALF, ONE, ZERO
from minisplat_ref.types import Ints, TileBins

PIXELS = TILE_WIDTH * TILE_HEIGHT
T = 0  # transmittance, negative once the pixel is finished
X = PIXELS  # pixel centre
Y = 2 * PIXELS
WEIGHT = 3 * PIXELS  # alpha T of the current hit
BEHIND = 4 * PIXELS  # backward: the part of <v, image> that lies behind the current hit
SHADE = 5 * PIXELS  # backward: <v, colour of the current hit> over the channels beyond the third
BEST = 4 * PIXELS  # forward: largest weight so far
BEST_PLACE = 5 * PIXELS  # forward: place of its Gaussian in the tile's list, -1 for none
CROSSING = 6 * PIXELS  # forward: depth of the hit that took the transmittance below one half, or 0
CHANNELS = 7 * PIXELS  # forward: the image so far; backward: v
RANGES_PER_THREAD = 8
CHECK_EVERY = 8  # hits between two tests whether the whole tile is finished


def frame_of(bins: TileBins, conventions: Conventions, dtype: np.dtype) -> Frame:
    """Image size and thresholds as the kernels take them."""
    least = dtype.type(conventions.transmittance_min)
    if conventions.stops_at_equality:
        least = np.nextafter(least, dtype.type(1))  # T > t is T >= the next float above t
    thresholds = (
        conventions.alpha_min,
        conventions.alpha_max,
        least,
        conventions.alpha_max if conventions.clamp_stops_mean_gradient else np.inf,
        conventions.alpha_max if conventions.clamp_stops_shape_gradient else np.inf,
    )
    return Frame(bins.grid.width, bins.grid.height, *(dtype.type(value) for value in thresholds))


def tile_ranges(bins: TileBins) -> Ints:
    """Cut the tiles, in their order, into ranges of about equal numbers of pairs; return the ends, from 0.

    Neighbouring tiles share Gaussians, so a range of them keeps records in the cache. A range is one thread's work;
    there are several per thread because equal pairs are not equal work where pixels finish early.
    """
    n_ranges = RANGES_PER_THREAD * n_threads()
    work = bins.tile_offsets + np.arange(len(bins.tile_offsets))  # an empty tile is some work too
    return np.searchsorted(work, np.linspace(0, work[-1], n_ranges + 1)).astype(np.int64)


@scalar
def start_tile(state, tile, frame):
    """Reset the transmittances and pixel centres; pixels beyond the image's edge start finished. Return its corner."""
    n_tiles_x = (frame.width + TILE_WIDTH - 1) // TILE_WIDTH
    x0 = tile % n_tiles_x * TILE_WIDTH
    y0 = tile // n_tiles_x * TILE_HEIGHT
    for i in range(PIXELS):
        x = x0 + i % TILE_WIDTH
        y = y0 + i // TILE_WIDTH
        state[X + i] = x + HALF
        state[Y + i] = y + HALF
        state[T + i] = ONE if x < frame.width and y < frame.height else -ONE
    return x0, y0


@scalar
def is_finished(state):
    """Whether no pixel of the tile accepts another hit: an integer sum, which vectorises where a maximum does not."""
    n_open = np.int32(0)
    for i in range(PIXELS):
        n_open += np.int32(state[T + i] > ZERO)
    return n_open == 0
