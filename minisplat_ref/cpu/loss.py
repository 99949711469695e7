"""L1 + D-SSIM of an image, forward and backward (3DGS section 5.1).

The Gaussian window is separable, and the row of an interleaved RGB image is one flat array in which the horizontal
neighbours of a channel lie three numbers apart, so that both passes are plain vector loops. A block of a row is
filtered completely, vertically and then horizontally, inside one small array with compile-time distances between its
fields.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import SSIM_C1, SSIM_C2, SSIM_SIGMA, SSIM_WINDOW
from minisplat_ref.scalar._jit import kernel, prange, scalar
from minisplat_ref.scalar.literals import ONE, TWO, ZERO
from minisplat_ref.scalar.loss import ssim, ssim_vjp
from minisplat_ref.types import Bools, Floats

HALF_WINDOW = SSIM_WINDOW // 2
PAD = 3 * HALF_WINDOW  # numbers of zero padding at the ends of an interleaved row
BLOCK = 256  # numbers of a row filtered at once; the scratch below stays in the first-level cache
FIELD = BLOCK + 2 * PAD


class LossTape(NamedTuple):
    """What the gradient of the photometric loss needs again."""

    image: Floats
    """[H + 10, 3 W + 30] zero-padded, equal to the target where masked out."""
    target: Floats
    """[H + 10, 3 W + 30] zero-padded."""
    derivatives: Floats
    """[3, H + 10, 3 W + 30] of SSIM by the windowed means of I, I^2 and I T."""
    dssim_weight: float
    mask: Bools | None
    n_values: int
    """Number of values that the means run over."""


@functools.cache
def _kernels(dtype: np.dtype) -> tuple[Callable, Callable]:
    offsets = np.arange(SSIM_WINDOW) - HALF_WINDOW
    weights = np.exp(-0.5 * (offsets / SSIM_SIGMA) ** 2)
    window = tuple(dtype.type(weight) for weight in weights / weights.sum())
    c1, c2 = dtype.type(SSIM_C1), dtype.type(SSIM_C2)

    @scalar
    def across(s, start):
        total = window[0] * s[start]
        for k in range(1, SSIM_WINDOW):
            total += window[k] * s[start + 3 * k]
        return total

    @scalar
    def add_row_products(a, b, n, weight, s):
        for i in range(n):
            s[i] += weight * a[i]
            s[FIELD + i] += weight * b[i]
            s[2 * FIELD + i] += weight * a[i] * a[i]
            s[3 * FIELD + i] += weight * b[i] * b[i]
            s[4 * FIELD + i] += weight * a[i] * b[i]

    @scalar
    def add_row(a, n, weight, s):
        for i in range(n):
            s[i] += weight * a[i]

    @scalar
    def evaluate(s, n):
        for i in range(n):
            mean_i, mean_t = across(s, i), across(s, FIELD + i)
            mean_ii, mean_tt, mean_it = across(s, 2 * FIELD + i), across(s, 3 * FIELD + i), across(s, 4 * FIELD + i)
            by_i, by_ii, by_it = ssim_vjp(mean_i, mean_t, mean_ii, mean_tt, mean_it, c1, c2)
            s[5 * FIELD + i] = ssim(mean_i, mean_t, mean_ii, mean_tt, mean_it, c1, c2)
            s[6 * FIELD + i] = by_i
            s[7 * FIELD + i] = by_ii
            s[8 * FIELD + i] = by_it

    @scalar
    def combine(s, image, target, n, v_l1, v_ssim, out):
        for i in range(n):
            s[3 * FIELD + i] = across(s, i)
            s[4 * FIELD + i] = across(s, FIELD + i)
            s[5 * FIELD + i] = across(s, 2 * FIELD + i)
        for i in range(n):
            a, b = image[i], target[i]
            by_ssim = s[3 * FIELD + i] + TWO * a * s[4 * FIELD + i] + b * s[5 * FIELD + i]
            sign = ZERO if a == b else (ONE if a > b else -ONE)
            out[i] = v_l1 * sign + v_ssim * by_ssim

    @kernel()
    def ssim_rows(image, target, values, derivatives):
        height, length = values.shape
        for y in prange(height):
            s = np.empty(9 * FIELD, image.dtype)
            for x in range(0, length, BLOCK):
                n = min(BLOCK, length - x)
                s[: 5 * FIELD] = ZERO
                for k in range(SSIM_WINDOW):
                    add_row_products(image[y + k, x:], target[y + k, x:], n + 2 * PAD, window[k], s)
                evaluate(s, n)
                values[y, x : x + n] = s[5 * FIELD : 5 * FIELD + n]
                for field in range(3):
                    start = (6 + field) * FIELD
                    derivatives[field, y + HALF_WINDOW, PAD + x : PAD + x + n] = s[start : start + n]

    @kernel()
    def loss_vjp_rows(image, target, derivatives, v_l1, v_ssim, out):
        height, length = out.shape
        for y in prange(height):
            s = np.empty(6 * FIELD, image.dtype)
            for x in range(0, length, BLOCK):
                n = min(BLOCK, length - x)
                s[: 3 * FIELD] = ZERO
                for field in range(3):
                    for k in range(SSIM_WINDOW):
                        add_row(derivatives[field, y + k, x:], n + 2 * PAD, window[k], s[field * FIELD :])
                row, first = y + HALF_WINDOW, PAD + x
                combine(s, image[row, first:], target[row, first:], n, v_l1, v_ssim, out[y, x:])

    return ssim_rows, loss_vjp_rows


def _padded(image: Floats) -> Floats:
    height, width, _ = image.shape
    rows = np.zeros((height + 2 * HALF_WINDOW, 3 * width + 2 * PAD), image.dtype)
    rows[HALF_WINDOW : HALF_WINDOW + height, PAD : PAD + 3 * width] = image.reshape(height, 3 * width)
    return rows


def _ssim(image: Floats, target: Floats, shape: tuple[int, ...]) -> tuple[Floats, Floats]:
    """SSIM [H, W, 3] of two padded images and its derivatives by the windowed means."""
    values = np.empty((shape[0], 3 * shape[1]), image.dtype)
    derivatives = np.zeros((3, *image.shape), image.dtype)
    _kernels(image.dtype)[0](image, target, values, derivatives)
    return values.reshape(shape), derivatives


def ssim_map(image: Floats, target: Floats) -> Floats:
    """Structural similarity of every value; see ``reference.loss.ssim_map``."""
    return _ssim(_padded(image), _padded(target.astype(image.dtype, copy=False)), image.shape)[0]


def photometric_loss(
    image: Floats, target: Floats, dssim_weight: float, mask: Bools | None = None
) -> tuple[float, LossTape]:
    """(1 - w) mean |I - T| + w (1 - mean SSIM); see ``reference.loss.photometric_loss``."""
    target = target.astype(image.dtype, copy=False)
    n_values = image.size if mask is None else 3 * int(np.count_nonzero(mask))
    if mask is not None:
        image = np.where(mask[..., None], image, target)
    difference = image - target
    l1 = np.abs(difference, out=difference).sum(dtype=np.float64)
    del difference  # before the larger arrays come
    padded_image, padded_target = _padded(image), _padded(target)
    values, derivatives = _ssim(padded_image, padded_target, image.shape)
    tape = LossTape(padded_image, padded_target, derivatives, dssim_weight, mask, n_values)
    if n_values == 0:
        return 0.0, tape
    if mask is not None:
        values = values[mask]
        derivatives[:, HALF_WINDOW:-HALF_WINDOW, PAD:-PAD] *= np.repeat(mask, 3, axis=1)
    dssim = 1 - values.sum(dtype=np.float64) / n_values
    return float((1 - dssim_weight) * (l1 / n_values) + dssim_weight * dssim), tape


def photometric_loss_vjp(tape: LossTape, v_loss: float = 1.0) -> Floats:
    """Chain the derivative by the loss to the image; see ``reference.loss.photometric_loss_vjp``."""
    dtype = tape.image.dtype
    height, length = tape.image.shape[0] - 2 * HALF_WINDOW, tape.image.shape[1] - 2 * PAD
    v_image = np.zeros((height, length), dtype)
    if tape.n_values > 0:
        v_l1 = dtype.type(v_loss * (1 - tape.dssim_weight) / tape.n_values)
        v_ssim = dtype.type(-v_loss * tape.dssim_weight / tape.n_values)
        _kernels(dtype)[1](tape.image, tape.target, tape.derivatives, v_l1, v_ssim, v_image)
    v_image = v_image.reshape(height, length // 3, 3)
    if tape.mask is not None:
        v_image[~tape.mask] = 0
    return v_image
