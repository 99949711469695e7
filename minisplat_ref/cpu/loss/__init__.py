"""L1 + D-SSIM of an image, forward and backward (3DGS section 5.1): the functions around the kernel."""

from typing import NamedTuple

import numpy as np

from minisplat_ref.cpu.loss.rows import Images, loss_kernel, row_length
from minisplat_ref.jit.compile import n_threads
from minisplat_ref.types import Bools, Floats, Ints


class LossTape(NamedTuple):
    """The gradient of the photometric loss, which is computed together with the loss."""

    v_image: Floats
    """[H, W, 3] derivative of the loss with respect to the image."""


def _counts(mask: Bools | None, width: int, dtype: np.dtype) -> Floats:
    """Return 1 for numbers that count and 0 for others [H, L]; without a mask, one row for all."""
    counts = np.zeros((1 if mask is None else len(mask), row_length(width)), dtype)
    counts[:, : 3 * width] = 1 if mask is None else np.repeat(mask, 3, axis=1)
    return counts


def photometric_loss(
    image: Floats, target: Floats | Ints, dssim_weight: float, mask: Bools | None = None
) -> tuple[float, LossTape]:
    """Return (1 - w) mean |I - T| + w (1 - mean SSIM); see ``reference.loss.photometric_loss``."""
    (height, width, _), dtype = image.shape, image.dtype
    n_values = image.size if mask is None else 3 * int(np.count_nonzero(mask))
    if n_values == 0:
        return 0.0, LossTape(np.zeros_like(image))
    sums, v_image = np.empty((height, 2)), np.empty((height, 3 * width), dtype)
    images = Images(
        image.reshape(height, 3 * width),
        target.reshape(height, 3 * width),
        dtype.type(1 / 255 if target.dtype == np.uint8 else 1),
        _counts(mask, width, dtype),
    )
    v_l1, v_ssim = dtype.type((1 - dssim_weight) / n_values), dtype.type(-dssim_weight / n_values)
    loss_kernel(dtype)(images, v_l1, v_ssim, n_threads(), sums, v_image)
    v_image = v_image.reshape(image.shape)
    if mask is not None:
        v_image[~mask] = 0
    l1, ssim = sums.sum(axis=0) / n_values
    return float((1 - dssim_weight) * l1 + dssim_weight * (1 - ssim)), LossTape(v_image)


def photometric_loss_vjp(tape: LossTape, v_loss: float = 1.0) -> Floats:
    """Chain ``v_loss`` to the image; see ``reference.loss.photometric_loss_vjp``.

    Where ``v_loss`` is 1, the result is the tape's own array.
    """
    return tape.v_image if v_loss == 1 else tape.v_image * tape.v_image.dtype.type(v_loss)
