"""Votes of Gaussians for labels, and labels from votes: the optimal assignment of FlashSplat (arXiv 2409.08270).

A view blends the colours c_i of its Gaussians to ``sum_i w_i(p) c_i`` at the pixel p. That is linear in the colours, so
the weights of a Gaussian, summed over the pixels of a label e, are a gradient (FlashSplat, Eq. 7 counts the same):

    A_e(i) = sum_p w_i(p) [M(p) = e] = d/dc_i sum_p [M(p) = e] sum_j w_j(p) c_j

One backward pass returns it for three labels, one in each channel. It needs no statistics of the compositor's own, and
so holds for every renderer in which colours are blended once.

With the geometry frozen, labels P_i in [0, 1] of the Gaussians render the mask ``sum_i w_i P_i`` in [0, 1]. So
``|sum_i w_i P_i - M|`` is that sum where M = 0 and 1 minus it where M = 1, and the mean over all pixels is linear in P:
each Gaussian takes the class with more votes. Of two, with votes as shares,

    P_i = [a_1(i) > a_0(i) + gamma],   a_e(i) = A_e(i) / sum_f A_f(i)

With gamma = 0 that is the optimum; a gamma above 0 leaves doubtful Gaussians to the background, which cleans the
extracted object, and one below 0 takes them along, which cleans the rest. Of several objects, either each is separated
from the rest, and a Gaussian may belong to two; or each Gaussian has one label, that of most votes.
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.constants import SH_C0
from minisplat_ref.errors import InputError
from minisplat_ref.rendering import Renderer, Request
from minisplat_ref.types import Bools, Camera, Floats, Ints, Model, view_from

ALPHA_TOLERANCE = 1e-3  # of the sum of all weights: float32 sums of some 1e5 pixels
UNSEEN = -1  # the label of Gaussians without a vote


class Votes(NamedTuple):
    """Weights that N Gaussians have in the pixels of E labels, summed over views."""

    ids: tuple[int, ...]
    """The labels, ascending; 0 is the background and always among them."""
    weights: Floats
    """[E, N] A, float64, pixels."""

    @property
    def is_seen(self) -> NDArray[np.bool_]:
        """[N] whether a Gaussian has any weight."""
        return self.weights.sum(axis=0) > 0

    @property
    def shares(self) -> Floats:
        """[E, N] a_e = A_e / sum_f A_f; 0 of Gaussians that no view sees."""
        totals = self.weights.sum(axis=0)
        return self.weights / np.where(totals > 0, totals, 1.0)


def count_votes(population: Any, renderer: Renderer, views: Iterable[tuple[Camera, Ints]], ids: Sequence[int]) -> Votes:
    """Return the votes of a population for labels.

    Parameters
    ----------
    population : Gaussians, or a relative's population
        N primitives; their colours do not matter.
    renderer : Renderer
        Theirs.
    views : iterable of tuples (Camera, ndarray of shape (H, W) of int)
        Cameras, in the world of the population, each with its mask of labels.
    ids : sequence of ints
        The labels that the masks hold; others do not count.

    Raises
    ------
    InputError
        The weights of a view do not add up to its accumulated opacity: the renderer does not blend colours once.
    """
    known = tuple(sorted({0, *ids}))
    weights = np.zeros((len(known), len(population.means)))
    for camera, mask in views:
        weights += count_view_votes(population, renderer, camera, mask, known)
    return Votes(known, weights)


def colored(population: Any, colors: Floats) -> Any:
    """Return a population that shows colours [N, 3] in [0, 1] from every side: ``c = 1/2 + c_0 Y_0``."""
    n, dtype = len(population.means), population.means.dtype
    sh_dc = ((colors - 0.5) / SH_C0).astype(dtype)
    return population._replace(sh_dc=sh_dc, sh_rest=np.zeros((n, 0, 3), dtype))


def count_view_votes(population: Any, renderer: Renderer, camera: Camera, mask: Ints, ids: tuple[int, ...]) -> Floats:
    """Return A [E, N] of one view.

    Parameters
    ----------
    population : Gaussians, or a relative's population
    renderer : Renderer
    camera : Camera
    mask : ndarray of shape (H, W) of int
        Its labels.
    ids : tuple of E ints
        The labels that count, ascending.

    Raises
    ------
    InputError
        The weights do not add up to the accumulated opacity.
    """
    dtype = population.means.dtype
    gray = colored(population, np.full((len(population.means), 3), 0.5))  # no channel is clamped
    output, tape = renderer.render(Model(gray), view_from(camera), Request(np.zeros(3, dtype)))
    shown = [row for row, label in enumerate(ids) if (mask == label).any()]
    votes = np.zeros((len(ids), len(population.means)))
    total = 0.0
    for first in range(0, len(shown), 3):
        rows = shown[first : first + 3]
        v_image = np.zeros((*mask.shape, 3), dtype)
        for channel, row in enumerate(rows):
            v_image[..., channel] = mask == ids[row]
        v_dc = renderer.render_vjp(tape, v_image, None).gaussians.sh_dc / SH_C0  # [N, 3]
        votes[rows] = v_dc.T[: len(rows)]
        total += float(v_dc[:, : len(rows)].sum())
    expected = float(output.alpha[np.isin(mask, ids)].sum())
    if abs(total - expected) > ALPHA_TOLERANCE * max(expected, 1.0):
        raise InputError(
            f"renderer {renderer.name} does not blend the colours of its primitives: their weights add up to"
            f" {total:.6g} pixels, and the opacity to {expected:.6g}; segment a run of another recipe"
        )
    return votes


def assign_labels(votes: Votes, bias: float) -> Ints:
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


def label_map(population: Any, labels: Ints, renderer: Renderer, camera: Camera) -> Ints:
    """Return the label [H, W] that each pixel shows: the one whose Gaussians have the largest weight together.

    The rest of a pixel, behind the Gaussians of all labels but 0, is the background's, with label 0.
    """
    found = np.unique(labels[labels > 0])
    sums = np.zeros((1 + len(found), camera.height, camera.width))
    black = Request(np.zeros(3, population.means.dtype))
    for first in range(0, len(found), 3):
        ids = found[first : first + 3]
        colors = np.zeros((len(labels), 3))
        for channel, label in enumerate(ids):
            colors[:, channel] = labels == label
        image = renderer.render(Model(colored(population, colors)), view_from(camera), black)[0].image
        sums[1 + first : 1 + first + len(ids)] = np.moveaxis(image[..., : len(ids)], 2, 0)
    sums[0] = 1 - sums[1:].sum(axis=0)
    return np.concatenate([[0], found])[np.argmax(sums, axis=0)]
