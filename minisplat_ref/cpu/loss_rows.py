"""The kernel of L1 + D-SSIM, forward and backward: row after row of the image, eight numbers at a time.

The Gaussian window is separable, and the row of an interleaved RGB image is one flat array in which the horizontal
neighbours of a channel lie three numbers apart. A row is filtered completely, vertically and then horizontally, while
it is in the cache. Rows, and numbers of a row, that have the same weight are added first.

A window needs eleven rows of both images, and the gradient of a row the derivatives of SSIM in the eleven rows around
it. Both are kept in rings of as many rows, which stay in the cache, instead of five more images in memory: so the
gradient, but for a factor, is made together with the loss. Each thread goes down a band of rows, and the rows beyond
its edges are computed once more.

Rows of the images get margins as black as zeros, wide enough for the window and for the last eight numbers of a row, so
that no number is a special case. They are kept less one half, and moments are those of I - 1/2 and T - 1/2: variances
are differences of moments, and of these smaller ones few digits cancel.
"""

import functools
from collections.abc import Callable

import numpy as np

from minisplat_ref.constants import SSIM_C1, SSIM_C2, SSIM_SIGMA, SSIM_WINDOW
from minisplat_ref.scalar._jit import kernel, prange, scalar
from minisplat_ref.scalar.lanes import WIDTH, filled, load, select, store, sum_of
from minisplat_ref.scalar.literals import HALF, TWO, ZERO
from minisplat_ref.scalar.loss import ssim_and_derivatives

HALF_WINDOW = SSIM_WINDOW // 2
PAD = 3 * HALF_WINDOW  # numbers of margin before an interleaved row, and at least as many behind it


def row_length(width: int) -> int:
    """Numbers in a row with margins, a multiple of eight."""
    n_blocks = -(-3 * width // WIDTH) - (-2 * PAD // WIDTH)
    return n_blocks * WIDTH


@scalar
def _pad_row(row, image, target, unit, counts, padded_image, padded_target):
    """Copy a row of both images, less 1/2, into rows with margins; they are equal where they do not count."""
    padded_image[:] = -HALF
    padded_target[:] = -HALF
    if 0 <= row < image.shape[0]:
        counts_row = counts[row % counts.shape[0]]
        for i in range(image.shape[1]):
            found, wanted = image[row, i] - HALF, unit * padded_target.dtype.type(target[row, i]) - HALF
            padded_image[PAD + i] = found if counts_row[i] > ZERO else wanted
            padded_target[PAD + i] = wanted


@scalar
def _find_rows(first, length, places):
    """Find where the eleven rows of an image from ``first`` on, in its coordinates, are in a ring of rows."""
    for k in range(SSIM_WINDOW):
        places[k] = (first + k) % SSIM_WINDOW * length


@functools.cache
def loss_kernel(dtype: np.dtype) -> Callable:
    """Compile the kernel for a dtype; its window and constants are compiled in."""
    offsets = np.arange(SSIM_WINDOW) - HALF_WINDOW
    weights = np.exp(-0.5 * (offsets / SSIM_SIGMA) ** 2)
    window = tuple(dtype.type(weight) for weight in weights / weights.sum())
    c1, c2 = dtype.type(SSIM_C1), dtype.type(SSIM_C2)

    @scalar
    def moments_down(image, target, places, i):
        """Windowed means down a column of I, T, I^2 + T^2 and I T; rows at the same distance have the same weight."""
        a, b = load(image, places[HALF_WINDOW] + i), load(target, places[HALF_WINDOW] + i)
        middle = filled(window[HALF_WINDOW])
        means = middle * a, middle * b, middle * (a * a + b * b), middle * (a * b)
        mean_i, mean_t, squares, products = means
        for k in range(HALF_WINDOW):
            a, b = load(image, places[k] + i), load(target, places[k] + i)
            c, d = load(image, places[SSIM_WINDOW - 1 - k] + i), load(target, places[SSIM_WINDOW - 1 - k] + i)
            mean_i = mean_i + window[k] * (a + c)
            mean_t = mean_t + window[k] * (b + d)
            squares = squares + window[k] * ((a * a + b * b) + (c * c + d * d))
            products = products + window[k] * (a * b + c * d)
        return mean_i, mean_t, squares, products

    @scalar
    def down(ring, places, i):
        total = window[HALF_WINDOW] * load(ring, places[HALF_WINDOW] + i)
        for k in range(HALF_WINDOW):
            total = total + window[k] * (load(ring, places[k] + i) + load(ring, places[SSIM_WINDOW - 1 - k] + i))
        return total

    @scalar
    def across(s, i):
        total = window[HALF_WINDOW] * load(s, i + 3 * HALF_WINDOW)
        for k in range(HALF_WINDOW):
            total = total + window[k] * (load(s, i + 3 * k) + load(s, i + 3 * (SSIM_WINDOW - 1 - k)))
        return total

    @scalar
    def similarity_row(image, target, places, counts, n_values, length, s, derivatives):
        """Sums of one row, and the derivatives of its SSIM by the three windowed means that hold the image."""
        for i in range(0, length, WIDTH):
            mean_i, mean_t, squares, products = moments_down(image, target, places, i)
            store(s, i, mean_i)
            store(s, length + i, mean_t)
            store(s, 2 * length + i, squares)
            store(s, 3 * length + i, products)
        first = places[HALF_WINDOW] + PAD
        l1 = ssim = ZERO * filled(c1)
        for i in range(0, n_values, WIDTH):
            means = across(s, i), across(s, length + i), across(s, 2 * length + i), across(s, 3 * length + i)
            value, by_i, by_ii, by_it = ssim_and_derivatives(*means, c1, c2)
            count = load(counts, i)
            l1 = l1 + abs(load(image, first + i) - load(target, first + i))  # equal where they do not count
            ssim = ssim + count * value
            store(derivatives, PAD + i, count * by_i)
            store(derivatives, length + PAD + i, count * by_ii)
            store(derivatives, 2 * length + PAD + i, count * by_it)
        return sum_of(l1), sum_of(ssim)

    @scalar
    def vjp_row(image, target, first, ring, places, v_l1, v_ssim, length, s, v_row):
        """Gradient by one row, which starts at ``first``."""
        for i in range(0, length, WIDTH):
            for k in range(3):
                store(s, k * length + i, down(ring, places, k * length + i))
        n_values = v_row.size
        up = filled(v_l1)
        for i in range(0, n_values, WIDTH):
            a, b = load(image, first + i), load(target, first + i)
            by_squares = TWO * a * across(s, length + i) + b * across(s, 2 * length + i)
            by_ssim = across(s, i) + by_squares
            by_l1 = select(a > b, up, select(a < b, -up, ZERO * up))
            store(s, 3 * length + i, by_l1 + v_ssim * by_ssim)
        v_row[:] = s[3 * length : 3 * length + n_values]

    @scalar
    def loss_band(start, end, image, target, unit, counts, v_l1, v_ssim, length, sums, v_image):
        n_rows, n_values = v_image.shape
        images, targets = np.empty(SSIM_WINDOW * length, v_image.dtype), np.empty(SSIM_WINDOW * length, v_image.dtype)
        ring, s = np.zeros(SSIM_WINDOW * 3 * length, v_image.dtype), np.empty(4 * length, v_image.dtype)
        places = np.empty(SSIM_WINDOW, np.int64)
        for row in range(start - 2 * HALF_WINDOW, end + 2 * HALF_WINDOW):
            place = row % SSIM_WINDOW * length
            own = slice(place, place + length)
            _pad_row(row, image, target, unit, counts, images[own], targets[own])
            y = row - HALF_WINDOW
            place = y % SSIM_WINDOW * 3 * length
            derivatives = ring[place : place + 3 * length]
            if y < start - HALF_WINDOW or y < 0 or y >= n_rows:
                derivatives[:] = ZERO
            else:
                _find_rows(y - HALF_WINDOW, length, places)
                l1, ssim = similarity_row(
                    images, targets, places, counts[y % counts.shape[0]], n_values, length, s, derivatives
                )
                if start <= y < end:
                    sums[y, 0], sums[y, 1] = l1, ssim
            y -= HALF_WINDOW
            if y >= start:
                first = y % SSIM_WINDOW * length + PAD
                _find_rows(y - HALF_WINDOW, 3 * length, places)
                vjp_row(images, targets, first, ring, places, v_l1, v_ssim, length, s, v_image[y])

    @kernel()
    def loss_rows(image, target, unit, counts, v_l1, v_ssim, n_bands, sums, v_image):
        n_rows, length = len(sums), counts.shape[1]
        for band in prange(n_bands):
            start, end = n_rows * band // n_bands, n_rows * (band + 1) // n_bands
            loss_band(start, end, image, target, unit, counts, v_l1, v_ssim, length, sums, v_image)

    return loss_rows
