"""Adam for one value, or for eight as lanes (Kingma and Ba 2015)."""

from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import sqrt


@scalar
def adam_value(value, gradient, first, second, rate, keep1, keep2, eps):
    """Return the value and both moments one step on; ``keep1`` and ``keep2`` are 1 - beta1 and 1 - beta2."""
    first = first + keep1 * (gradient - first)
    second = second + keep2 * (gradient * gradient - second)
    return value - rate * first / (sqrt(second) + eps), first, second
