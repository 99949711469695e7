"""PSNR, SSIM and LPIPS of renderings against photographs, and the evaluation of a set of views.

Renderings are clipped to [0, 1] but not rounded to 8 bits, which would add 1.3e-6 to the mean squared error: 0.006 dB
at 30 dB. PSNR is computed from the mean squared error over all pixels and channels of an image; the released 3DGS
script averages the PSNR of the channels instead, which is never lower. Means over views are means of the views' values.

A held-out photograph has an exposure of its own, which no training has seen. So its PSNR is given three times: as
rendered; with the exposure that the photograph's own tracks of sparse points show (:attr:`View.log_gain`), for which
nothing is fitted to its pixels beside the rendering's; and after the affine map of the colours that brings the
rendering closest to the photograph (:func:`correct_colors`), which flatters.

LPIPS needs the weights of a network, which are not ours to ship; an :class:`Evaluation` without them has a note of it.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.metrics.lpips import HOW_TO_MAKE, Network, check_views, lpips
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.rendering.backends import CPU, Backend
from minisplat_ref.types import Bools, Floats, Ints, View

NO_WEIGHTS = (
    "it needs the weights of a trained network, which are not part of minisplat_ref: give --lpips-weights vgg.npz, a"
    f" file that this makes: {HOW_TO_MAKE}"
)
NO_VIEWS = "there are no views to evaluate"


class ViewMetrics(NamedTuple):
    """The metrics of one view."""

    name: str
    psnr: float
    """dB."""
    ssim: float
    lpips: float | None = None
    """None when it was not measured."""
    psnr_corrected: float | None = None
    """dB, after :func:`correct_colors`."""
    psnr_exposed: float | None = None
    """dB, with the gain that the view's own tracks show; where that is not known, as rendered."""


class Evaluation(NamedTuple):
    """The metrics of several views."""

    psnr: float | None
    """dB, mean of the views; None without views."""
    ssim: float | None
    """Mean of the views; None without views."""
    lpips: float | None
    """Mean of the views; None when it was not measured."""
    lpips_reason: str | None
    """The reason why it was not measured."""
    per_view: list[ViewMetrics]
    lpips_network: str | None = None
    """VGG16 or AlexNet, with distances that cannot be compared with each other; None when LPIPS was not measured."""
    psnr_corrected: float | None = None
    """dB after :func:`correct_colors`, mean of the views; None without views."""
    psnr_exposed: float | None = None
    """dB with the gains that the views' own tracks show, mean of the views; None without views."""


def psnr(image: Floats, target: Floats | Ints, mask: Bools | None = None) -> float:
    """Return the peak signal-to-noise ratio, 10 log10(1 / MSE).

    Parameters
    ----------
    image, target : ndarray of shape (H, W, D)
        In [0, 1]; the target may also be bytes, of which 255 is 1.
    mask : ndarray of shape (H, W) of booleans, optional
        Pixels that count; default all.

    Returns
    -------
    psnr : float
        dB; infinite for equal images.

    Raises
    ------
    InputError
        The mask is False everywhere.
    """
    if mask is not None and not mask.any():
        raise InputError("mask leaves no pixel to compare: leave the view out")
    squared = image.astype(np.float64)  # 288 MB for 12 megapixels: the only array of this size
    for row, numbers in zip(squared, target, strict=True):
        row -= numbers.astype(image.dtype) / 255 if target.dtype == np.uint8 else numbers
        np.square(row, out=row)
    mse = float(np.mean(squared if mask is None else squared[mask]))
    return math.inf if mse == 0.0 else -10.0 * math.log10(mse)


def ssim(image: Floats, target: Floats | Ints, mask: Bools | None = None, *, backend: Backend = CPU) -> float:
    """Return the mean structural similarity, with the window and zero padding of the training loss.

    Parameters
    ----------
    image, target : ndarray of shape (H, W, 3)
        In [0, 1]; the target may also be bytes, of which 255 is 1.
    mask : ndarray of shape (H, W) of booleans, optional
        Pixels that count; default all.
    backend : Backend
    """
    loss, _ = backend.photometric_loss(image, target, 1.0, mask)  # 1 - mean SSIM
    return 1.0 - float(loss)


def correct_colors(image: Floats, target: Floats | Ints, mask: Bools | None = None) -> Floats:
    """Return the image after the affine map of its colours that minimises the squared error.

    ::

        c' = A c + b   with A [3, 3] and b [3] minimising sum |A c + b - target|^2, then clipped to [0, 1]

    Where a colour does not vary, or varies with another, of the best maps that of least norm is taken.

    Parameters
    ----------
    image, target : ndarray of shape (H, W, 3)
        In [0, 1]; the target may also be bytes, of which 255 is 1.
    mask : ndarray of shape (H, W) of booleans, optional
        Pixels that count; default all. The map is applied to all pixels.

    Returns
    -------
    ndarray of shape (H, W, 3), float32
    """
    counted: Any = slice(None) if mask is None else mask.ravel()
    ones = np.ones((image.shape[0] * image.shape[1], 1))
    colors = np.hstack([image.reshape(-1, 3).astype(np.float64), ones])  # [H * W, 4]
    wanted = target.reshape(-1, 3)[counted].astype(np.float64) / (255.0 if target.dtype == np.uint8 else 1.0)
    E = np.linalg.lstsq(colors[counted], wanted, rcond=None)[0]  # [4, 3], [A | b] transposed
    return np.clip(colors @ E, 0.0, 1.0).astype(np.float32).reshape(image.shape)


def evaluate(
    model: Any,
    views: Sequence[View],
    settings: RenderSettings,
    *,
    on_view: Callable[[View, Floats, ViewMetrics], None] | None = None,
    network: Network | None = None,
) -> Evaluation:
    """Render views with all stored spherical-harmonic degrees and compare them with their photographs.

    Parameters
    ----------
    model : Model or Gaussians
    views : sequence of View
        Usually ``scene.test_views``; pixels outside a view's mask do not count.
    settings : RenderSettings
        With ``scene.background``.
    on_view : callable, optional
        Called after each view with the view, its rendering [H, W, 3] clipped to [0, 1], and its metrics.
    network : Network, optional
        Of :func:`minisplat_ref.metrics.lpips.load_network`; without it LPIPS is not measured.

    Raises
    ------
    InputError
        A view is too small for the network; raised before anything is rendered.
    """
    if network is not None:
        check_views(network, views)
    per_view = []
    for view in (view.load() for view in views):
        rendered = settings.render_view(model, view)[0].image  # [H, W, 3]
        image = np.clip(rendered, 0.0, 1.0)
        metrics = ViewMetrics(
            view.name,
            psnr(image, view.image, view.mask),
            ssim(image, view.image, view.mask, backend=settings.backend),
            None if network is None else lpips(image, view.image, network, view.mask),
            psnr(correct_colors(image, view.image, view.mask), view.image, view.mask),
            psnr(_expose(rendered, view.log_gain), view.image, view.mask),
        )
        per_view.append(metrics)
        if on_view is not None:
            on_view(view, image, metrics)
    if not per_view:
        return Evaluation(None, None, None, NO_VIEWS, per_view)
    corrected = [view.psnr_corrected for view in per_view if view.psnr_corrected is not None]
    exposed = [view.psnr_exposed for view in per_view if view.psnr_exposed is not None]
    distances = [view.lpips for view in per_view if view.lpips is not None]
    return Evaluation(
        float(np.mean([view.psnr for view in per_view])),
        float(np.mean([view.ssim for view in per_view])),
        float(np.mean(distances)) if distances else None,
        None if distances else NO_WEIGHTS,
        per_view,
        None if network is None else network.backbone.name,
        float(np.mean(corrected)),
        float(np.mean(exposed)),
    )


def _expose(rendered: Floats, log_gain: Floats | None) -> Floats:
    """Return a rendering [H, W, 3] with the exposure of a photograph, if that is known, clipped to [0, 1]."""
    gain = 1.0 if log_gain is None else np.exp(log_gain).astype(rendered.dtype)
    return np.clip(rendered * gain, 0.0, 1.0)
