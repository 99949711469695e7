"""Aggressive clone of Mini-Splatting2: clone the important Gaussians without changing the image.

A plain copy makes a Gaussian more opaque. Here the N copies share the opacity and the size of the one that they replace
(the rule by which 3DGS-MCMC relocates Gaussians). With its opacity o and scales s,

    o' = 1 - (1 - o)^(1/N)                       N copies composite to o at the centre
    s' = s o / sum_k C(N, k) (-1)^(k+1) o'^k / sqrt(k)        k = 1 ... N

The latter holds because along a line through the centre, where one copy has alpha u(x) = o' exp(-x^2 / 2 s'^2), N have
1 - (1 - u)^N, a sum of Gaussians of widths s' / sqrt(k) with the integral of the old profile, sqrt(2 pi) s o.

There are two readings of *critical*, the released code's and the paper's, and they differ a lot. Left out: the removal
just before it in the released code, which is an action of the recipe.
"""

import math

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.strategy.clone_split import logit
from minisplat_ref.strategy.importance import ImportanceStats, mass_mask
from minisplat_ref.strategy.ops import Edit, concat, n_rows, take
from minisplat_ref.types import Bools, Floats, Gaussians

SHARED_OPACITY_MIN = 0.0051
"""Copies are not made fainter than this, just above density control's limit of 0.005, unless their parent is.
From the released code. Its other bound, 1 - 1e-7, is not needed: the logits are computed without 1 - o."""


def critical_by_mass(stats: ImportanceStats, mass: float = 0.99) -> Bools:
    """Return which Gaussians carry ``mass`` of the blend weight among those that dominate a pixel, as in released code.

    This is a large part of all Gaussians.

    Parameters
    ----------
    stats : ImportanceStats
    mass : float
        Fraction of the sum, in (0, 1].

    Returns
    -------
    mask : ndarray of shape (N,) of booleans
    """
    return mass_mask(np.where(stats.dominant_count > 0, stats.blend_weight_sum, 0.0), mass)


def critical_by_weight(stats: ImportanceStats, quantile: float = 0.99) -> Bools:
    """Return which Gaussians have the largest blending weights, as in the paper.

    This is one in a hundred, and more where the weights of many reach alpha's upper bound.

    Parameters
    ----------
    stats : ImportanceStats
    quantile : float
        Rank, in [0, 1], of the threshold among all Gaussians' largest weights; ties with it are critical.

    Returns
    -------
    mask : ndarray of shape (N,) of booleans
        At least one is True unless no view sees anything.
    """
    weights = stats.blend_weight_max  # [N]
    threshold = np.quantile(weights, quantile) if len(weights) else 0.0
    return (weights >= threshold) & (weights > 0)


def shared_opacities(opacities: Floats, factor: int) -> Floats:
    """Return the opacity of each of ``factor`` copies that composite to ``opacities``: o' = 1 - (1 - o)^(1/N).

    Parameters
    ----------
    opacities : ndarray
        In [0, 1].
    factor : int
        N, at least 1.

    Returns
    -------
    shared : ndarray
        Same shape; without the bound :data:`SHARED_OPACITY_MIN`.
    """
    with np.errstate(divide="ignore"):  # log of 0, where the opacity is 1
        return -np.expm1(np.log1p(-opacities) / factor)


def shared_scale_factors(opacities: Floats, factor: int) -> Floats:
    """Return s' / s, by which the scales of ``factor`` copies shrink.

    Numerator and denominator are divided by the opacity, so that faint Gaussians do not give 0 / 0::

        o / o' = (1 - (1 - o')^N) / o' = sum_j (1 - o')^j        j = 0 ... N - 1
        s' / s = sum_j (1 - o')^j  /  sum_k C(N, k) (-o')^(k-1) / sqrt(k)

    Terms of the second sum cancel: N log10(1 + o') of the 16 digits are lost. This matters only for tens of copies of
    an opaque Gaussian.

    Parameters
    ----------
    opacities : ndarray of shape (N,)
        In [0, 1], of the Gaussian that is replaced.
    factor : int
        Copies, at least 1.

    Returns
    -------
    factors : ndarray of shape (N,)
        In (0, 1]: 1 for the faintest.
    """
    return _scale_factors(shared_opacities(opacities.astype(np.float64), factor), factor).astype(opacities.dtype)


def _scale_factors(shared: Floats, factor: int) -> Floats:
    geometric = np.ones(factor)
    profile = np.array([(-1) ** (k - 1) * math.comb(factor, k) / math.sqrt(k) for k in range(1, factor + 1)])
    return np.polynomial.polynomial.polyval(1 - shared, geometric) / np.polynomial.polynomial.polyval(shared, profile)


def clone(gaussians: Gaussians, is_critical: Bools, *, factor: int = 2) -> Edit:
    """Replace every critical Gaussian by ``factor`` copies that together look like it.

    Parameters
    ----------
    gaussians : Gaussians
    is_critical : ndarray of shape (N,) of booleans
    factor : int
        Copies that one becomes; 2 in the paper, 1 changes nothing.

    Returns
    -------
    edit : Edit
        All rows in their order, the critical ones changed in place so that they keep their moments; then the first copy
        of every critical one, the second, and so on.

    Raises
    ------
    InputError
        ``factor`` is below 1.
    """
    if factor < 1:
        raise InputError(f"clone factor is {factor}, but a Gaussian becomes at least one: use 2, or 1 for no clones")
    ids = np.flatnonzero(is_critical)
    originals = gaussians.opacity_logits[ids]  # [C]
    least = logit(SHARED_OPACITY_MIN)
    # ln(1 - o') from the logit: 1 - o has no digits left where o is near 1.
    log_transparencies = -np.logaddexp(0.0, np.maximum(originals, least).astype(np.float64)) / factor
    shared = -np.expm1(log_transparencies)
    logits = np.minimum(originals, np.maximum(np.log(shared) - log_transparencies, least))
    opacity_logits, log_scales = gaussians.opacity_logits.copy(), gaussians.log_scales.copy()
    opacity_logits[ids] = logits
    log_scales[ids] += np.log(_scale_factors(shared, factor))[:, None].astype(log_scales.dtype)
    parents = gaussians._replace(opacity_logits=opacity_logits, log_scales=log_scales)
    clone_ids = np.tile(ids, factor - 1)
    parent_ids = np.concatenate([np.arange(n_rows(gaussians)), clone_ids])
    return Edit(concat(parents, take(parents, clone_ids)), parent_ids, np.arange(len(parent_ids)) >= n_rows(gaussians))
