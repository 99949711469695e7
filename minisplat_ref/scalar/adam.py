"""Adam (Kingma and Ba 2015) for one value, or for eight in lanes."""

from typing import NamedTuple

from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import sqrt


class Step(NamedTuple):
    """An :class:`~minisplat_ref.types.AdamStep` in the data's dtype."""

    rate: float
    keep1: float
    """1 - beta1, likewise below."""
    keep2: float
    eps: float


@scalar
def adam_value(value, gradient, first, second, step):
    """Return the value and both moments after one step."""
    first = first + step.keep1 * (gradient - first)
    second = second + step.keep2 * (gradient * gradient - second)
    return value - step.rate * first / (sqrt(second) + step.eps), first, second
