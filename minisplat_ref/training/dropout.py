"""DropGaussian: renderings of the training leave out Gaussians at random, so that all of them learn to explain a view.

Of few photographs, Gaussians near the cameras explain each one for itself, and those behind them get hardly any
gradient. Park et al. (CVPR 2025, arXiv 2504.00773) leave out each Gaussian with the probability r in every rendering of
the training, and make up for it in the opacities of the others::

    o' = o / (1 - r),    r = dropout t / T

with t the iteration, T the length of the training, and 0.2 for the dropout. Opacities may so exceed 1, as released;
alpha is limited to that of the rasteriser. Test views show all Gaussians.

It is a setting of any recipe, ``--set dropout=0.2``, and 0, its default, draws no random number. T is 3,000 for a
recipe that decides its own length, from where r stays. Whoever is left out counts as not seen, so gradients for density
control are the mean over the renderings that a Gaussian is part of; the release counts the others, too, with zeros.
"""

import numpy as np

from minisplat_ref.rendering import Request
from minisplat_ref.types import Bools

OPEN_LENGTH = 3_000  # T of a recipe without a schedule, iterations; the length at which recipes are compared


def drop_share(dropout: float, step: int, length: int) -> float:
    """Return r in iteration ``step``: it rises with the iterations to ``dropout`` at ``length``, and stays."""
    return dropout * min(step / length, 1.0)


def leave_out(request: Request, n_gaussians: int, share: float, rng: np.random.Generator) -> Request:
    """Return the request without a random share of the rows, and with greater opacities of the others.

    Parameters
    ----------
    request : Request
        Rows that it hides stay hidden.
    n_gaussians : int
        N.
    share : float
        r, the probability with which each row is left out; below 1.
    rng : numpy.random.Generator
    """
    is_kept: Bools = rng.random(n_gaussians) >= share  # [N]
    if request.is_visible is not None:
        is_kept &= request.is_visible
    return request._replace(is_visible=is_kept, opacity_factor=1 / (1 - share))
