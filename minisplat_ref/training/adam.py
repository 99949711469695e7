"""Adam (Kingma and Ba 2015) over any bundle of [N, ...] arrays, dense or on the visible rows only.

    m <- m + (1 - beta1) (g - m)          v <- v + (1 - beta2) (g^2 - v)
    p <- p - rate  m / (1 - beta1^t)  /  (sqrt(v / (1 - beta2^t)) + eps)

3DGS uses dense Adam. *Visible-only* is the sparse Adam of 3DGS-accel (Taming 3DGS): a Gaussian that the view did not
see keeps its parameters and moments, where dense Adam would let it coast on its momentum; and there are no bias
corrections (the two denominators 1 - beta^t), so a new Gaussian's first steps are up to (1-beta1)/sqrt(1-beta2) = 3.2
times the rate. Mini-Splatting2 is visible-only with the corrections.
"""

import math
from collections.abc import Mapping
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from minisplat_ref.rendering.backends import CPU, Backend
from minisplat_ref.types import NOTHING, AdamStep, Floats, Ints

Parameters = TypeVar("Parameters")  # a population, or a mapping of shared parameters


class AdamRule(NamedTuple):
    """A variant of Adam."""

    is_visible_only: bool
    """Update only the rows that the view sees."""
    has_bias_correction: bool
    """Divide the moments by 1 - beta^t, where t counts the steps since the moments were zeroed."""
    beta1: float = 0.9
    """Decay of the mean gradient."""
    beta2: float = 0.999
    """Decay of the mean squared gradient."""
    eps: float = 1e-15
    """Added to the root. Far below the usual 1e-8, because the gradient of one Gaussian is often that small."""


class AdamState(NamedTuple, Generic[Parameters]):
    """Moments of the gradient; the arrays are updated in place."""

    first: Parameters
    """Mean gradient, field by field."""
    second: Parameters
    """Mean squared gradient, field by field."""
    step: int
    """Steps taken."""
    joined: Mapping[str, int] = {}  # not NOTHING, which cannot be copied; it is never changed
    """For fields that joined later, the step at which their moments began at zero."""


def zero_moments(parameters: Parameters) -> AdamState[Parameters]:
    """Return the state before the first step."""
    return AdamState(_zeros_like(parameters), _zeros_like(parameters), 0)


def _zeros_like(parameters: Parameters) -> Parameters:
    zeros = {name: np.zeros_like(array) for name, array in named_fields(parameters).items()}
    return zeros if isinstance(parameters, Mapping) else type(parameters)(**zeros)  # type: ignore[return-value]


def named_fields(parameters: Any) -> dict[str, Floats]:
    """Return the arrays of a population, or of shared parameters, by name."""
    return dict(parameters) if isinstance(parameters, Mapping) else parameters._asdict()


def adam_step(
    parameters: Parameters,
    gradient: Parameters,
    state: AdamState[Parameters],
    rates: Mapping[str, float],
    rule: AdamRule,
    visible_ids: Ints,
    backend: Backend = CPU,
    *,
    widths: Mapping[str, Ints] = NOTHING,
) -> AdamState[Parameters]:
    """Update ``parameters`` and the moments in place.

    Parameters
    ----------
    parameters, gradient : NamedTuple, or mapping, of ndarrays of shape (N, ...)
        All C-contiguous; float32 or float64.
    state : AdamState
        Its arrays are updated in place.
    rates : mapping of str to float
        The learning rate of each field by name; other names are ignored.
    rule : AdamRule
    visible_ids : ndarray of shape (V,)
        Rows that a visible-only rule updates, ascending; the others are neither read nor written.
    backend : Backend
        Implementation of the update.
    widths : mapping of str to ndarray of shape (N,)
        By field, the number of values of each row to update, the first ones; the others are neither read nor written.

    Returns
    -------
    state : AdamState
        The same arrays, one step further.
    """
    rows = visible_ids if rule.is_visible_only else None
    bundles = [named_fields(bundle) for bundle in (parameters, gradient, state.first, state.second)]
    for name, rate in ((name, rates[name]) for name in bundles[0]):
        arrays = (bundle[name] for bundle in bundles)
        values, g, first, second = (a.reshape(len(a), math.prod(a.shape[1:])) for a in arrays)  # [N, width] each
        update = _field_update(rule, rate, state.step + 1 - state.joined.get(name, 0))
        if name in widths:
            backend.adam_update(values, g, first, second, rows, update, widths[name])
        else:
            backend.adam_update(values, g, first, second, rows, update)
    return state._replace(step=state.step + 1)


def _field_update(rule: AdamRule, rate: float, step: int) -> AdamStep:
    """Return the constants of a field's step, the ``step``-th since its moments were zero."""
    if not rule.has_bias_correction:
        return AdamStep(rate, rule.beta1, rule.beta2, rule.eps)
    root = math.sqrt(1 - rule.beta2**step)
    return AdamStep(rate * (root / (1 - rule.beta1**step)), rule.beta1, rule.beta2, rule.eps * root)
