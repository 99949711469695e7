"""Mip-Splatting's 3D filter (Yu et al. 2023, equations 7 to 9) in NumPy, with its gradient.

A camera samples a Gaussian once per pixel, so detail finer than the finest pixel that saw it is not supported by the
photographs. Convolution with a round Gaussian of that size removes such detail.
"""

import numpy as np

from minisplat_ref.types import Floats

VARIANCE = 0.2  # of the filter, in units of the squared sampling interval
EXPONENT_MAX = 80.0  # of e^l, which float32 holds up to e^88; an opacity within 1e-35 of 1 has no gradient left


def smooth(log_scales: Floats, opacity_logits: Floats, sigmas: Floats) -> tuple[Floats, Floats]:
    """Return scales and opacities of Gaussians convolved with round ones; their integrals do not change.

    ::

        s'^2 = s^2 + sigma^2,   o' = rho o,   rho = prod_j s_j / s'_j

    In logarithms and logits, with ``t_j = sigma^2 / s_j^2``, nothing is rounded where sigma is 0::

        log s'_j = log s_j + log(1 + t_j) / 2
        log rho  = -sum_j log(1 + t_j) / 2
        l'       = l + log rho - log(1 + (1 - rho) e^l)

    Parameters
    ----------
    log_scales : ndarray of shape (N, 3)
        log s, world units.
    opacity_logits : ndarray of shape (N,)
        l, with o = 1 / (1 + e^-l).
    sigmas : ndarray of shape (N,)
        Standard deviations of the filters, world units; their sign does not matter.

    Returns
    -------
    log_scales : ndarray of shape (N, 3)
    opacity_logits : ndarray of shape (N,)
        In the dtype of the inputs.
    """
    growths = 0.5 * np.log1p(_ratios(log_scales, sigmas))  # [N, 3] log(1 + t) / 2
    log_rhos = -growths.sum(axis=1)  # [N]
    return log_scales + growths, opacity_logits + log_rhos - np.logaddexp(0, _lost_logits(opacity_logits, log_rhos))


def smooth_vjp(
    log_scales: Floats, opacity_logits: Floats, sigmas: Floats, v_log_scales: Floats, v_logits: Floats
) -> tuple[Floats, Floats, Floats]:
    """Gradient of :func:`smooth` with respect to its three arguments.

    With ``E = (1 - rho) e^l`` and ``d E / d log rho = -rho e^l``::

        v_l       = v_l' / (1 + E)
        v_log_rho = v_l' (1 + e^l) / (1 + E)
        v_log_s_j = v_log_s'_j / (1 + t_j) + v_log_rho t_j / (1 + t_j)
        v_sigma   = sum_j (v_log_s'_j - v_log_rho) sigma / (s_j^2 (1 + t_j))

    Parameters
    ----------
    log_scales, opacity_logits, sigmas
        As for the forward function.
    v_log_scales : ndarray of shape (N, 3)
    v_logits : ndarray of shape (N,)
        Derivatives with respect to its results.

    Returns
    -------
    v_log_scales : ndarray of shape (N, 3)
    v_opacity_logits, v_sigmas : ndarray of shape (N,)
    """
    t = _ratios(log_scales, sigmas)  # [N, 3]
    shares = t / (1 + t)
    log_rhos = -0.5 * np.log1p(t).sum(axis=1)  # [N]
    log_1_E = np.logaddexp(0, _lost_logits(opacity_logits, log_rhos))  # log(1 + E)
    v_l = v_logits * np.exp(-log_1_E)
    v_log_rho = v_logits * np.exp(np.minimum(np.logaddexp(0, opacity_logits) - log_1_E, EXPONENT_MAX))  # [N]
    v_log_s = v_log_scales / (1 + t) + v_log_rho[:, None] * shares
    is_filtered = sigmas != 0
    per_sigma = shares / np.where(is_filtered, sigmas, 1)[:, None]  # sigma / (s^2 (1 + t))
    return v_log_s, v_l, np.sum((v_log_scales - v_log_rho[:, None]) * per_sigma, axis=1)


def cap_smoothed_logits(log_scales: Floats, opacity_logits: Floats, sigmas: Floats, ceiling: float) -> Floats:
    """Return the logits with which smoothed Gaussians have at most the opacity ``ceiling``: Mip-Splatting's reset.

    A filtered opacity is ``o' = rho o``, so o may be up to ``ceiling / rho``, whose logit is ``log(ceiling / (rho -
    ceiling))``; where the filter alone makes a Gaussian as faint, with rho at most ``ceiling``, nothing changes.

    Parameters
    ----------
    log_scales, opacity_logits, sigmas
        As for :func:`smooth`.
    ceiling : float
        In (0, 1).

    Returns
    -------
    ndarray of shape (N,)
        In the dtype of the inputs.
    """
    rhos = np.exp(-0.5 * np.log1p(_ratios(log_scales, sigmas)).sum(axis=1))  # [N]
    with np.errstate(divide="ignore"):
        most = np.where(rhos > ceiling, np.log(ceiling) - np.log(np.maximum(rhos - ceiling, 0)), np.inf)
    return np.minimum(opacity_logits, most.astype(opacity_logits.dtype))


def _ratios(log_scales: Floats, sigmas: Floats) -> Floats:
    """Return t = sigma^2 / s^2 [N, 3], at most the largest finite number."""
    with np.errstate(over="ignore"):
        t = (np.abs(sigmas)[:, None] * np.exp(-log_scales)) ** 2
    return np.minimum(t, np.finfo(t.dtype).max)


def _lost_logits(opacity_logits: Floats, log_rhos: Floats) -> Floats:
    """Return log((1 - rho) e^l) [N]; -inf where rho is 1."""
    with np.errstate(divide="ignore"):
        return opacity_logits + np.log(-np.expm1(log_rhos))
