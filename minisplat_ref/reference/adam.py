"""The optimiser step: Adam (Kingma and Ba 2015, algorithm 1) on the chosen rows of one array.

::

    m <- m + (1 - beta1) (g - m)          v <- v + (1 - beta2) (g^2 - v)
    p <- p - rate m / (sqrt(v) + eps)

Left out: the bias corrections, which are the same number for all values of a step, so the caller folds them into the
rate and into eps.
"""

import numpy as np

from minisplat_ref.types import AdamStep, Floats, Ints


def adam_update(
    values: Floats,
    gradient: Floats,
    first: Floats,
    second: Floats,
    rows: Ints | None,
    step: AdamStep,
) -> None:
    """Update ``values`` and both moments in place.

    Parameters
    ----------
    values, gradient, first, second : ndarray of shape (N, W)
        Parameters, their gradient, and the decaying means of the gradient and of its square.
    rows : ndarray of shape (V,), optional
        Rows to update, each once; the others are neither read nor written. None for all.
    step : AdamStep
        Rate, decay of the two means, and what is added to the root.
    """
    chosen = slice(None) if rows is None else rows
    g, m, v = gradient[chosen], first[chosen], second[chosen]  # [V, W]
    m = m + (1 - step.beta1) * (g - m)
    v = v + (1 - step.beta2) * (g * g - v)
    first[chosen], second[chosen] = m, v
    values[chosen] -= step.rate * m / (np.sqrt(v) + step.eps)
