"""What the blending kernels read of a Gaussian: one record of 8 + D numbers.

A pair (tile, Gaussian) then costs one or two cache lines rather than one for each array. The record also holds the rows
of pixels whose centres the visible ellipse reaches, which are fewer than those of the box.
"""

import math

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.tiling import ELLIPSE_MARGIN, TILE_HEIGHT, TILE_WIDTH
from minisplat_ref.scalar._jit import kernel, prange, scalar
from minisplat_ref.scalar.compositing import factors
from minisplat_ref.scalar.literals import HALF
from minisplat_ref.scalar.tiling import visible_ellipse
from minisplat_ref.types import Floats, Projection

# Columns. The conic is there as its factors, two of them halved as sigma wants them; rows of pixels are floats.
MEAN_X, MEAN_Y, HALF_A, SLOPE, HALF_PIVOT, OPACITY, ROW_FIRST, ROW_END, COLOR = range(9)
HALF_A_MAX = np.float32(1e30)  # without a low-pass a footprint can be thinner than float32 can square
N_FUSED = 3  # channels that ride in the pixel loop itself; fewer are padded with zeros, further ones have own loops


@scalar
def _write_record(n, projection, colors, alpha_min, records):
    a, slope, pivot = factors(projection.conics[n, 0], projection.conics[n, 1], projection.conics[n, 2])
    my = projection.means2d[n, 1]
    reach = visible_ellipse(a, slope, pivot, projection.opacities[n], alpha_min, ELLIPSE_MARGIN).half_height
    first = math.ceil(max(my - reach - HALF - ELLIPSE_MARGIN, projection.boxes[n, 1]))
    end = math.floor(min(my + reach + HALF + ELLIPSE_MARGIN, projection.boxes[n, 3]))
    records[n, MEAN_X], records[n, MEAN_Y] = projection.means2d[n, 0], my
    records[n, HALF_A] = min(HALF * a, HALF_A_MAX)
    records[n, SLOPE] = slope
    records[n, HALF_PIVOT] = min(HALF * pivot, HALF_A_MAX)
    records[n, OPACITY] = projection.opacities[n]
    records[n, ROW_FIRST], records[n, ROW_END] = first, end
    for k in range(colors.shape[1]):
        records[n, COLOR + k] = colors[n, k]


@kernel()
def _write_records(projection, colors, alpha_min, records):
    for n in prange(records.shape[0]):
        if projection.radii[n, 0] > 0:
            _write_record(n, projection, colors, alpha_min, records)


def records_of(projection: Projection, colors: Floats, conventions: Conventions) -> Floats:
    """Return the records [N, 8 + D]; those of culled Gaussians are undefined."""
    records = np.empty((len(colors), COLOR + colors.shape[1]), colors.dtype)
    _write_records(projection, colors, colors.dtype.type(conventions.alpha_min), records)
    return records


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
