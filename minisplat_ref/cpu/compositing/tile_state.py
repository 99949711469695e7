"""The state of one tile's pixels while its Gaussians are blended, and the scheduling of tiles to threads.

A tile of 32 x 16 pixels is 64 rows of eight pixels, and any set of rows is an integer of 64 bits: the rows that a
Gaussian reaches, the rows in which a pixel still accepts hits, and by one ``&`` the rows with work to do. The rows are
numbered down a strip eight pixels wide, then down the next. All fields of a row are contiguous in memory, the
transmittance first, then the fields of the kernel.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.tiling import TILE_HEIGHT, TILE_WIDTH
from minisplat_ref.errors import InputError
from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import WIDTH, broadcast, iota, load, lowest_bit, reduce_any, select, store
from minisplat_ref.jit.literals import ONE, ZERO
from minisplat_ref.jit.scheduling import dynamic_range
from minisplat_ref.scalar.compositing import Frame
from minisplat_ref.types import Floats, Ints, TileBins, TileGrid

N_STRIPS = TILE_WIDTH // WIDTH
N_ROWS = N_STRIPS * TILE_HEIGHT  # bits of an integer
RANGES_PER_THREAD = 32
CHECK_EVERY = 16  # hits between two checks which pixels are finished


class TileLists(NamedTuple):
    """The tiles' lists as kernels read them; see :class:`~minisplat_ref.types.TileBins`."""

    offsets: Ints
    """[n_tiles + 1] tile t owns the pairs [offsets[t], offsets[t + 1])."""
    ids: Ints
    """[M] Gaussian of each pair."""
    slots: Ints
    """[M] slot of each pair."""


class Tile(NamedTuple):
    """One tile and its pairs."""

    x0: int
    """Column of its first pixel."""
    y0: int
    """Line of its first pixel."""
    ids: Ints
    """[m] Gaussian of each pair."""
    slots: Ints
    """[m or more] slot of each pair."""


class Pixels(NamedTuple):
    """All pixels of the image, line by line, or the gradient with respect to them."""

    image: Floats
    """[H * W, D]."""
    alpha: Floats
    """[H * W]."""


def pack_lists(bins: TileBins) -> TileLists:
    """Return the lists without their grid.

    Raises
    ------
    InputError
        Their tiles have another size than the kernels have.
    """
    if (bins.grid.tile_width, bins.grid.tile_height) != (TILE_WIDTH, TILE_HEIGHT):
        raise InputError(
            f"these kernels of the CPU blend tiles of {TILE_WIDTH} x {TILE_HEIGHT} pixels, not of"
            f" {bins.grid.tile_width} x {bins.grid.tile_height}: choose the backend cpu for all stages"
        )
    return TileLists(bins.tile_offsets, bins.gaussian_ids, bins.slots)


def pack_frame(grid: TileGrid, conventions: Conventions, dtype: np.dtype) -> Frame:
    """Return image size and thresholds in the form that kernels take."""
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
    return Frame(grid.width, grid.height, *(dtype.type(value) for value in thresholds))


@scalar
def first_tile(i, n_ranges, offsets):
    """Return the first tile of range ``i`` when the tiles are cut, in order, into ranges of about equally many pairs.

    Neighbouring tiles share Gaussians, so a range of tiles keeps their records in the cache. One thread works on a
    range; there are many ranges per thread, because where pixels finish early equal numbers of pairs are not equal
    work, and threads are not equally fast.
    """
    first, end = 0, offsets.size - 1
    wanted = (offsets[end] + end) * i // n_ranges  # an empty tile is some work too
    while first < end:
        middle = (first + end) // 2
        if offsets[middle] + middle < wanted:
            first = middle + 1
        else:
            end = middle
    return first


@scalar
def take_tiles(taken, n_threads, offsets):
    """Yield the tiles of the ranges that this thread takes."""
    n_ranges = RANGES_PER_THREAD * n_threads
    for i in dynamic_range(taken, n_ranges):
        for tile in range(first_tile(i, n_ranges, offsets), first_tile(i + 1, n_ranges, offsets)):  # noqa: UP028
            yield tile


@scalar
def corner(tile, frame):
    """Return column and row of a tile's first pixel."""
    n_tiles_x = (frame.width + TILE_WIDTH - 1) // TILE_WIDTH
    return tile % n_tiles_x * TILE_WIDTH, tile // n_tiles_x * TILE_HEIGHT


@scalar
def row_in_image(row, x0, y0, frame):
    """Return column and line of a row's first pixel, and the number of its eight pixels that lie in the image."""
    x, y = x0 + row // TILE_HEIGHT * WIDTH, y0 + row % TILE_HEIGHT
    return x, y, max(0, min(WIDTH, frame.width - x)) if y < frame.height else 0


@scalar
def start_tile(state, x0, y0, frame, n_fields):
    """Set all fields to zero and the transmittances to one; pixels beyond the image's edge start finished."""
    as_data = state.dtype.type
    state[:] = ZERO
    for row in range(N_ROWS):
        _, _, n_pixels = row_in_image(row, x0, y0, frame)
        is_inside = iota(as_data(0)) < as_data(n_pixels)
        store(state, row * n_fields * WIDTH, select(is_inside, broadcast(as_data(1)), -ONE))


@scalar
def open_rows(state, n_fields):
    """Return as bits the rows with a pixel that still accepts hits."""
    rows = np.uint64(0)
    for row in range(N_ROWS):
        is_open = reduce_any(load(state, row * n_fields * WIDTH) > ZERO)
        rows |= np.uint64(is_open) << np.uint64(row)
    return rows


@scalar
def marked_rows(bits):
    """Yield the rows of a set, from the first to the last."""
    while bits != np.uint64(0):
        yield lowest_bit(bits)
        bits &= bits - np.uint64(1)
