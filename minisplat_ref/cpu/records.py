"""What the blending kernels read of a Gaussian: one record of 13 + D numbers, with three channels one cache line.

Beside centre, conic and opacity it holds the visible ellipse with x and y exchanged, from which a kernel learns the
rows that the ellipse reaches in a strip of columns, and the columns of the box.
"""

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.tiling import ELLIPSE_MARGIN
from minisplat_ref.scalar._jit import kernel, prange, scalar
from minisplat_ref.scalar.compositing import factors
from minisplat_ref.scalar.literals import HALF, ZERO
from minisplat_ref.scalar.tiling import Outline, visible_outline
from minisplat_ref.types import Floats, Projection

# Columns. The conic is there as its factors, two of them halved as sigma wants them; columns of pixels are floats.
MEAN_X, MEAN_Y, HALF_A, SLOPE, HALF_PIVOT, OPACITY = range(6)
TURNED_SLOPE, TURNED_INVERSE_A, TURNED_PIVOT, Q, TURNED_TILT, COLUMN_FIRST, COLUMN_END, COLOR = range(6, 14)
HALF_A_MAX = np.float32(1e30)  # without a low-pass a footprint can be thinner than float32 can square


@scalar
def _half(factor):
    """Half of a factor of a conic; one that is negative becomes so large that its negative squares are no hits."""
    return min(HALF * factor, HALF_A_MAX) if factor >= ZERO else HALF_A_MAX


@scalar
def _write_record(n, projection, colors, alpha_min, records):
    a, slope, pivot = factors(projection.conics[n, 0], projection.conics[n, 1], projection.conics[n, 2])
    turned = factors(projection.conics[n, 2], projection.conics[n, 1], projection.conics[n, 0])
    outline = visible_outline(*turned, projection.opacities[n], alpha_min, ELLIPSE_MARGIN)
    records[n, MEAN_X], records[n, MEAN_Y] = projection.means2d[n, 0], projection.means2d[n, 1]
    records[n, HALF_A] = _half(a)
    records[n, SLOPE] = slope
    records[n, HALF_PIVOT] = _half(pivot)
    records[n, OPACITY] = projection.opacities[n]
    records[n, TURNED_SLOPE], records[n, TURNED_INVERSE_A] = outline.slope, outline.inverse_a
    records[n, TURNED_PIVOT], records[n, Q] = min(outline.pivot, HALF_A_MAX), outline.q
    records[n, TURNED_TILT] = outline.tilt
    records[n, COLUMN_FIRST], records[n, COLUMN_END] = projection.boxes[n, 0], projection.boxes[n, 2]
    for k in range(colors.shape[1]):
        records[n, COLOR + k] = colors[n, k]


@scalar
def turned_outline(records, n):
    """Outline of the visible ellipse with x and y exchanged: ``rightmost_offset`` then gives its lowest point."""
    return Outline(
        records[n, TURNED_SLOPE],
        records[n, TURNED_INVERSE_A],
        records[n, TURNED_PIVOT],
        records[n, Q],
        records[n, TURNED_TILT],
    )


@kernel()
def _write_records(projection, colors, alpha_min, records):
    for n in prange(records.shape[0]):
        if projection.radii[n, 0] > 0:
            _write_record(n, projection, colors, alpha_min, records)


def records_of(projection: Projection, colors: Floats, conventions: Conventions) -> Floats:
    """Return the records [N, 13 + D]; those of culled Gaussians are undefined."""
    records = np.empty((len(colors), COLOR + colors.shape[1]), colors.dtype)
    _write_records(projection, colors, colors.dtype.type(conventions.alpha_min), records)
    return records
