"""From votes to labels: the optimal assignment of FlashSplat (arXiv 2409.08270), with a bias to the background.

With the geometry frozen, labels P_i in [0, 1] of the Gaussians render the mask ``sum_i w_i P_i`` in [0, 1]. So
``|sum_i w_i P_i - M|`` is that sum where M = 0 and 1 minus it where M = 1, and the mean over all pixels is linear in P:
each Gaussian takes the class with more votes. Of two, with votes as shares,

    P_i = [a_1(i) > a_0(i) + gamma],   a_e(i) = A_e(i) / sum_f A_f(i)

With gamma = 0 that is the optimum; a gamma above 0 leaves doubtful Gaussians to the background, which cleans the
extracted object, and one below 0 takes them along, which cleans the rest. Of several objects, either each is separated
from the rest, and a Gaussian may belong to two; or each Gaussian has one label, that of most votes.
"""

import numpy as np

from minisplat_ref.extensions.segment.votes import Votes
from minisplat_ref.types import Bools, Ints

UNSEEN = -1  # the label of Gaussians without a vote


def labels(votes: Votes, bias: float) -> Ints:
    """Return the label [N] of each Gaussian: the one with the largest share, that of the background raised by the bias.

    ::

        argmax_e  a_e + gamma [e = 0]

    The background wins where it is equal to another. Gaussians that no view sees have :data:`UNSEEN`.
    """
    shares = votes.shares.copy()
    shares[votes.ids.index(0)] += bias
    first_background = [votes.ids.index(0), *(row for row, label in enumerate(votes.ids) if label != 0)]
    winners = np.array(first_background)[np.argmax(shares[first_background], axis=0)]
    return np.where(votes.is_seen, np.array(votes.ids)[winners], UNSEEN)


def belongs(votes: Votes, label: int, bias: float) -> Bools:
    """Return whether each Gaussian [N] is of one object: ``a_e > 1 - a_e + gamma``.

    One that no view sees is not, as its a_e is 0.
    """
    a = votes.shares[votes.ids.index(label)]
    return np.asarray(a > 1 - a + bias)
