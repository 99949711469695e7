"""The effect of a network's output on opacities and coefficients, each beside its gradient.

All of it is in NumPy alone: a few operations per Gaussian are negligible compared with the network and the hash grid,
which have kernels.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.types import Bools, Floats

OPACITY_MAX = 0.99  # for opacities that the network raises
OPACITY_MIN = 1e-4  # below 1/255, which no pixel shows


def modulate(x: Floats, y: Floats, is_sum: bool) -> Floats:
    """Return ``x + y``, or ``x (1 + y)``; both leave x where y is 0."""
    return x + y if is_sum else x * (1 + y)


def modulate_vjp(x: Floats, y: Floats, is_sum: bool, v: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`modulate` with respect to x and y: (v, v), or ``((1 + y) v, x v)``."""
    return (v, v) if is_sum else ((1 + y) * v, x * v)


class Opacities(NamedTuple):
    """Opacities of a view, and the values that their gradient needs."""

    logits: Floats
    """[N] l' = logit(o')."""
    own: Floats
    """[N] o, which all views share."""
    seen: Floats
    """[N] o'."""
    is_free: Bools
    """[N] where o' is at neither bound."""


def modulated_logits(logits: Floats, y: Floats, is_sum: bool) -> Opacities:
    """Return the logits l' of a view's opacities, from those of all views and the network's output.

    ::

        o = sigmoid(l),   o' = min(max(o (1 + y) or o + y, 1e-4), 0.99),   l' = log(o' / (1 - o'))

    Where y is 0, and where it would raise an opacity above 0.99 further, l' is l to the last bit.

    Parameters
    ----------
    logits, y : ndarray of shape (N,)
    is_sum : bool
        As for :func:`modulate`.
    """
    own = 1 / (1 + np.exp(-logits))
    raw = modulate(own, y, is_sum)
    seen = np.clip(raw, OPACITY_MIN, OPACITY_MAX)
    is_kept = (y == 0) | ((own > OPACITY_MAX) & (raw > own))
    found = np.where(is_kept, logits, np.log(seen) - np.log1p(-seen))
    is_free = ((raw > OPACITY_MIN) & (raw < OPACITY_MAX)) | (y == 0)
    return Opacities(found, own, np.where(is_kept, own, seen), is_free)


def modulated_logits_vjp(opacities: Opacities, y: Floats, is_sum: bool, v: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`modulated_logits` with respect to l and y.

    ::

        v_o' = v / (o' (1 - o')) between the bounds, 0 at them
        v_o, v_y = those of modulate,   v_l = o (1 - o) v_o

    Where an opacity above 0.99 is kept, v_l = v and v_y = 0.

    Parameters
    ----------
    opacities : Opacities
        From the forward function.
    y, is_sum
        As there.
    v : ndarray of shape (N,)
        Derivative with respect to l'.
    """
    own, seen = opacities.own, opacities.seen
    v_seen = np.zeros_like(v)
    np.divide(v, seen * (1 - seen), out=v_seen, where=opacities.is_free)
    v_own, v_y = modulate_vjp(own, y, is_sum, v_seen)
    is_kept = ~opacities.is_free & (seen == own) & (own > OPACITY_MAX)
    return np.where(is_kept, v, own * (1 - own) * v_own), v_y
