"""The kernels of L1 + D-SSIM: every row of the image by itself, eight numbers at a time.

The Gaussian window is separable, and the row of an interleaved RGB image is one flat array in which the horizontal
neighbours of a channel lie three numbers apart. A row is filtered completely, vertically and then horizontally, while
it is in the cache. The images have margins of zeros, wide enough for the window and for the last eight numbers of a
row, so that no number is a special case.

Moments are those of I - 1/2 and T - 1/2: variances are differences of moments, and of these smaller ones few digits
cancel.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import SSIM_C1, SSIM_C2, SSIM_SIGMA, SSIM_WINDOW
from minisplat_ref.scalar._jit import kernel, prange, scalar
from minisplat_ref.scalar.lanes import WIDTH, filled, load, select, store, sum_of
from minisplat_ref.scalar.literals import HALF, TWO, ZERO
from minisplat_ref.scalar.loss import ssim_and_derivatives

HALF_WINDOW = SSIM_WINDOW // 2
PAD = 3 * HALF_WINDOW  # numbers of margin before an interleaved row, and at least as many behind it


class LossKernels(NamedTuple):
    """Images and derivatives are flat in both; see :class:`minisplat_ref.cpu.loss.LossTape`."""

    loss_rows: Callable
    loss_vjp_rows: Callable


@scalar
def _pad_row(image, unit, row, padded):
    padded[:] = ZERO
    if 0 <= row < image.shape[0]:
        for i in range(image.shape[1]):
            padded[PAD + i] = unit * padded.dtype.type(image[row, i])


@kernel()
def pad_rows(image, target, unit, padded_image, padded_target):
    """Copy two images [H, 3 W] into the middle of [H + 10, L], the target times its unit, with zeros around them."""
    for y in prange(padded_image.shape[0]):
        _pad_row(image, padded_image.dtype.type(1), y - HALF_WINDOW, padded_image[y])
        _pad_row(target, unit, y - HALF_WINDOW, padded_target[y])


@functools.cache
def loss_kernels(dtype: np.dtype) -> LossKernels:
    """Compile the kernels for a dtype; its window and constants are compiled in."""
    offsets = np.arange(SSIM_WINDOW) - HALF_WINDOW
    weights = np.exp(-0.5 * (offsets / SSIM_SIGMA) ** 2)
    window = tuple(dtype.type(weight) for weight in weights / weights.sum())
    c1, c2 = dtype.type(SSIM_C1), dtype.type(SSIM_C2)

    @scalar
    def down(a, i, length):
        total = window[0] * load(a, i)
        for k in range(1, SSIM_WINDOW):
            total = total + window[k] * load(a, i + k * length)
        return total

    @scalar
    def moments_down(image, target, i, length):
        mean_i = mean_t = squares = products = ZERO * filled(c1)
        for k in range(SSIM_WINDOW):
            a, b = load(image, i + k * length) - HALF, load(target, i + k * length) - HALF
            weighted_a, weighted_b = window[k] * a, window[k] * b
            mean_i = mean_i + weighted_a
            mean_t = mean_t + weighted_b
            squares = squares + weighted_a * a + weighted_b * b
            products = products + weighted_a * b
        return mean_i, mean_t, squares, products

    @scalar
    def across(s, i):
        total = window[0] * load(s, i)
        for k in range(1, SSIM_WINDOW):
            total = total + window[k] * load(s, i + 3 * k)
        return total

    @scalar
    def loss_row(y, image, target, counts, derivatives, n_values, length, s, sums):
        for i in range(0, length, WIDTH):
            mean_i, mean_t, squares, products = moments_down(image, target, y * length + i, length)
            store(s, i, mean_i)
            store(s, length + i, mean_t)
            store(s, 2 * length + i, squares)
            store(s, 3 * length + i, products)
        first, counts_row = (y + HALF_WINDOW) * length + PAD, y * length % counts.size
        field = derivatives.size // 3
        l1 = ssim = ZERO * filled(c1)
        for i in range(0, n_values, WIDTH):
            means = across(s, i), across(s, length + i), across(s, 2 * length + i), across(s, 3 * length + i)
            value, by_i, by_ii, by_it = ssim_and_derivatives(*means, c1, c2)
            count = load(counts, counts_row + i)
            l1 = l1 + abs(load(image, first + i) - load(target, first + i))  # equal where they do not count
            ssim = ssim + count * value
            store(derivatives, first + i, count * by_i)
            store(derivatives, field + first + i, count * by_ii)
            store(derivatives, 2 * field + first + i, count * by_it)
        sums[y, 0], sums[y, 1] = sum_of(l1), sum_of(ssim)
        for k in range(3):
            start = k * field + first
            derivatives[start - PAD : start] = ZERO
            derivatives[start + n_values : start - PAD + length] = ZERO

    @scalar
    def vjp_row(y, image, target, derivatives, v_l1, v_ssim, out, s):
        n_values, length = out.shape[1], s.size // 4
        field = derivatives.size // 3
        for i in range(0, length, WIDTH):
            for k in range(3):
                store(s, k * length + i, down(derivatives, k * field + y * length + i, length))
        first = (y + HALF_WINDOW) * length + PAD
        up = filled(v_l1)
        for i in range(0, n_values, WIDTH):
            a, b = load(image, first + i), load(target, first + i)
            by_squares = TWO * (a - HALF) * across(s, length + i) + (b - HALF) * across(s, 2 * length + i)
            by_ssim = across(s, i) + by_squares
            by_l1 = select(a > b, up, select(a < b, -up, ZERO * up))
            store(s, 3 * length + i, by_l1 + v_ssim * by_ssim)
        out[y] = s[3 * length : 3 * length + n_values]

    @kernel()
    def loss_rows(image, target, counts, derivatives, n_values, length, sums):
        for y in prange(len(sums)):
            s = np.empty(4 * length, image.dtype)
            loss_row(y, image, target, counts, derivatives, n_values, length, s, sums)

    @kernel()
    def loss_vjp_rows(image, target, derivatives, v_l1, v_ssim, out, length):
        for y in prange(out.shape[0]):
            vjp_row(y, image, target, derivatives, v_l1, v_ssim, out, np.empty(4 * length, image.dtype))

    return LossKernels(loss_rows, loss_vjp_rows)
