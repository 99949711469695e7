"""The number of rows of eight pixels that the blending kernels compute: their work, as distinct from their speed."""

import numpy as np

from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.cpu.compositing.exponential import exp_fast
from minisplat_ref.cpu.compositing.records import records_of
from minisplat_ref.cpu.compositing.tile_rows import (
    ALPHAS,
    SCRATCH_SIZE,
    alpha_writer,
    find_reached_rows,
    start_scratch,
)
from minisplat_ref.cpu.compositing.tile_state import (
    CHECK_EVERY,
    N_ROWS,
    corner,
    marked_rows,
    open_rows,
    pack_frame,
    start_tile,
)
from minisplat_ref.jit.compile import kernel
from minisplat_ref.jit.lanes import WIDTH, load, store
from minisplat_ref.scalar.compositing import blend
from minisplat_ref.types import Floats, Projection, TileBins

_write_alphas = alpha_writer(exp_fast)


@kernel(parallel=False)
def _count_rows(records, ids, tile_offsets, frame):  # type: ignore[no-untyped-def]
    """Count the rows that the kernels compute, by updating only the transmittance."""
    state, scratch = np.empty(N_ROWS * WIDTH, records.dtype), np.empty(SCRATCH_SIZE, records.dtype)
    start_scratch(scratch)
    total = 0
    for tile in range(tile_offsets.size - 1):
        x0, y0 = corner(tile, frame)
        tile_ids = ids[tile_offsets[tile] : tile_offsets[tile + 1]]
        start_tile(state, x0, y0, frame, 1)
        is_open = open_rows(state, 1)
        for m in range(tile_ids.size):
            if m % CHECK_EVERY == CHECK_EVERY - 1:
                is_open = open_rows(state, 1)
            rows = find_reached_rows(records, tile_ids, m, x0, y0) & is_open
            _write_alphas(scratch, rows, records, tile_ids[m], x0, y0)
            for row in marked_rows(rows):
                total += 1
                after, _ = blend(load(state, row * WIDTH), load(scratch, ALPHAS + row * WIDTH), frame)
                store(state, row * WIDTH, after)
    return total


def count_worked_rows(projection: Projection, channels: Floats, bins: TileBins) -> int:
    """Return the number of rows of eight pixels that the blending kernels compute, over all Gaussians and tiles."""
    records = records_of(projection, channels, GSPLAT_MAIN)
    frame = pack_frame(bins.grid, GSPLAT_MAIN, records.dtype)
    return int(_count_rows(records, bins.gaussian_ids, bins.tile_offsets, frame))
