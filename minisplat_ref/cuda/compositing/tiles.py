"""A tile is a block of 256 threads, one for each pixel. Batches of its list are read into shared memory."""

from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.cuda.arrays import to_device, to_host
from minisplat_ref.cuda.compositing.records import HALF_A, HALF_PIVOT, MEAN_X, MEAN_Y, OPACITY, SLOPE, X0, X1, Y0, Y1
from minisplat_ref.cuda.footprints import TILE
from minisplat_ref.cuda.target import WARP, cuda, device_function, is_simulated
from minisplat_ref.cuda.tiling import TileLists
from minisplat_ref.jit.lanes import libm_exp, select
from minisplat_ref.jit.literals import ZERO
from minisplat_ref.scalar.compositing import mahalanobis
from minisplat_ref.types import Floats, TileBins

BLOCK = TILE * TILE
N_WARPS = BLOCK // WARP
SHARED_BYTES = 24 << 10  # of a block, so that several blocks have room on a multiprocessor


def batch_size(n_numbers: int, dtype: np.dtype) -> int:
    """Return how many Gaussians are read at once into shared memory.

    Parameters
    ----------
    n_numbers : int
        In shared memory for each of them.
    dtype : dtype
        Of these numbers.

    Returns
    -------
    int
        From one warp to one block of them.
    """
    n, most = WARP, WARP if is_simulated else BLOCK  # in the simulator few, so that tests have several batches
    while n < most and 2 * n * n_numbers * dtype.itemsize <= SHARED_BYTES:
        n *= 2
    return n


def pack_lists(bins: TileBins) -> Any:
    """Return the lists on the device."""
    return to_device(TileLists(bins.tile_offsets, bins.gaussian_ids, bins.slots))


def pass_background(background: Floats) -> tuple[Any, ...]:
    """Return the background as numbers, which are passed to a kernel without a copy to the device; at least one."""
    return tuple(to_host(background)) or (background.dtype.type(0),)


class Pixels(NamedTuple):
    """All pixels of the image, or the gradient with respect to them."""

    image: Floats
    """[H, W, D]."""
    alpha: Floats
    """[H, W]."""


@device_function
def thread_pixel(frame):
    """Return column and line of the thread's pixel, which may lie beyond the image's edge."""
    tile, thread = cuda.blockIdx.x, cuda.threadIdx.x
    n_tiles_x = (frame.width + TILE - 1) // TILE
    return tile % n_tiles_x * TILE + thread % TILE, tile // n_tiles_x * TILE + thread // TILE


@device_function
def read_batch(records, ids, first, n_listed, n_fields, batch):
    """Read the records of ``n_listed`` pairs from ``first`` on; all threads of the block call it."""
    cuda.syncthreads()  # all have finished with the batch before
    for i in range(cuda.threadIdx.x, n_listed * n_fields, BLOCK):
        j = i // n_fields
        batch[j, i - j * n_fields] = records[ids[first + j], i - j * n_fields]
    cuda.syncthreads()


@device_function
def clear_slots(slots, slots_of, first, end):
    """Set the slots of some pairs to zero: those behind a tile's last batch. All threads of the block call it."""
    n_numbers = slots.shape[1]
    for i in range(first * n_numbers + cuda.threadIdx.x, end * n_numbers, BLOCK):
        slots[slots_of[i // n_numbers], i % n_numbers] = ZERO


@device_function
def hit(batch, j, center_x, center_y):
    """Return alpha before its clamp at a pixel's centre, and e = dx + slope dy and dy."""
    dy = batch[j, MEAN_Y] - center_y
    e = batch[j, MEAN_X] - center_x + batch[j, SLOPE] * dy
    sigma = mahalanobis(e, batch[j, HALF_A], batch[j, HALF_PIVOT] * dy * dy)
    is_inside = (
        (batch[j, X0] < center_x) & (center_x < batch[j, X1]) & (batch[j, Y0] < center_y) & (center_y < batch[j, Y1])
    )
    return select(is_inside, batch[j, OPACITY] * libm_exp(-sigma), ZERO), e, dy
