"""The stage ``photo_loss``, the comparison of an image with its photograph, and the loss on the sky."""

from collections.abc import Callable

import numpy as np

from minisplat_ref.extensions.gaustudio.reference import opacity_in
from minisplat_ref.training.losses import Cotangents, Rendered, photometric
from minisplat_ref.types import Bools, View

DSSIM_WEIGHT = 0.2  # of 3DGS


def l1_and_dssim(rendered: Rendered) -> tuple[float, Cotangents]:
    """0.8 L1 + 0.2 (1 - SSIM), that of 3DGS."""
    return photometric(rendered, dssim_weight=DSSIM_WEIGHT)


def l1(rendered: Rendered) -> tuple[float, Cotangents]:
    """The mean absolute difference alone."""
    return photometric(rendered, dssim_weight=0.0)


def squared(rendered: Rendered) -> tuple[float, Cotangents]:
    """The mean squared difference, of which PSNR is the logarithm.

    ::

        L = mean (c - p)^2,   v_c = 2 (c - p) / n        n numbers that the mask leaves
    """
    colors, view = rendered.channel("rgb"), rendered.view
    weights = np.ones(colors.shape[:2], colors.dtype) if view.mask is None else view.mask.astype(colors.dtype)
    n = max(3 * float(weights.sum()), 1.0)
    apart = weights[..., None] * (colors - view.image.astype(colors.dtype) / 255)
    return float(np.sum(apart.astype(np.float64) ** 2)) / n, Cotangents({"rgb": (2 / n * apart).astype(colors.dtype)})


def compare(
    rendered: Rendered, *, photo_loss: Callable[[Rendered], tuple[float, Cotangents]]
) -> tuple[float, Cotangents]:
    """Compare the image with the photograph."""
    return photo_loss(rendered)


def sky_opacity(
    rendered: Rendered, *, sky_mask: Callable[[View, str], Bools | None], mask_folder: str
) -> tuple[float, Cotangents]:
    """Return the mean opacity of the scene, without its background, in the sky of the photograph."""
    is_sky = sky_mask(rendered.view, mask_folder)
    if is_sky is None or not is_sky.any():
        return 0.0, Cotangents()
    value, v_alpha = opacity_in(rendered.output.alpha, is_sky)
    return value, Cotangents(alpha=v_alpha)
