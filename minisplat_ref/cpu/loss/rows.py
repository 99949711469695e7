"""The kernel of L1 + D-SSIM, forward and backward: row by row of the image, eight numbers at a time.

The Gaussian window is separable, and the row of an interleaved RGB image is one flat array in which the horizontal
neighbours of a channel are three numbers apart. A row is filtered completely, vertically and then horizontally, while
it is in the cache. Numbers of a row that have the same weight are added first.

A window needs eleven rows of both images, and the gradient of a row needs the derivatives of SSIM in the eleven rows
around it. Both are kept in ring buffers of rows, which stay in the cache, instead of five more images in memory: so the
gradient, up to a factor, is computed together with the loss. Rows are filtered vertically two at a time, so that the
rows that two windows share are read once; a ring has twelve rows. Each thread works down a band of rows, and computes
the rows beyond its edges redundantly. The first of two rows is rounded differently from the second, because the
compiler contracts other products. So a band begins at an even row, and with it every pair for the gradient; pairs for
the similarity begin at odd rows.

Rows of the images get margins that represent black, wide enough for the window and for the last eight numbers of a row,
so that no number is a special case. One half is subtracted, and moments are those of I - 1/2 and T - 1/2: variances are
differences of moments, and these smaller ones cancel less.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import SSIM_C1, SSIM_C2, SSIM_SIGMA, SSIM_WINDOW
from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.jit.lanes import WIDTH, broadcast, load, reduce_sum, store
from minisplat_ref.jit.literals import HALF, ZERO
from minisplat_ref.scalar.loss import photometric_vjp, ssim_and_derivatives
from minisplat_ref.types import Floats, Ints

HALF_WINDOW = SSIM_WINDOW // 2
N_RING = SSIM_WINDOW + 1  # rows that two windows cover
PAD = 3 * HALF_WINDOW  # width of the margin before an interleaved row; the one behind it is at least as wide


class Images(NamedTuple):
    """An image and its target, row by row."""

    image: Floats
    """[H, 3 W] interleaved RGB."""
    target: Floats | Ints
    """[H, 3 W] likewise, or bytes."""
    unit: np.floating
    """Factor from the target's numbers to [0, 1], in the dtype of the image."""
    counts: Floats
    """[H, L] 1 where a number counts and 0 elsewhere; or one row [1, L] for all."""


def row_length(width: int) -> int:
    """Return the length of a row with margins, a multiple of eight."""
    n_blocks = -(-3 * width // WIDTH) - (-2 * PAD // WIDTH)
    return n_blocks * WIDTH


@scalar
def _pad_row(row, inputs, padded_image, padded_target):
    """Copy a row of both images, minus 1/2, between black margins; numbers that do not count are the target's."""
    image, target, unit, counts = inputs
    if row < 0 or row >= image.shape[0]:
        padded_image[:] = -HALF
        padded_target[:] = -HALF
        return
    counts_row = counts[row % counts.shape[0]]
    for i in range(image.shape[1]):
        found, wanted = image[row, i] - HALF, unit * padded_target.dtype.type(target[row, i]) - HALF
        padded_image[PAD + i] = found if counts_row[i] > ZERO else wanted
        padded_target[PAD + i] = wanted


@scalar
def _find_rows(first, length, places):
    """Find where the rows from ``first`` on, in the image's coordinates, are in a ring."""
    for k in range(N_RING):
        places[k] = (first + k) % N_RING * length


@functools.cache
def loss_kernel(dtype: np.dtype) -> Callable:
    """Compile the kernel for a dtype; its window and constants are compiled in."""
    offsets = np.arange(SSIM_WINDOW) - HALF_WINDOW
    weights = np.exp(-0.5 * (offsets / SSIM_SIGMA) ** 2)
    window = tuple(dtype.type(weight) for weight in weights / weights.sum())
    edge, c1, c2 = window[0], dtype.type(SSIM_C1), dtype.type(SSIM_C2)

    @scalar
    def moments_down(image, target, places, i):
        """Return windowed means down a column of I, T, I^2 + T^2 and I T: four for a row and four for the next."""
        a, b = load(image, places[0] + i), load(target, places[0] + i)
        i_0, t_0, squares_0, products_0 = edge * a, edge * b, edge * (a * a + b * b), edge * (a * b)
        a, b = load(image, places[SSIM_WINDOW] + i), load(target, places[SSIM_WINDOW] + i)
        i_1, t_1, squares_1, products_1 = edge * a, edge * b, edge * (a * a + b * b), edge * (a * b)
        for k in range(1, SSIM_WINDOW):
            a, b = load(image, places[k] + i), load(target, places[k] + i)
            squares, products = a * a + b * b, a * b
            i_0, t_0 = i_0 + window[k] * a, t_0 + window[k] * b
            squares_0, products_0 = squares_0 + window[k] * squares, products_0 + window[k] * products
            i_1, t_1 = i_1 + window[k - 1] * a, t_1 + window[k - 1] * b
            squares_1, products_1 = squares_1 + window[k - 1] * squares, products_1 + window[k - 1] * products
        return i_0, t_0, squares_0, products_0, i_1, t_1, squares_1, products_1

    @scalar
    def down(ring, places, i):
        """Return windowed means down a column, for a row and the next."""
        mean_0, mean_1 = edge * load(ring, places[0] + i), edge * load(ring, places[SSIM_WINDOW] + i)
        for k in range(1, SSIM_WINDOW):
            a = load(ring, places[k] + i)
            mean_0, mean_1 = mean_0 + window[k] * a, mean_1 + window[k - 1] * a
        return mean_0, mean_1

    @scalar
    def across(s, i):
        total = window[HALF_WINDOW] * load(s, i + 3 * HALF_WINDOW)
        for k in range(HALF_WINDOW):
            total = total + window[k] * (load(s, i + 3 * k) + load(s, i + 3 * (SSIM_WINDOW - 1 - k)))
        return total

    @scalar
    def filter_images(image, target, places, length, s):
        for i in range(0, length, WIDTH):
            means = moments_down(image, target, places, i)
            store(s, i, means[0])
            store(s, length + i, means[1])
            store(s, 2 * length + i, means[2])
            store(s, 3 * length + i, means[3])
            store(s, 4 * length + i, means[4])
            store(s, 5 * length + i, means[5])
            store(s, 6 * length + i, means[6])
            store(s, 7 * length + i, means[7])

    @scalar
    def similarity_row(image, target, first, counts, n_values, length, s, derivatives):
        """Sum over a row that starts at ``first``; write the derivatives of SSIM with respect to the image's means."""
        l1 = ssim = ZERO * broadcast(c1)
        for i in range(0, n_values, WIDTH):
            means = across(s, i), across(s, length + i), across(s, 2 * length + i), across(s, 3 * length + i)
            value, by_i, by_ii, by_it = ssim_and_derivatives(*means, c1, c2)
            count = load(counts, i)
            l1 = l1 + abs(load(image, first + i) - load(target, first + i))  # equal where they do not count
            ssim = ssim + count * value
            store(derivatives, PAD + i, count * by_i)
            store(derivatives, length + PAD + i, count * by_ii)
            store(derivatives, 2 * length + PAD + i, count * by_it)
        return reduce_sum(l1), reduce_sum(ssim)

    @scalar
    def filter_derivatives(ring, places, length, s):
        for k in range(3):
            for i in range(0, length, WIDTH):
                both = down(ring, places, k * length + i)
                store(s, k * length + i, both[0])
                store(s, (4 + k) * length + i, both[1])

    @scalar
    def vjp_row(image, target, first, v_l1, v_ssim, length, s, v_row):
        """Write the gradient with respect to a row that starts at ``first``."""
        n_values = v_row.size
        up = broadcast(v_l1)
        for i in range(0, n_values, WIDTH):
            a, b = load(image, first + i), load(target, first + i)
            by_i, by_ii, by_it = across(s, i), across(s, length + i), across(s, 2 * length + i)
            store(s, 3 * length + i, photometric_vjp(a, b, by_i, by_ii, by_it, up, v_ssim))
        for i in range(n_values):  # copying a slice would test each number
            v_row[i] = s[3 * length + i]

    @scalar
    def loss_band(start, end, inputs, v_l1, v_ssim, sums, v_image):
        n_rows, n_values = v_image.shape
        counts, length = inputs.counts, inputs.counts.shape[1]
        images, targets = np.empty(N_RING * length, v_image.dtype), np.empty(N_RING * length, v_image.dtype)
        images[:] = targets[:] = -HALF
        ring, s = np.zeros(N_RING * 3 * length, v_image.dtype), np.empty(8 * length, v_image.dtype)
        places = np.empty(N_RING, np.int64)
        # Each step pads two rows, computes the similarity of the two from y on and the gradient of the two from v_y on.
        for y in range(start - 3 * HALF_WINDOW, end + HALF_WINDOW, 2):
            for half in range(2):
                row = y + HALF_WINDOW + half
                place = row % N_RING * length
                own = slice(place, place + length)
                _pad_row(row, inputs, images[own], targets[own])
            if y < start - HALF_WINDOW:
                continue
            _find_rows(y - HALF_WINDOW, length, places)
            filter_images(images, targets, places, length, s)
            for half in range(2):
                row = y + half
                place = row % N_RING * 3 * length
                derivatives = ring[place : place + 3 * length]
                if 0 <= row < n_rows:
                    first, own_s = row % N_RING * length + PAD, s[4 * half * length :]
                    own_counts = counts[row % counts.shape[0]]
                    l1, ssim = similarity_row(images, targets, first, own_counts, n_values, length, own_s, derivatives)
                    if start <= row < end:
                        sums[row, 0], sums[row, 1] = l1, ssim
                else:
                    derivatives[:] = ZERO
            v_y = y - HALF_WINDOW
            if v_y < start:
                continue
            _find_rows(v_y - HALF_WINDOW, 3 * length, places)
            filter_derivatives(ring, places, length, s)
            for half in range(min(2, end - v_y)):
                row = v_y + half
                first, own_s = row % N_RING * length + PAD, s[4 * half * length :]
                vjp_row(images, targets, first, v_l1, v_ssim, length, own_s, v_image[row])

    @kernel()
    def loss_rows(
        inputs,  # Images
        v_l1,
        v_ssim,
        n_bands,
        sums,  # [H, 2] of |I - T| and of SSIM
        v_image,  # [H, 3 W]
    ):
        n_rows, n_row_pairs = len(sums), (len(sums) + 1) // 2
        for band in prange(n_bands):
            start, end = 2 * (n_row_pairs * band // n_bands), 2 * (n_row_pairs * (band + 1) // n_bands)
            loss_band(start, min(end, n_rows), inputs, v_l1, v_ssim, sums, v_image)

    return loss_rows
