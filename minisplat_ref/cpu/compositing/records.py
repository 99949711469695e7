"""The record of a Gaussian that blending kernels read: 13 numbers and its colours; with three, one cache line.

Besides centre, conic and opacity it holds the visible ellipse with x and y exchanged, from which a kernel computes the
rows that the ellipse reaches in a strip of columns, and the columns of the box. Records are made eight at a time, by
transposing the numbers of eight Gaussians.
"""

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.gaussian_rows import list_visible, load_rows, round_lanes, triple
from minisplat_ref.cpu.projection import N_CHUNKS
from minisplat_ref.cpu.tiling import ELLIPSE_MARGIN
from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.jit.lanes import WIDTH, cast, gather, minimum, scatter
from minisplat_ref.scalar.compositing import HALF_FACTOR_MAX, factors, halve_factor
from minisplat_ref.scalar.tiling import Outline, visible_outline
from minisplat_ref.types import Floats, Projection

# Columns. The conic is stored as its factors, two of them halved as sigma needs them; pixel columns are floats.
MEAN_X, MEAN_Y, HALF_A, SLOPE, HALF_PIVOT, OPACITY = range(6)
TURNED_SLOPE, TURNED_INVERSE_A, TURNED_PIVOT, Q, TURNED_TILT, COLUMN_FIRST, COLUMN_END, COLOR = range(6, 14)
N_FUSED = 3  # channels that every record has; fewer are padded with zeros


def record_size(n_channels: int) -> int:
    """Return the size of a record."""
    return COLOR + max(n_channels, N_FUSED)


@scalar
def _write_eight(rows, projection, colors, alpha_min, records):
    """Write the records of eight Gaussians, up to the third channel."""
    zero = records.dtype.type(0)
    a, b, c = triple(projection.conics, rows)
    a_factor, slope, pivot = factors(a, b, c)
    opacity = gather(projection.opacities, rows, 0)
    outline = visible_outline(*round_lanes(factors(c, b, a), zero), opacity, alpha_min, ELLIPSE_MARGIN)
    means2d, boxes = projection.means2d, projection.boxes
    first_half = (
        *(gather(means2d, rows, 0), gather(means2d, rows, 1)),
        *round_lanes((halve_factor(a_factor), slope, halve_factor(pivot)), zero),
        *(opacity, outline.slope, outline.inverse_a),
    )
    second_half = (
        *(minimum(outline.pivot, HALF_FACTOR_MAX), outline.q, outline.tilt),
        *(cast(gather(boxes, rows, 0), zero), cast(gather(boxes, rows, 2), zero)),
        *(gather(colors, rows, 0), gather(colors, rows, 1), gather(colors, rows, 2)),
    )
    scatter(records, rows, MEAN_X, first_half)
    scatter(records, rows, TURNED_PIVOT, second_half)


@scalar
def _write_part(first, end, projection, colors, alpha_min, records):
    visible = np.empty(end - first + WIDTH, np.int64)
    count = list_visible(projection.radii, first, end, visible)
    for i in range(0, count, WIDTH):
        _write_eight(load_rows(visible, i), projection, colors, alpha_min, records)
    for n in range(first, end):
        for k in range(N_FUSED, colors.shape[1]):
            records[n, COLOR + k] = colors[n, k]


@kernel()
def _write_records(
    projection,  # Projection
    colors,  # [N, D]
    alpha_min,
    records,  # [N, 13 + D], D at least three
):
    n = records.shape[0]
    for part in prange(N_CHUNKS):
        _write_part(n * part // N_CHUNKS, n * (part + 1) // N_CHUNKS, projection, colors, alpha_min, records)


@scalar
def transpose_outline(records, n):
    """Return the visible ellipse with x and y exchanged, of which ``rightmost_offset`` gives the lowest point."""
    return Outline(
        records[n, TURNED_SLOPE],
        records[n, TURNED_INVERSE_A],
        records[n, TURNED_PIVOT],
        records[n, Q],
        records[n, TURNED_TILT],
    )


def records_of(projection: Projection, colors: Floats, conventions: Conventions) -> Floats:
    """Return the records [N, 13 + D], D at least three; those of culled Gaussians are undefined."""
    n, n_channels = colors.shape
    if n_channels < N_FUSED:
        colors = np.pad(colors, ((0, 0), (0, N_FUSED - n_channels)))
    records = np.empty((n, record_size(n_channels)), colors.dtype)
    _write_records(projection, colors, colors.dtype.type(conventions.alpha_min), records)
    return records
