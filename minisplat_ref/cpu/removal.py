"""The change of the image without each Gaussian; see ``reference.removal``.

The loop is that of :mod:`minisplat_ref.cpu.compositing.backward`: front to back, with the arithmetic of the forward
pass. Each channel keeps its own light from behind the current hit, because the square of a sum over channels would be
another quantity. A pair (tile, Gaussian) has its own slot, and the slots of each Gaussian are summed in order, in
float64: the same bytes at any number of threads.
"""

import functools
from collections.abc import Callable

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.compositing.exponential import choose_exponential
from minisplat_ref.cpu.compositing.records import COLOR, records_of
from minisplat_ref.cpu.compositing.tile_rows import ALPHAS, SCRATCH_SIZE, alpha_writer, find_reached_rows, start_scratch
from minisplat_ref.cpu.compositing.tile_state import (
    CHECK_EVERY,
    N_ROWS,
    Tile,
    corner,
    marked_rows,
    open_rows,
    pack_frame,
    pack_lists,
    row_in_image,
    start_tile,
    take_tiles,
)
from minisplat_ref.cpu.gaussian_rows import eight_rows
from minisplat_ref.jit.compile import kernel, n_threads, prange, scalar
from minisplat_ref.jit.lanes import WIDTH, broadcast, gather, load, reduce_sum, store
from minisplat_ref.jit.scheduling import make_shared_counter
from minisplat_ref.scalar.compositing import blend
from minisplat_ref.scalar.removal import odds, removal_change
from minisplat_ref.types import Floats, Projection, RenderOutput, TileBins


def removal_changes(
    projection: Projection,
    colors: Floats,
    bins: TileBins,
    conventions: Conventions,
    output: RenderOutput,
) -> Floats:
    """Return the squared change of the image without each Gaussian; see ``reference.removal.removal_changes``."""
    dtype, n_channels = colors.dtype, colors.shape[1]
    slots = np.zeros(len(bins.gaussian_ids), dtype)  # remain zero behind the hit that finishes a tile
    exp = choose_exponential(dtype)
    removal_kernel(exp, n_channels)(
        output.saved if output.saved is not None else records_of(projection, colors, conventions),
        pack_lists(bins),
        n_threads(),
        pack_frame(bins.grid, conventions, dtype),
        output.image.reshape(output.alpha.size, n_channels),
        slots,
    )
    owners = np.repeat(np.arange(len(colors)), np.diff(bins.gaussian_offsets))  # of the slots
    changes = np.zeros(len(colors))
    np.add.at(changes, owners, slots)
    return changes


@functools.cache
def removal_kernel(exp: Callable, n_channels: int) -> Callable:
    """Compile the kernel for an exponential and a number of channels."""
    behind_place = WIDTH  # after the transmittance: the light from behind the current hit, by channels
    n_fields = 1 + n_channels
    row_size = n_fields * WIDTH
    write_alphas = alpha_writer(exp)

    @scalar
    def start(state, x0, y0, frame, image):
        for row in range(N_ROWS):
            x, y, n_pixels = row_in_image(row, x0, y0, frame)
            if n_pixels > 0:  # otherwise as start_tile left it
                first = y * frame.width + x
                rows = eight_rows(first, first + n_pixels)
                for k in range(n_channels):
                    store(state, row * row_size + behind_place + k * WIDTH, gather(image, rows, k))

    @scalar
    def remove_from_tile(s, scratch, records, tile, frame, slots):
        x0, y0, ids, slots_of = tile
        is_open = open_rows(s, n_fields)
        next_rows = find_reached_rows(records, ids, 0, x0, y0)
        for m in range(ids.size):
            if m % CHECK_EVERY == CHECK_EVERY - 1:
                is_open = open_rows(s, n_fields)
            if is_open == np.uint64(0):
                break
            rows = next_rows & is_open
            next_rows = find_reached_rows(records, ids, m + 1, x0, y0)
            n = ids[m]
            write_alphas(scratch, rows, records, n, x0, y0)
            total = broadcast(s.dtype.type(0))
            for row in marked_rows(rows):
                i = row * row_size
                unclamped = load(scratch, ALPHAS + row * WIDTH)
                after, weight = blend(load(s, i), unclamped, frame)
                store(s, i, after)
                hit_odds = odds(weight, unclamped, frame)
                for k in range(n_channels):
                    light = weight * records[n, COLOR + k]
                    behind = load(s, i + behind_place + k * WIDTH) - light
                    store(s, i + behind_place + k * WIDTH, behind)
                    q = removal_change(light, hit_odds, behind)
                    total = total + q * q
            slots[slots_of[m]] = reduce_sum(total)

    @kernel()
    def remove_from_tiles(
        records,  # [N, 13 + D]
        lists,  # TileLists
        n_threads,
        frame,
        image,  # [H * W, D]
        slots,  # [M] zeros
    ):
        offsets, ids, slots_of = lists
        taken = make_shared_counter()
        for _ in prange(n_threads):
            state = np.empty(N_ROWS * row_size, image.dtype)
            scratch = np.empty(SCRATCH_SIZE, image.dtype)
            start_scratch(scratch)
            for i in take_tiles(taken, n_threads, offsets):
                x0, y0 = corner(i, frame)
                tile = Tile(x0, y0, ids[offsets[i] : offsets[i + 1]], slots_of[offsets[i] :])
                start_tile(state, x0, y0, frame, n_fields)
                start(state, x0, y0, frame, image)
                remove_from_tile(state, scratch, records, tile, frame, slots)

    return remove_from_tiles
