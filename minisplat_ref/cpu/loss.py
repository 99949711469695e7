"""L1 + D-SSIM of an image, forward and backward (3DGS section 5.1): the functions around the kernels."""

from typing import NamedTuple

import numpy as np

from minisplat_ref.cpu.loss_rows import HALF_WINDOW, PAD, loss_kernels, pad_rows
from minisplat_ref.scalar.lanes import WIDTH
from minisplat_ref.types import Bools, Floats, Ints


class LossTape(NamedTuple):
    """What the gradient of the photometric loss needs again."""

    image: Floats
    """[H + 10, L] with margins, equal to the target where masked out; L is :func:`_row_length`."""
    target: Floats
    """[H + 10, L] with margins."""
    derivatives: Floats
    """[3, H + 10, L] of SSIM by the windowed means of I, I^2 and I T, with margins."""
    shape: tuple[int, ...]
    """(H, W, 3)."""
    dssim_weight: float
    mask: Bools | None
    n_values: int
    """Number of values that the means run over."""


def _row_length(width: int) -> int:
    """Numbers in an interleaved row with margins, a multiple of eight."""
    n_blocks = -(-3 * width // WIDTH) - (-2 * PAD // WIDTH)
    return n_blocks * WIDTH


def _padded(image: Floats, target: Floats | Ints) -> tuple[Floats, Floats]:
    height, width, _ = image.shape
    shape = (height + 2 * HALF_WINDOW, _row_length(width))
    padded = np.empty(shape, image.dtype), np.empty(shape, image.dtype)
    rows = (array.reshape(height, 3 * width) for array in (image, target))
    pad_rows(*rows, image.dtype.type(1 / 255 if target.dtype == np.uint8 else 1), *padded)
    return padded


def _counts(mask: Bools | None, width: int, dtype: np.dtype) -> Floats:
    """1 for each number that counts and 0 for the others [H, L]; one row stands for all where there is no mask."""
    counts = np.zeros((1 if mask is None else len(mask), _row_length(width)), dtype)
    counts[:, : 3 * width] = 1 if mask is None else np.repeat(mask, 3, axis=1)
    return counts


def photometric_loss(
    image: Floats, target: Floats | Ints, dssim_weight: float, mask: Bools | None = None
) -> tuple[float, LossTape]:
    """(1 - w) mean |I - T| + w (1 - mean SSIM); see ``reference.loss.photometric_loss``."""
    (height, width, _), dtype = image.shape, image.dtype
    n_values = image.size if mask is None else 3 * int(np.count_nonzero(mask))
    padded_image, padded_target = _padded(image, target)
    if mask is not None:
        middle = (slice(HALF_WINDOW, -HALF_WINDOW), slice(PAD, PAD + 3 * width))
        np.copyto(padded_image[middle], padded_target[middle], where=~np.repeat(mask, 3, axis=1))
    derivatives = np.empty((3, *padded_image.shape), dtype)
    derivatives[:, :HALF_WINDOW] = derivatives[:, -HALF_WINDOW:] = 0
    sums = np.empty((height, 2))
    loss_kernels(dtype).loss_rows(
        padded_image.reshape(-1),
        padded_target.reshape(-1),
        _counts(mask, width, dtype).reshape(-1),
        derivatives.reshape(-1),
        3 * width,
        padded_image.shape[1],
        sums,
    )
    tape = LossTape(padded_image, padded_target, derivatives, image.shape, dssim_weight, mask, n_values)
    if n_values == 0:
        return 0.0, tape
    l1, ssim = sums.sum(axis=0) / n_values
    return float((1 - dssim_weight) * l1 + dssim_weight * (1 - ssim)), tape


def photometric_loss_vjp(tape: LossTape, v_loss: float = 1.0) -> Floats:
    """Chain the derivative by the loss to the image; see ``reference.loss.photometric_loss_vjp``."""
    dtype, (height, width, _) = tape.image.dtype, tape.shape
    if tape.n_values == 0:
        return np.zeros(tape.shape, dtype)
    v_l1 = dtype.type(v_loss * (1 - tape.dssim_weight) / tape.n_values)
    v_ssim = dtype.type(-v_loss * tape.dssim_weight / tape.n_values)
    v_image = np.empty((height, 3 * width), dtype)
    images = (array.reshape(-1) for array in (tape.image, tape.target, tape.derivatives))
    loss_kernels(dtype).loss_vjp_rows(*images, v_l1, v_ssim, v_image, tape.image.shape[1])
    v_image = v_image.reshape(tape.shape)
    if tape.mask is not None:
        v_image[~tape.mask] = 0
    return v_image
