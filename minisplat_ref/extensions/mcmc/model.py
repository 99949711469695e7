"""The formulas of MCMC densification: copies that render as one, noise, and the two means beside their gradients."""

from typing import Any

import numpy as np
from scipy.special import comb, expit, logit

from minisplat_ref.reference.covariance import covariances
from minisplat_ref.types import Floats, Ints

COPIES_MAX = 50  # in one place, as released: its table of binomials ends there
SHARPNESS, THRESHOLD = 100.0, 0.995  # k and x0 of the noise: it fades above an opacity of 0.005
OPACITY_MAX = 1.0 - 2.0**-23
OPACITY_MIN = 0.005  # of a copy


def share_among_copies(opacity_logits: Floats, log_scales: Floats, n_copies: Ints) -> tuple[Floats, Floats]:
    """Return the parameters of each of N Gaussians in one place that together render as one; equation (9).

    Together they have its opacity at the centre, and its integral on each line through it::

        o' = 1 - (1 - o)^(1/N),    s' = s o / sum_{m=1}^N C(N, m) (-1)^(m+1) o'^m / sqrt(m)

    Then o' is limited to the range from 0.005 to 1 - 2^-23, as released.

    Parameters
    ----------
    opacity_logits : ndarray of shape (M,)
        Of the Gaussians to be copied.
    log_scales : ndarray of shape (M, 3)
        Logarithms of their standard deviations, world units.
    n_copies : ndarray of shape (M,) of int
        N, the Gaussian itself included; from 1 on, above :data:`COPIES_MAX` as if it were that.

    Returns
    -------
    opacity_logits, log_scales : ndarray of shape (M,) and (M, 3)
        In the dtypes of the arguments.
    """
    N = np.minimum(n_copies, COPIES_MAX)  # [M]
    x = np.minimum(opacity_logits.astype(np.float64), logit(OPACITY_MAX))
    o = expit(x)
    copy = -np.expm1(-np.logaddexp(0, x) / N)  # [M] o'; log(1 - o) = -log(1 + exp(x))
    m = np.arange(1, N.max(initial=1) + 1)
    terms = comb(N[:, None], m) * (-1.0) ** (m + 1) * copy[:, None] ** m / np.sqrt(m)  # [M, max N], 0 for m > N
    log_ratios = np.log(o / terms.sum(axis=1))  # [M]
    limited = logit(np.clip(copy, OPACITY_MIN, OPACITY_MAX))
    return limited.astype(opacity_logits.dtype), (log_scales + log_ratios[:, None]).astype(log_scales.dtype)


def draw_noise(gaussians: Any, size: float, rng: np.random.Generator) -> Floats:
    """Return displacements of the means [N, 3], world units: ``size sigmoid(k ((1 - o) - x0)) Sigma e``, e normal.

    Parameters
    ----------
    gaussians : Gaussians
    size : float
        l a, the learning rate of the means, in world units, times the strength of the noise.
    rng : numpy.random.Generator

    Returns
    -------
    ndarray of shape (N, 3)
        In the dtype of the means.
    """
    gates = expit(SHARPNESS * ((1 - expit(gaussians.opacity_logits.astype(np.float64))) - THRESHOLD))  # [N]
    e = rng.standard_normal(gaussians.means.shape)  # [N, 3]
    Sigma = covariances(gaussians.quats.astype(np.float64), np.exp(gaussians.log_scales.astype(np.float64)))
    moves = (size * gates)[:, None] * (Sigma @ e[:, :, None])[:, :, 0]
    return moves.astype(gaussians.means.dtype)


def mean_opacity(opacity_logits: Floats) -> float:
    """Return the mean of ``o = 1 / (1 + exp(-x))`` over Gaussians of logits x [N]; 0 of none."""
    return float(np.mean(expit(opacity_logits), dtype=np.float64)) if len(opacity_logits) else 0.0


def mean_opacity_vjp(opacity_logits: Floats, v_mean: float = 1.0) -> Floats:
    """Gradient of :func:`mean_opacity` [N]: ``v_x = o (1 - o) v / N``."""
    o = expit(opacity_logits)
    return o * expit(-opacity_logits) * o.dtype.type(v_mean / max(len(o), 1))


def mean_scale(log_scales: Floats) -> float:
    """Return the mean of the standard deviations ``s = exp(log_s)`` [N, 3], world units; 0 of none."""
    return float(np.mean(np.exp(log_scales), dtype=np.float64)) if len(log_scales) else 0.0


def mean_scale_vjp(log_scales: Floats, v_mean: float = 1.0) -> Floats:
    """Gradient of :func:`mean_scale` [N, 3]: ``v_log_s = s v / (3 N)``."""
    return np.exp(log_scales) * log_scales.dtype.type(v_mean / max(log_scales.size, 1))
