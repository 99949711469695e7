"""What the kernels read of a Gaussian, what the pixels of a tile remember, and how tiles are dealt out to threads.

A Gaussian is one record of 8 + D numbers, so that a pair costs one or two cache lines rather than one for each array.

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
from minisplat_ref.types import Floats, Ints, Projection, TileBins

PIXELS = TILE_WIDTH * TILE_HEIGHT
T = 0  # transmittance, negative once the pixel is finished
X = PIXELS  # pixel centre
Y = 2 * PIXELS
WEIGHT = 3 * PIXELS  # alpha T of the current hit
BEHIND = 4 * PIXELS  # backward: the part of <v, image> that lies behind the current hit
SHADE = 5 * PIXELS  # backward: <v, colour of the current hit> over the channels beyond the third
CHANNELS = 6 * PIXELS  # forward: the image so far; backward: v
N_FUSED = 3  # channels that ride in the pixel loop itself; fewer are padded with zeros, further ones have own loops
MEAN_X, MEAN_Y, CONIC_A, CONIC_B, CONIC_C, OPACITY, ROW_FIRST, ROW_END, COLOR = range(9)  # columns of a record
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


def records_of(projection: Projection, colors: Floats) -> Floats:
    """Gather all that a hit needs of each Gaussian into one row of [N, 8 + D]; rows of the box count as floats."""
    records = np.empty((len(colors), COLOR + colors.shape[1]), colors.dtype)
    records[:, :CONIC_A] = projection.means2d
    records[:, CONIC_A:OPACITY] = projection.conics
    records[:, OPACITY] = projection.opacities
    records[:, ROW_FIRST:COLOR] = projection.boxes[:, 1::2]
    records[:, COLOR:] = colors
    return records


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
def fused_colors(record, n_channels):
    """First three channels of a Gaussian, zeros for those that there are not."""
    zero = record.dtype.type(0)
    return (
        record[COLOR] if n_channels > 0 else zero,
        record[COLOR + 1] if n_channels > 1 else zero,
        record[COLOR + 2] if n_channels > 2 else zero,
    )


@scalar
def pixel_run(record, y0):
    """First pixel and number of pixels of the tile's rows that the box of a Gaussian touches."""
    first = max(np.int64(record[ROW_FIRST]) - y0, 0)
    end = min(np.int64(record[ROW_END]) - y0, TILE_HEIGHT)
    return first * TILE_WIDTH, (end - first) * TILE_WIDTH


@scalar
def is_finished(state):
    """Whether no pixel of the tile accepts another hit."""
    largest = -ONE
    for i in range(PIXELS):
        largest = max(largest, state[T + i])
    return largest < ZERO
