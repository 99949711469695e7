"""Adam (Kingma and Ba 2015) over any NamedTuple of [N, ...] arrays, dense or on the visible rows only.

    m <- m + (1 - beta1) (g - m)          v <- v + (1 - beta2) (g^2 - v)
    p <- p - rate  m / (1 - beta1^t)  /  (sqrt(v / (1 - beta2^t)) + eps)

Dense is what 3DGS uses. *Visible-only* is the sparse Adam of 3DGS-accel (Taming 3DGS): a Gaussian that the view did not
see keeps its parameters and moments, where dense Adam would let it coast on its momentum; and there are no bias
corrections (the two denominators 1 - beta^t), so a new Gaussian's first steps are up to (1-beta1)/sqrt(1-beta2) = 3.2
times the rate. Mini-Splatting2 is visible-only with the corrections.
"""

import math
from collections.abc import Sequence
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from minisplat_ref.types import Floats, Ints

Population = TypeVar("Population", bound=NamedTuple)

BLOCK_VALUES = 1 << 14  # values updated at once: five blocks of float32 are 320 KiB, which stay in the cache of a core


class AdamRule(NamedTuple):
    """Which Adam."""

    is_visible_only: bool
    """Update only the rows that the view sees."""
    has_bias_correction: bool
    """Divide the moments by 1 - beta^t, t the steps taken since the moments were zeroed."""
    beta1: float = 0.9
    """Decay of the mean gradient."""
    beta2: float = 0.999
    """Decay of the mean squared gradient."""
    eps: float = 1e-15
    """Added to the root. Far below the usual 1e-8, because the gradient of one Gaussian is often as small as that."""


class AdamState(NamedTuple, Generic[Population]):
    """Moments of the gradient; the arrays are updated in place."""

    first: Population
    """Mean gradient, field by field."""
    second: Population
    """Mean squared gradient, field by field."""
    step: int
    """Steps taken."""


def zero_moments(population: Population) -> AdamState[Population]:
    """Return the state before the first step."""
    return AdamState(
        population._make(np.zeros_like(field) for field in population),
        population._make(np.zeros_like(field) for field in population),
        0,
    )


def adam_step(
    parameters: Population,
    gradient: Population,
    state: AdamState[Population],
    rates: Sequence[float],
    rule: AdamRule,
    visible_ids: Ints,
) -> AdamState[Population]:
    """Update ``parameters`` and the moments in place.

    Parameters
    ----------
    parameters, gradient : NamedTuple of ndarrays of shape (N, ...)
        All fields C-contiguous.
    state : AdamState
        Its arrays are updated in place.
    rates : sequence of float
        One learning rate per field.
    rule : AdamRule
    visible_ids : ndarray of shape (V,)
        Rows that a visible-only rule updates, ascending; the others are neither read nor written.

    Returns
    -------
    state : AdamState
        The same arrays, one step further.
    """
    step = state.step + 1
    correction = math.sqrt(1 - rule.beta2**step) / (1 - rule.beta1**step) if rule.has_bias_correction else 1.0
    eps = rule.eps * (math.sqrt(1 - rule.beta2**step) if rule.has_bias_correction else 1.0)
    rows = visible_ids if rule.is_visible_only else None
    for *arrays, rate in zip(parameters, gradient, state.first, state.second, rates, strict=True):
        field, g, m, v = (array.reshape(len(array), math.prod(array.shape[1:])) for array in arrays)  # [N, width]
        _update_field(field, g, m, v, rate * correction, eps, rule, rows)
    return state._replace(step=step)


def _update_field(
    field: Floats,
    gradient: Floats,
    first: Floats,
    second: Floats,
    rate: float,
    eps: float,
    rule: AdamRule,
    rows: Ints | None,
) -> None:
    """Update one [N, width] field, all of it or the chosen rows, as many rows at a time as the cache holds."""
    n_rows = len(field) if rows is None else len(rows)
    n_block_rows = max(1, BLOCK_VALUES // max(1, field.shape[1]))
    for start in range(0, n_rows, n_block_rows):
        block = slice(start, start + n_block_rows) if rows is None else rows[start : start + n_block_rows]
        g, m, v = (_read(array, block) for array in (gradient, first, second))  # [B, width]
        m += (1 - rule.beta1) * (g - m)
        v += (1 - rule.beta2) * (g * g - v)
        field[block] -= rate * m / (np.sqrt(v) + eps)
        if rows is not None:
            first[block], second[block] = m, v


def _read(array: Floats, block: slice | Ints) -> Floats:
    """Return a view of a slice, or a copy of rows: ``take`` copies them twice as fast as an index does."""
    return array[block] if isinstance(block, slice) else array.take(block, axis=0)
