"""Growth that hardly changes the image: each Gaussian becomes two halves, side by side on its longest axis.

A clone of 3DGS doubles the opacity where it is put, and a child of its split lands at random: both spoil the image,
and the next iterations repair it. Here the two halves together have the mean, the covariance and the optical depth of
the Gaussian that they replace. With the offset d from its centre, in standard deviations along the longest axis k,

    mu' = mu +- d s_k R_k        s_k' = sqrt(1 - d^2) s_k              keeps mean and covariance of the equal mixture
    tau = -ln(1 - o)             tau' = tau / (2 sqrt(1 - d^2))        keeps the integral of tau exp(-x^2 / 2)

The latter holds because the integral of a Gaussian is proportional to its height and its width. Instead of the clones
and splits of 3DGS the halves gain 0.6 dB with a quarter of the Gaussians (``docs/measured/adaptive.md``).
"""

import math

import numpy as np

from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.strategy.ops import Edit, concat, take
from minisplat_ref.types import Floats, Gaussians, Ints

OFFSET = 0.5  # standard deviations from the old centre to the new ones
LINEAR_BELOW = -40.0  # logits at which an opacity is its own optical depth, in float64; below -745 it would become 0


def halves(gaussians: Gaussians, parent_ids: Ints, *, offset: float = OFFSET) -> Edit:
    """Replace each chosen Gaussian by two halves.

    Parameters
    ----------
    gaussians : Gaussians
    parent_ids : ndarray of shape (P,)
        Rows to halve.
    offset : float
        d, in [0, 1): standard deviations along the longest axis.

    Returns
    -------
    edit : Edit
        All rows in their order, each parent changed into its first half, which keeps the moments; then the second
        halves.
    """
    parents = take(gaussians, parent_ids)
    dtype = parents.means.dtype
    rows, longest = np.arange(len(parent_ids)), parents.log_scales.argmax(axis=1)  # [P], the first of equals
    axes = rotation_matrices(parents.quats)[rows, :, longest]  # [P, 3] world frame, unit length
    shifts = dtype.type(offset) * np.exp(parents.log_scales[rows, longest])[:, None] * axes  # [P, 3]
    shrink = math.sqrt(1.0 - offset**2)
    parents.log_scales[rows, longest] += dtype.type(math.log(shrink))  # take() copied
    parents = parents._replace(opacity_logits=thin_logits(parents.opacity_logits, 1.0 / (2.0 * shrink)))
    second = parents._replace(means=parents.means + shifts)
    first = parents._replace(means=parents.means - shifts)
    changed = type(gaussians)(*(field.copy() for field in gaussians))
    for field, own in zip(changed, first, strict=True):
        field[parent_ids] = own
    is_new = np.arange(len(gaussians.means) + len(parent_ids)) >= len(gaussians.means)
    return Edit(concat(changed, second), np.concatenate([np.arange(len(gaussians.means)), parent_ids]), is_new)


def thin_logits(opacity_logits: Floats, factor: float) -> Floats:
    """Return the logits of Gaussians with ``factor`` times the optical depth: 1 - o' = (1 - o)^factor.

    Parameters
    ----------
    opacity_logits : ndarray
        Of any shape and value.
    factor : float
        Above 0.

    Returns
    -------
    ndarray
        Same shape and dtype.
    """
    logits = opacity_logits.astype(np.float64)
    # ln(1 - o) from the logit: 1 - o has no digits left where o is near 1.
    log_transparencies = -np.logaddexp(0.0, np.maximum(logits, LINEAR_BELOW)) * factor
    thinned = np.log(-np.expm1(log_transparencies)) - log_transparencies
    return np.where(logits < LINEAR_BELOW, logits + math.log(factor), thinned).astype(opacity_logits.dtype)
