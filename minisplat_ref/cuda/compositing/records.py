"""The record of a Gaussian that blending kernels read: ten numbers and its colours, in the data's dtype.

Conics are float64; their factors are computed here, once for each Gaussian, so that blending needs no float64.
"""

from typing import Any

from minisplat_ref.cuda.arrays import empty, to_device
from minisplat_ref.cuda.target import cuda, device_function, gpu_kernel, launch_rows
from minisplat_ref.scalar.compositing import factors, halve_factor
from minisplat_ref.types import Floats, Projection

# Columns. The conic is stored as its factors, two of them halved as sigma needs them; edges of the box are floats.
MEAN_X, MEAN_Y, HALF_A, SLOPE, HALF_PIVOT, OPACITY, X0, Y0, X1, Y1, COLOR = range(11)


@device_function
def store_record(records, n, center, conic, opacity, box, color):
    """Write the record of a Gaussian; colours from ``color[0]`` on are of its channels."""
    a, slope, pivot = factors(conic[0], conic[1], conic[2])
    records[n, MEAN_X], records[n, MEAN_Y] = center[0], center[1]
    records[n, HALF_A], records[n, SLOPE], records[n, HALF_PIVOT] = halve_factor(a), slope, halve_factor(pivot)
    records[n, OPACITY] = opacity
    for i in range(4):
        records[n, X0 + i] = box[i]
    for k in range(records.shape[1] - COLOR):
        records[n, COLOR + k] = color[k]


@gpu_kernel
def write_records(projection, colors, records):
    """Write the record of one Gaussian."""
    n = cuda.grid(1)
    if n >= records.shape[0] or projection.radii[n, 0] == 0:
        return
    center, conic = projection.means2d[n], projection.conics[n]
    store_record(records, n, center, conic, projection.opacities[n], projection.boxes[n], colors[n])


def records_of(projection: Projection, colors: Floats) -> Any:
    """Return the records [N, 10 + D] on the device; those of culled Gaussians are undefined."""
    n, n_channels = colors.shape
    records = empty((n, COLOR + n_channels), colors.dtype)
    launch_rows(write_records, n, to_device(projection), to_device(colors), records)
    return records
