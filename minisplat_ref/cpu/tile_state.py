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
from minisplat_ref.scalar._jit import scalar
from minisplat_ref.scalar.compositing import Frame
from minisplat_ref.scalar.literals import HALF, ONE, ZERO
from minisplat_ref.types import TileBins

PIXELS = TILE_WIDTH * TILE_HEIGHT
T = 0  # transmittance, negative once the pixel is finished
X = PIXELS  # pixel centre
Y = 2 * PIXELS
WEIGHT = 3 * PIXELS  # alpha T of the current hit
BEHIND = 4 * PIXELS  # backward: the part of <v, image> that lies behind the current hit
SHADE = 5 * PIXELS  # backward: <v, colour of the current hit>
CHANNELS = 6 * PIXELS  # forward: the image so far; backward: v
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


def tile_order(bins: TileBins) -> np.ndarray:
    """Tiles by falling number of pairs: dealt out in turn, they give every thread about equal work."""
    return np.argsort(-np.diff(bins.tile_offsets), kind="stable").astype(np.int32)


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
def pixel_run(boxes, n, y0):
    """First pixel and number of pixels of the tile's rows that the box of Gaussian n touches."""
    first = max(boxes[n, 1] - y0, 0)
    last = min(boxes[n, 3] - y0, TILE_HEIGHT)
    return first * TILE_WIDTH, (last - first) * TILE_WIDTH


@scalar
def is_finished(state):
    """Whether no pixel of the tile accepts another hit."""
    largest = -ONE
    for i in range(PIXELS):
        largest = max(largest, state[T + i])
    return largest < ZERO
