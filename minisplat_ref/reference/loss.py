"""Stage 7: the difference between a rendered image and a photograph.

This is 3DGS equation (7), ``(1 - w) L1 + w (1 - SSIM)``, with the structural similarity of Wang et al. (2004): a
Gaussian window of 11 pixels, here with zeros beyond the border as in the 3DGS code. Left out: the halving of D-SSIM in
some texts; the code that produced the published numbers does not halve.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import SSIM_C1, SSIM_C2, SSIM_SIGMA, SSIM_WINDOW
from minisplat_ref.types import Bools, Floats, Ints


class LossTape(NamedTuple):
    """Record of :func:`photometric_loss`, for its gradient."""

    image: Floats
    """[H, W, 3] rendered image, the target's values where the mask is False."""
    target: Floats
    """[H, W, 3] photograph."""
    dssim_weight: float
    """Weight w of ``1 - SSIM``."""
    mask: Bools
    """[H, W] pixels that count."""


def photometric_loss(
    image: Floats, target: Floats | Ints, dssim_weight: float, mask: Bools | None = None
) -> tuple[float, LossTape]:
    """Return the loss of an image, ``(1 - w) mean |I - T| + w (1 - mean SSIM)``.

    Parameters
    ----------
    image, target : ndarray of shape (H, W, 3)
        Rendered image and photograph, in [0, 1]; a photograph may also be bytes, of which 255 is 1.
    dssim_weight : float
        w; 0.2 in 3DGS.
    mask : ndarray of bool of shape (H, W), optional
        Both means run over these pixels. Outside, the target replaces the image before the windows are applied, so that
        masked pixels neither count nor leak in. An empty mask gives 0.

    Returns
    -------
    loss : float
        The loss.
    tape : LossTape
        For the gradient.
    """
    target = target / image.dtype.type(255 if target.dtype == np.uint8 else 1)
    mask = np.ones(image.shape[:2], dtype=bool) if mask is None else mask
    image = np.where(mask[:, :, None], image, target)
    tape = LossTape(image, target, dssim_weight, mask)
    if not mask.any():
        return 0.0, tape
    l1 = np.mean(np.abs(image - target)[mask], dtype=np.float64)
    ssim = np.mean(ssim_map(image, target)[mask], dtype=np.float64)
    return float((1 - dssim_weight) * l1 + dssim_weight * (1 - ssim)), tape


def photometric_loss_vjp(tape: LossTape, v_loss: float = 1.0) -> Floats:
    """Gradient of :func:`photometric_loss`.

    With n values under the mask::

        v_I = v_loss ((1 - w) sign(I - T) / n - w v_SSIM),   v_SSIM = ssim_map_vjp(I, T, mask / n)

    Parameters
    ----------
    tape : LossTape
        From the forward function.
    v_loss : float
        Derivative with respect to the loss.

    Returns
    -------
    ndarray of shape (H, W, 3)
        Derivative with respect to the image; zero outside the mask.
    """
    image, target, w, mask = tape
    n = max(1, image.shape[2] * int(np.count_nonzero(mask)))  # an empty mask gives zeros, not 0/0
    one_over_n = np.where(mask[:, :, None], np.ones_like(image) / n, 0)
    v_l1 = one_over_n * np.sign(image - target)
    v_ssim = ssim_map_vjp(image, target, one_over_n)
    return np.where(mask[:, :, None], v_loss * ((1 - w) * v_l1 - w * v_ssim), 0)


def ssim_map(image: Floats, target: Floats) -> Floats:
    """Return the structural similarity of two images around each pixel, channel by channel.

    With window means ``mu_x = blur(x)``, variances ``blur(x^2) - mu_x^2`` and covariance ``blur(x y) - mu_x mu_y``::

        SSIM = (2 mu_x mu_y + C1) (2 cov + C2) / ((mu_x^2 + mu_y^2 + C1) (var_x + var_y + C2))

    Parameters
    ----------
    image, target : ndarray of shape (H, W, 3)
        In [0, 1].

    Returns
    -------
    ndarray of shape (H, W, 3)
        1 where equal.
    """
    *_, luminance, structure, luminance_scale, structure_scale = _ssim_terms(image, target)
    return luminance * structure / (luminance_scale * structure_scale)


def ssim_map_vjp(image: Floats, target: Floats, v_map: Floats) -> Floats:
    """Gradient of :func:`ssim_map` with respect to the image x; for that of the target, exchange the arguments.

    Call the four factors ``S = P Q / (A B)``. They depend on x through ``mu = blur(x)``, ``m = blur(x^2)`` and
    ``k = blur(x y)``, and blur is its own adjoint::

        v_P = Q / (A B) v_S,  v_Q = P / (A B) v_S,  v_A = -S / A v_S,  v_B = -S / B v_S
        v_mu = 2 mu_y (v_P - v_Q) + 2 mu_x (v_A - v_B)
        v_m = v_B,  v_k = 2 v_Q
        v_x = blur(v_mu) + 2 x blur(v_m) + y blur(v_k)

    Parameters
    ----------
    image, target : ndarray of shape (H, W, 3)
        As for the forward function.
    v_map : ndarray of shape (H, W, 3)
        Derivative with respect to the map.

    Returns
    -------
    ndarray of shape (H, W, 3)
        Derivative with respect to ``image``.
    """
    mu_x, mu_y, P, Q, A, B = _ssim_terms(image, target)
    S = P * Q / (A * B)
    v_P, v_Q, v_A, v_B = Q / (A * B) * v_map, P / (A * B) * v_map, -S / A * v_map, -S / B * v_map
    v_mu = 2 * mu_y * (v_P - v_Q) + 2 * mu_x * (v_A - v_B)
    v_m, v_k = v_B, 2 * v_Q
    return _blur(v_mu) + 2 * image * _blur(v_m) + target * _blur(v_k)


def _ssim_terms(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
    """Return mu_x, mu_y and the factors P, Q, A, B of ``SSIM = P Q / (A B)``."""
    mu_x, mu_y = _blur(x), _blur(y)
    var_x, var_y, cov = _blur(x * x) - mu_x * mu_x, _blur(y * y) - mu_y * mu_y, _blur(x * y) - mu_x * mu_y
    P, Q = 2 * mu_x * mu_y + SSIM_C1, 2 * cov + SSIM_C2
    A, B = mu_x * mu_x + mu_y * mu_y + SSIM_C1, var_x + var_y + SSIM_C2
    return mu_x, mu_y, P, Q, A, B


def _blur(image: Floats) -> Floats:
    """Blur [H, W, C] with the Gaussian window and zeros beyond the border: ``K_H image K_W`` with K^T = K."""
    height, width, _ = image.shape
    K_rows, K_columns = _window_matrix(height).astype(image.dtype), _window_matrix(width).astype(image.dtype)
    return np.moveaxis(K_rows @ np.moveaxis(image, 2, 0) @ K_columns, 0, 2)


def _window_matrix(n: int) -> Floats:
    """Return the matrix [n, n] of the 1D window: ``K_ij = g(i - j)``, g normalised over the whole window."""
    reach = SSIM_WINDOW // 2
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / SSIM_SIGMA) ** 2)
    weights /= weights.sum()
    offsets = np.subtract.outer(np.arange(n), np.arange(n))
    return np.where(np.abs(offsets) <= reach, weights[np.clip(offsets + reach, 0, 2 * reach)], 0)
