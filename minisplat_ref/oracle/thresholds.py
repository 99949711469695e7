"""Pixels at a threshold, where rounding decides whether a hit counts or which of two is in front, and the effect.

A renderer is full of comparisons, and its image or its gradient jumps at each of them:

=========  ==================================================================  =================
threshold  what is compared                                                    what jumps
=========  ==================================================================  =================
skip       a hit's alpha with ``alpha_min``: below, the hit does not count     image, gradient
stop       the transmittance behind a hit with ``transmittance_min``: the      image, gradient
           hit and all behind it do not count
order      the depths of two hits of a pixel: which is blended first           image, gradient
clamp      a hit's alpha with ``alpha_max``: above, it has no gradient         gradient
median     the transmittance behind a hit with one half: whose depth is the    median depth
           median depth
=========  ==================================================================  =================

Two correct renderers that round differently disagree at such pixels by a whole hit, and higher precision does not help.
The pixels are found here, in float64, and comparisons set them aside: they are counted, not averaged into the
arithmetic error, and excused only as far as the hits at their thresholds can change them. The margin within which a
value counts as near depends on the rounding: see :class:`Margins`.

Order is the threshold that can change a whole image. All Gaussians of a wall that a camera faces squarely have the same
depth; if the camera is rotated against the world's axes, rounding the means spreads these depths by a relative 1e-8,
and float64 sorts by that noise. In float32 they are equal, and the order of the rows decides: neither order is wrong.
Our float32 kernels compute depths in float64 and sort them rounded, as other float32 renderers do. Sorting them
unrounded would agree with the reference here, but with no other renderer, for an order that is noise; tile lists would
take 18 to 31 % longer (processor time of one thread, 13,000 to 200,000 Gaussians).

Left out: the border of a footprint's box. A hit near ``alpha_min`` counts inside and outside of it, since another
renderer's box may contain it.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import MEDIAN_TRANSMITTANCE, Conventions
from minisplat_ref.oracle.tolerances import FLOAT32_RENDERER, Margins
from minisplat_ref.reference.hits import TileHits, conic_matrices, tile_hits
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.rendering.splatting import SplatTape
from minisplat_ref.types import Bools, Floats, Projection, TileBins, TileGrid


class Thresholds(NamedTuple):
    """The possible effects of the thresholds on each pixel."""

    allowance: Floats
    """[H, W] upper bound of the change of any channel if hits at thresholds fall on the other side; mostly 0."""
    jumps: Bools
    """[H, W] whether the image may jump, and its gradient with it: skip, stop, order."""
    kinks: Bools
    """[H, W] whether the gradient alone may jump: clamp."""
    medians: Bools
    """[H, W] whether the median depth may jump."""

    @property
    def is_near(self) -> Bools:
        """[H, W] whether a hit is at a threshold of the image or of the gradient."""
        return self.jumps | self.kinks


class _OfTile(NamedTuple):
    """The same for the P pixels of one tile."""

    change: Floats  # [P] weight that may be added or lost
    jumps: Bools  # [P]
    kinks: Bools  # [P]
    medians: Bools  # [P]


def thresholds(
    projection: Projection,
    bins: TileBins,
    conventions: Conventions,
    margins: Margins = FLOAT32_RENDERER,
    *,
    slack: float = 0.0,
    span: float = 1.0,
) -> Thresholds:
    """Find the pixels at a threshold.

    Parameters
    ----------
    projection : Projection
        Footprints, float64.
    bins : TileBins
        The Gaussians of each tile. A Gaussian that is not listed is not examined.
    conventions : Conventions
        The thresholds.
    margins : Margins
        How near is near enough.
    slack : float
        Relative error of alphas beyond the margins, such as that of a polynomial exponential.
    span : float
        Largest difference of two colours, for the allowance.

    Returns
    -------
    Thresholds
    """
    # Hits just below alpha_min are hits here, and no pixel is ever finished: the true thresholds are applied below.
    lenient = lenient_conventions(conventions, margins, slack)
    shape = bins.grid.height, bins.grid.width
    found = Thresholds(np.zeros(shape), np.zeros(shape, bool), np.zeros(shape, bool), np.zeros(shape, bool))
    for tile in tile_hits(projection, bins, lenient):
        if len(tile.ids):
            of_tile = _examine_tile(tile, projection, conventions, margins, slack)
            found.allowance[tile.ys, tile.xs] = span * of_tile.change
            found.jumps[tile.ys, tile.xs] = of_tile.jumps
            found.kinks[tile.ys, tile.xs] = of_tile.kinks
            found.medians[tile.ys, tile.xs] = of_tile.medians
    return found


def thresholds_of_view(tape: SplatTape, slack: float = 0.0) -> Thresholds:
    """Find the pixels at a threshold of any float32 renderer, for a view that was rendered in float64.

    The Gaussians are projected and listed once more, to include those whose peak is just below ``alpha_min``, and so
    that boxes extend to all pixels that are nearly hit.

    Parameters
    ----------
    tape : SplatTape
        Of the view.
    slack : float
        As for :func:`thresholds`.

    Returns
    -------
    Thresholds
        The allowance is in the units of the view's channels.
    """
    camera, conventions = tape.camera, tape.conventions
    lenient = lenient_conventions(conventions, FLOAT32_RENDERER, slack)
    projection = CPU.project(*tape.primitives, camera, lenient)
    grid = TileGrid(camera.width, camera.height, CPU.tile_width, CPU.tile_height)
    bins = CPU.bin_gaussians(projection, grid, lenient)
    return thresholds(projection, bins, conventions, slack=slack, span=span_of(tape))


def span_of(tape: SplatTape) -> float:
    """Return the largest difference of two colours of a view, of its background and of 0."""
    highest = max(tape.channels.max(initial=0), tape.background.max(initial=0))
    lowest = min(tape.channels.min(initial=0), tape.background.min(initial=0))
    return float(highest - lowest)


def lenient_conventions(conventions: Conventions, margins: Margins, slack: float = 0.0) -> Conventions:
    """Return conventions under which every hit that may count does: a lower skip threshold and no stop."""
    of_places = 1e5 * margins.place  # at 17,000 pixels, where alpha changes by up to 6 of itself a pixel
    alpha_min = conventions.alpha_min - (margins.skip + slack + of_places) * conventions.alpha_min
    return conventions._replace(alpha_min=alpha_min, transmittance_min=0.0)


def _examine_tile(
    tile: TileHits, projection: Projection, conventions: Conventions, margins: Margins, slack: float
) -> _OfTile:
    """Examine every hit of a tile; the rows of the arrays are its G hits, front to back, the columns its P pixels."""
    alpha_min, stop = conventions.alpha_min, conventions.transmittance_min
    unclamped = tile.hit.unclamped  # [G, P] whether they count or not
    rough = slack + margins.place * _change_by_place(tile, projection)  # [G, P] relative doubt about alphas
    margin = (margins.skip + rough) * alpha_min
    is_skip = np.abs(np.minimum(unclamped, conventions.alpha_max) - alpha_min) <= margin
    alphas = np.where(tile.alphas < alpha_min, 0, tile.alphas)
    T = np.cumprod(np.concatenate([np.ones((1, alphas.shape[1])), 1 - alphas]), axis=0)  # [G + 1, P]
    before, after = T[:-1], T[1:]
    # Relative doubt about the transmittance: d ln(1 - alpha) = alpha / (1 - alpha) times the relative error of alpha.
    doubt = margins.stop + np.cumsum(2 * alpha_min * is_skip + rough * alphas / (1 - alphas), axis=0)
    is_open = before > stop * (1 - doubt)  # hits behind a certain stop are ignored
    hits = np.where((alphas > 0) | is_skip, tile.alphas, 0)  # those that count, or may
    is_stop = is_open & (hits > 0) & (np.abs(after - stop) <= stop * doubt)
    is_clamp = is_open & (np.abs(unclamped - conventions.alpha_max) <= margins.clamp * conventions.alpha_max)
    is_median = is_open & (np.abs(after - MEDIAN_TRANSMITTANCE) <= margins.median * MEDIAN_TRANSMITTANCE)
    change = np.where(is_skip & is_open, before * (alpha_min + margin), 0).sum(axis=0)
    change += _change_by_order(projection.depths[tile.ids, None], hits, before, stop * (1 + doubt), margins)
    change += np.where(is_stop, before, 0).max(axis=0)  # all that lies at and behind the hit that may stop
    return _OfTile(change, change > 0, np.logical_or.reduce(is_clamp, axis=0), np.logical_or.reduce(is_median, axis=0))


def _change_by_place(tile: TileHits, projection: Projection) -> Floats:
    """Return the relative change [G, P] of each alpha per relative rounding of coordinates.

    It is sum_k |(Q d)_k| (|p_k| + |d_k|): the derivative of ln alpha with respect to the centre p is Q d up to its
    sign, and both p and its offset d from the pixel are rounded.
    """
    offsets: Floats = tile.hit.place.offsets  # [G, P, 2]
    slopes = np.einsum("gij,gpj->gpi", conic_matrices(projection.conics[tile.ids]), offsets)
    change = np.sum(np.abs(slopes) * (np.abs(projection.means2d[tile.ids, None]) + np.abs(offsets)), axis=2)
    return np.where(tile.hit.unclamped > 0, change, 0)


def _change_by_order(depths: Floats, alphas: Floats, before: Floats, stop: Floats, margins: Margins) -> Floats:
    """Return the weight [P] that moves between hits that may be blended in another order.

    Hits of a pixel that rounding may exchange form a group: each is close enough behind the one before it. With T in
    front of the group, exchanging two neighbours moves at most ``T alpha_i alpha_j``, and exchanging each pair at most
    once reaches any order; exactly equal depths are no pair, since then the lower row is first. A group moves at most
    T, and all of T if the pixel may end within the group, at another of its hits.

    Parameters
    ----------
    depths : ndarray of shape (G, 1)
        Front to back.
    alphas : ndarray of shape (G, P)
        0 where there is no hit.
    before : ndarray of shape (G, P)
        Transmittance in front of each hit, as if no pixel ended.
    stop : ndarray of shape (G, P)
        The transmittance at which a pixel may have ended.
    margins : Margins
    """
    is_hit = alphas > 0
    last = np.maximum.accumulate(np.where(is_hit, depths, -np.inf), axis=0)
    previous = np.concatenate([np.full_like(last[:1], -np.inf), last[:-1]])  # [G, P] depth of the hit before
    is_one = depths.astype(np.float32) == previous.astype(np.float32)
    is_near = is_hit & ((depths - previous < margins.order * depths) | is_one)
    is_first = is_hit & ~is_near  # of its group
    in_front = np.minimum.accumulate(np.where(is_first, before, 1), axis=0)  # of the group
    nearest = np.maximum.accumulate(np.where(is_first, depths, -np.inf), axis=0)
    total = np.cumsum(alphas, axis=0)
    of_group = total - alphas - np.maximum.accumulate(np.where(is_first, total - alphas, 0), axis=0)  # before this hit
    may_pass = is_near & (depths > nearest) & (in_front > stop)
    most = np.where(may_pass, in_front, 0).max(axis=0)
    ends = (may_pass & (before * (1 - alphas) <= stop)).any(axis=0)
    return np.where(ends, most, np.minimum(np.where(may_pass, in_front * alphas * of_group, 0).sum(axis=0), most))
