"""L1 + D-SSIM of an image, forward and backward (3DGS section 5.1): a block for each tile of 16 x 16 pixels.

The Gaussian window is separable. A block reads its tile of one channel of both images with a margin of five pixels into
shared memory, filters rows and then columns, and writes the derivatives of SSIM with respect to the three windowed
means. A second kernel filters these likewise. One half is subtracted as on the CPU, and for its reason: see
:mod:`minisplat_ref.cpu.loss.rows`. Outside the image both are black.
"""

import functools
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import SSIM_C1, SSIM_C2, SSIM_SIGMA, SSIM_WINDOW
from minisplat_ref.cpu.loss import LossTape
from minisplat_ref.cuda.arrays import beside, is_on_device, to_device, to_host
from minisplat_ref.cuda.compositing.tiles import BLOCK, N_WARPS
from minisplat_ref.cuda.footprints import TILE
from minisplat_ref.cuda.target import (
    GpuKernel,
    cuda,
    device_function,
    gpu_kernel,
    is_simulated,
    launch,
    reduce_warps,
)
from minisplat_ref.cuda.workspace import Workspace
from minisplat_ref.jit.lanes import select
from minisplat_ref.jit.literals import HALF, ONE, ZERO
from minisplat_ref.scalar.loss import photometric_vjp, ssim_and_derivatives
from minisplat_ref.types import Bools, Floats, Ints

MARGIN = SSIM_WINDOW // 2
SIDE = TILE + 2 * MARGIN  # of a tile with its margin
N_CHANNELS = 3
N_MOMENTS = 4  # windowed means of I, T, I^2 + T^2 and I T
N_DERIVATIVES = 3  # of SSIM with respect to the windowed means of I, I^2 and I T


class Pair(NamedTuple):
    """An image and its target."""

    image: Floats
    """[H, W, 3]."""
    target: Floats | Ints
    """[H, W, 3] likewise, or bytes."""
    unit: np.floating
    """Factor from the target's numbers to [0, 1], in the dtype of the image."""
    mask: Bools
    """[H, W] True where a pixel counts; [1, 1] True where all do."""


def window_weights(dtype: np.dtype) -> Floats:
    """Return the weights [11] of the window."""
    offsets = np.arange(SSIM_WINDOW) - MARGIN
    weights = np.exp(-0.5 * (offsets / SSIM_SIGMA) ** 2)
    return (weights / weights.sum()).astype(dtype)


@device_function
def corner(width):
    """Return column and line of the first pixel of the block's tile."""
    n_tiles_x = (width + TILE - 1) // TILE
    tile = cuda.blockIdx.x
    return tile % n_tiles_x * TILE, tile // n_tiles_x * TILE


@device_function
def counts(mask, y, x):
    """Return whether a pixel counts."""
    return mask[min(y, mask.shape[0] - 1), min(x, mask.shape[1] - 1)]


@device_function
def filter_rows(padded, k, window, zero, n_needed, out):
    """Filter the needed rows of layer ``k`` of ``padded`` [n, SIDE, SIDE] into ``out`` [n, SIDE, TILE]."""
    for i in range(cuda.threadIdx.x, SIDE * TILE, BLOCK):
        row, column = i // TILE, i % TILE
        if row < n_needed[0] and column < n_needed[1]:
            total = zero
            for tap in range(SSIM_WINDOW):
                total += window[tap] * padded[k, row, column + tap]
            out[k, row, column] = total


@device_function
def filter_column(rows, k, window, zero):
    """Return the windowed mean down the thread's column of layer ``k`` of ``rows`` [n, SIDE, TILE]."""
    row, column = cuda.threadIdx.x // TILE, cuda.threadIdx.x % TILE
    total = zero
    for tap in range(SSIM_WINDOW):
        total += window[tap] * rows[k, row + tap, column]
    return total


@functools.cache
def similarity_kernel(dtype: np.dtype) -> GpuKernel:
    """Return the forward kernel for a dtype."""
    real, c1, c2 = dtype.type, dtype.type(SSIM_C1), dtype.type(SSIM_C2)
    n_exchanged = BLOCK if is_simulated else 1

    @gpu_kernel
    def similarity_tiles(
        pair,  # Pair
        window,  # [11]
        derivatives,  # [3, H, W, 3]
        sums,  # [n_tiles, 2] of |I - T| and of SSIM
    ):
        image, target, unit, mask = pair
        padded = cuda.shared.array((2, SIDE, SIDE), dtype)
        rows = cuda.shared.array((N_MOMENTS, SIDE, TILE), dtype)
        partial = cuda.shared.array((N_WARPS, 2), dtype)
        exchange = cuda.shared.array((n_exchanged, 2), dtype)
        own = cuda.local.array(2, dtype)
        thread, zero = cuda.threadIdx.x, real(0)
        height, width = image.shape[0], image.shape[1]
        x0, y0 = corner(width)
        x, y = x0 + thread % TILE, y0 + thread // TILE
        is_counted = x < width and y < height and counts(mask, y, x)
        own[0] = own[1] = zero
        for channel in range(N_CHANNELS):
            for i in range(thread, SIDE * SIDE, BLOCK):
                row, column = i // SIDE, i % SIDE
                line, place = y0 + row - MARGIN, x0 + column - MARGIN
                found = wanted = -HALF
                if 0 <= line and line < height and 0 <= place and place < width:
                    wanted = unit * real(target[line, place, channel]) - HALF
                    found = select(counts(mask, line, place), image[line, place, channel] - HALF, wanted)
                padded[0, row, column] = found
                padded[1, row, column] = wanted
            cuda.syncthreads()
            for i in range(thread, SIDE * TILE, BLOCK):
                row, column = i // TILE, i % TILE
                if x0 + column >= width or y0 + row >= height + 2 * MARGIN:
                    continue  # no pixel of the image needs it
                mean_i, mean_t, squares, products = zero, zero, zero, zero
                for tap in range(SSIM_WINDOW):
                    a, b = padded[0, row, column + tap], padded[1, row, column + tap]
                    mean_i += window[tap] * a
                    mean_t += window[tap] * b
                    squares += window[tap] * (a * a + b * b)
                    products += window[tap] * (a * b)
                rows[0, row, column], rows[1, row, column] = mean_i, mean_t
                rows[2, row, column], rows[3, row, column] = squares, products
            cuda.syncthreads()
            if x < width and y < height:
                value, by_i, by_ii, by_it = ssim_and_derivatives(
                    filter_column(rows, 0, window, zero),
                    filter_column(rows, 1, window, zero),
                    filter_column(rows, 2, window, zero),
                    filter_column(rows, 3, window, zero),
                    *(c1, c2),
                )
                count = select(is_counted, ONE, ZERO)
                row, column = thread // TILE + MARGIN, thread % TILE + MARGIN
                own[0] += abs(padded[0, row, column] - padded[1, row, column])  # equal where they do not count
                own[1] += count * value
                derivatives[0, y, x, channel] = count * by_i
                derivatives[1, y, x, channel] = count * by_ii
                derivatives[2, y, x, channel] = count * by_it
            cuda.syncthreads()
        reduce_warps(own, 2, 2, True, exchange, partial)
        cuda.syncthreads()
        if thread < 2:
            total = partial[0, thread]
            for warp in range(1, N_WARPS):
                total += partial[warp, thread]
            sums[cuda.blockIdx.x, thread] = total

    return similarity_tiles


@functools.cache
def gradient_kernel(dtype: np.dtype) -> GpuKernel:
    """Return the backward kernel for a dtype."""
    real = dtype.type

    @gpu_kernel
    def similarity_tiles_vjp(
        pair,  # Pair
        window,  # [11]
        derivatives,  # [3, H, W, 3]
        factors,  # dL/d|I - T| and dL/dSSIM of a number
        v_image,  # [H, W, 3]
    ):
        image, target, unit, mask = pair
        padded = cuda.shared.array((N_DERIVATIVES, SIDE, SIDE), dtype)
        rows = cuda.shared.array((N_DERIVATIVES, SIDE, TILE), dtype)
        thread, zero = cuda.threadIdx.x, real(0)
        height, width = image.shape[0], image.shape[1]
        x0, y0 = corner(width)
        x, y = x0 + thread % TILE, y0 + thread // TILE
        for channel in range(N_CHANNELS):
            for i in range(thread, SIDE * SIDE, BLOCK):
                row, column = i // SIDE, i % SIDE
                line, place = y0 + row - MARGIN, x0 + column - MARGIN
                is_inside = 0 <= line and line < height and 0 <= place and place < width
                for k in range(N_DERIVATIVES):
                    padded[k, row, column] = derivatives[k, line, place, channel] if is_inside else zero
            cuda.syncthreads()
            for k in range(N_DERIVATIVES):
                filter_rows(padded, k, window, zero, (height - y0 + 2 * MARGIN, width - x0), rows)
            cuda.syncthreads()
            if x < width and y < height:
                by_i = filter_column(rows, 0, window, zero)
                by_ii = filter_column(rows, 1, window, zero)
                by_it = filter_column(rows, 2, window, zero)
                i, t = image[y, x, channel] - HALF, unit * real(target[y, x, channel]) - HALF
                v = photometric_vjp(i, t, by_i, by_ii, by_it, factors[0], factors[1])
                v_image[y, x, channel] = select(counts(mask, y, x), v, zero)
            cuda.syncthreads()

    return similarity_tiles_vjp


class Photograph(NamedTuple):
    """A photograph on the device."""

    target: Floats | Ints
    """[H, W, 3]."""
    mask: Bools
    """[H, W] True where a pixel counts; [1, 1] True where all do."""
    n_values: int
    """Numbers that count."""


class Comparison(NamedTuple):
    """What comparing an image with a photograph gives, on the device."""

    sums: Floats
    """[n_tiles, 2] of |I - T| and of SSIM."""
    v_image: Floats
    """[H, W, 3] gradient of the loss."""


@functools.cache
def _everywhere() -> Any:
    return to_device(np.ones((1, 1), bool))


@functools.cache
def _window_on_device(dtype: np.dtype) -> Any:
    return to_device(window_weights(dtype))


def prepare_photograph(target: Floats | Ints, mask: Bools | None) -> Photograph:
    """Return a photograph, on the host or the device, with its mask on the device."""
    counted = target.size if mask is None else N_CHANNELS * int(np.count_nonzero(to_host(mask)))
    return Photograph(to_device(target), _everywhere() if mask is None else to_device(mask), counted)


def compare(workspace: Workspace, image: Floats, photograph: Photograph, dssim_weight: float) -> Comparison:
    """Compare an image on the device with a photograph; see :func:`photometric_loss`."""
    (height, width, _), dtype = image.shape, image.dtype
    target, mask, n_values = photograph
    unit = dtype.type(1 / 255 if target.dtype == np.uint8 else 1)
    pair, window, n_tiles = Pair(image, target, unit, mask), _window_on_device(dtype), n_image_tiles(width, height)
    derivatives = workspace.array("ssim_derivatives", (N_DERIVATIVES, *image.shape), dtype)
    found = Comparison(
        workspace.array("loss_sums", (n_tiles, 2), dtype), workspace.array("v_image", image.shape, dtype)
    )
    launch(similarity_kernel(dtype), n_tiles, BLOCK, pair, window, derivatives, found.sums)
    share = 1 / max(n_values, 1)  # where nothing counts the gradient is zero
    factors = dtype.type((1 - dssim_weight) * share), dtype.type(-dssim_weight * share)
    launch(gradient_kernel(dtype), n_tiles, BLOCK, pair, window, derivatives, factors, found.v_image)
    return found


def n_image_tiles(width: int, height: int) -> int:
    """Return the number of tiles of an image."""
    return -(-height // TILE) * -(-width // TILE)


def read_loss(comparison: Comparison, n_values: int, dssim_weight: float) -> float:
    """Return the loss, for which the host waits."""
    if n_values == 0:
        return 0.0
    l1, ssim = to_host(comparison.sums).sum(axis=0, dtype=np.float64) / n_values
    return float((1 - dssim_weight) * l1 + dssim_weight * (1 - ssim))


def photometric_loss(
    image: Floats, target: Floats | Ints, dssim_weight: float, mask: Bools | None = None
) -> tuple[float, LossTape]:
    """Return (1 - w) mean |I - T| + w (1 - mean SSIM); see ``reference.loss.photometric_loss``."""
    photograph = prepare_photograph(target, mask)
    if photograph.n_values == 0:
        return 0.0, LossTape(beside(image, to_device(np.zeros(image.shape, image.dtype))))
    found = compare(Workspace(), to_device(image), photograph, dssim_weight)
    return read_loss(found, photograph.n_values, dssim_weight), LossTape(beside(image, found.v_image))


def photometric_loss_vjp(tape: LossTape, v_loss: float = 1.0) -> Floats:
    """Chain ``v_loss`` to the image; see ``reference.loss.photometric_loss_vjp``.

    Where ``v_loss`` is 1, as in training, the result is the tape's own array; otherwise it is scaled on the host.
    """
    if v_loss == 1:
        return tape.v_image
    scaled = to_host(tape.v_image) * tape.v_image.dtype.type(v_loss)
    return to_device(scaled) if is_on_device(tape.v_image) else scaled
