"""The distinctiveness of a Gaussian from its neighbours, and the pruning score.

With the colours c_i of degree 0, in Morton order of the centres::

    LD_i = 1/3 sum_channels |c_i - c_prev| + |c_i - c_next|
    S_i  = I_i LD_i^lambda

Morton order replaces a neighbour search and costs only a sort. It misses neighbours across the faces of large cells.
Its cells have the proportions of the box that the centres fill, as in the released code.
"""

import numpy as np

from minisplat_ref.io.packing.morton import morton_order
from minisplat_ref.types import Floats


def local_distinctiveness(means: Floats, colors: Floats) -> Floats:
    """Return the difference of each colour from those before and after it in Morton order.

    Parameters
    ----------
    means : ndarray of shape (N, 3)
        World frame.
    colors : ndarray of shape (N, 3)
        Coefficients of degree 0, or any other features; the number of channels is arbitrary.

    Returns
    -------
    ndarray of shape (N,)
        LD, float64, not negative. At either end of the order the only neighbour counts twice; 0 for N = 1.
    """
    n = len(means)
    if n < 2:
        return np.zeros(n)
    order = morton_order(means, is_cubic=False)
    ordered = colors[order].astype(np.float64)  # [N, C]
    steps = np.abs(np.diff(ordered, axis=0)).mean(axis=1)  # [N - 1]
    around = np.concatenate([steps[:1], steps, steps[-1:]])  # [N + 1] before and after each
    distinctiveness = np.empty(n)
    distinctiveness[order] = around[:-1] + around[1:]  # back to the rows: the inverse permutation
    return distinctiveness


def distinct_importance(importance: Floats, distinctiveness: Floats, power: float) -> Floats:
    """Return the score ``S = I LD^lambda``.

    Parameters
    ----------
    importance, distinctiveness : ndarray of shape (N,)
        I and LD, not negative.
    power : float
        lambda; at 0 the score is the importance.
    """
    return importance * distinctiveness**power
