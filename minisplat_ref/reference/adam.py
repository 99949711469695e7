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
    widths: Ints | None = None,
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
    widths : ndarray of shape (N,), optional
        How many numbers of each row to update, from the first on; the others stay as they are. None for all.
    """
    chosen = slice(None) if rows is None else rows
    g, m, v = gradient[chosen], first[chosen], second[chosen]  # [V, W]
    m = m + (1 - step.beta1) * (g - m)
    v = v + (1 - step.beta2) * (g * g - v)
    p = values[chosen] - step.rate * m / (np.sqrt(v) + step.eps)
    is_updated = True if widths is None else np.arange(values.shape[1]) < widths[chosen, None]  # [V, W]
    for array, updated in ((values, p), (first, m), (second, v)):
        array[chosen] = np.where(is_updated, updated, array[chosen])
