"""Pixels at a threshold: where rounding decides whether a hit counts, and how much it decides about.

A renderer is full of comparisons, and its image or its gradient jumps at each of them:

=========  ==================================================================  =================
threshold  what is compared                                                    what jumps
=========  ==================================================================  =================
skip       a hit's alpha with ``alpha_min``: below, the hit does not count     image, gradient
stop       the transmittance behind a hit with ``transmittance_min``: the      image, gradient
           hit and all behind it do not count
order      the depths of two neighbours in a tile's list: which is blended     image, gradient
           first
clamp      a hit's alpha with ``alpha_max``: above, it has no gradient         gradient
median     the transmittance behind a hit with one half: whose depth is the    median depth
           median depth
=========  ==================================================================  =================

Two correct renderers that round differently disagree at such pixels by a whole hit, and no precision but the other
one's own mends that. The pixels are found here, in float64, and set aside by whoever compares: counted, not averaged
into an error of arithmetic, and not excused beyond what the hits at their thresholds can change. How near is near
enough depends on what rounds: see :class:`Margins`.

Left out: the border of a footprint's box. A hit near ``alpha_min`` counts as one inside and outside of it, since
another renderer's box may hold it.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.backends import CPU
from minisplat_ref.constants import MEDIAN_TRANSMITTANCE, Conventions
from minisplat_ref.oracle.tolerances import FLOAT32_RENDERER, Margins
from minisplat_ref.reference.hits import TileHits, tile_hits
from minisplat_ref.splatting import SplatTape
from minisplat_ref.types import Bools, Floats, Projection, TileBins, TileGrid


class Thresholds(NamedTuple):
    """What the thresholds can do to each pixel."""

    allowance: Floats
    """[H, W] bound of the change of any channel when hits at thresholds fall on the other side; mostly 0."""
    jumps: Bools
    """[H, W] whether the image may jump, and its gradient with it: skip, stop, order."""
    kinks: Bools
    """[H, W] whether the gradient alone may jump: clamp."""
    medians: Bools
    """[H, W] whether the median depth may jump."""

    @property
    def is_near(self) -> Bools:
        """[H, W] whether a hit stands at a threshold of the image or of the gradient."""
        return self.jumps | self.kinks


class _OfTile(NamedTuple):
    """The same for the P pixels of one tile."""

    change: Floats  # [P] weight that may come or go
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
        The Gaussians of each tile. A Gaussian that is not listed is not looked at.
    conventions : Conventions
        The thresholds.
    margins : Margins
        How near is near enough.
    slack : float
        Relative error of alphas beyond what the margins stand for, as of a polynomial exponential.
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
            of_tile = _of_tile(tile, projection, conventions, margins, slack)
            found.allowance[tile.ys, tile.xs] = span * of_tile.change
            found.jumps[tile.ys, tile.xs] = of_tile.jumps
            found.kinks[tile.ys, tile.xs] = of_tile.kinks
            found.medians[tile.ys, tile.xs] = of_tile.medians
    return found


def thresholds_of_view(tape: SplatTape, slack: float = 0.0) -> Thresholds:
    """Find the pixels at a threshold of any float32 renderer, of a view that was drawn in float64.

    The Gaussians are projected and listed once more, so that those are looked at, too, whose peak is just below
    ``alpha_min``, and their boxes reach as far as a hit that is nearly one.

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
    highest = max(tape.channels.max(initial=0), tape.background.max(initial=0))
    lowest = min(tape.channels.min(initial=0), tape.background.min(initial=0))
    return thresholds(projection, bins, conventions, slack=slack, span=highest - lowest)


def lenient_conventions(conventions: Conventions, margins: Margins, slack: float = 0.0) -> Conventions:
    """Conventions under which every hit that may count does: skipped a little later, and never stopped."""
    alpha_min = conventions.alpha_min - (margins.skip + slack) * conventions.alpha_min
    return conventions._replace(alpha_min=alpha_min, transmittance_min=0.0)


def _of_tile(
    tile: TileHits, projection: Projection, conventions: Conventions, margins: Margins, slack: float
) -> _OfTile:
    """Look at every hit of a tile; the rows of the arrays are its G hits, front to back, the columns its P pixels."""
    alpha_min, stop = conventions.alpha_min, conventions.transmittance_min
    margin = (margins.skip + slack) * alpha_min
    unclamped = tile.hit.unclamped  # [G, P] whether they count or not
    depths = projection.depths[tile.ids, None]  # [G, 1]
    is_skip = np.abs(np.minimum(unclamped, conventions.alpha_max) - alpha_min) <= margin
    alphas = np.where(tile.alphas < alpha_min, 0, tile.alphas)
    T = np.cumprod(np.concatenate([np.ones((1, alphas.shape[1])), 1 - alphas]), axis=0)  # [G + 1, P]
    before, after = T[:-1], T[1:]
    # Relative doubt about the transmittance: d ln(1 - alpha) = alpha / (1 - alpha) times the relative error of alpha.
    doubt = margins.stop + np.cumsum(2 * alpha_min * is_skip + slack * alphas / (1 - alphas), axis=0)
    is_open = before > stop * (1 - doubt)  # behind what surely stops, nothing is looked at any more
    is_stop = is_open & (tile.alphas > 0) & (np.abs(after - stop) <= stop * doubt)
    gaps = np.diff(depths, axis=0, append=np.inf)
    is_tie = (gaps > 0) & (gaps < margins.order * depths)  # of exactly equal ones the lower row is first
    behind = np.concatenate([alphas[1:], np.zeros_like(alphas[:1])])  # alpha of the next in the list
    is_clamp = is_open & (np.abs(unclamped - conventions.alpha_max) <= margins.clamp * conventions.alpha_max)
    is_median = is_open & (np.abs(after - MEDIAN_TRANSMITTANCE) <= margins.median * MEDIAN_TRANSMITTANCE)
    change = np.where(is_skip & is_open, before * (alpha_min + margin), 0).sum(axis=0)
    change += np.where(is_tie & is_open, before * alphas * behind, 0).sum(axis=0)
    change += np.where(is_stop, before, 0).max(axis=0)  # all that lies at and behind the hit that may stop
    return _OfTile(change, change > 0, np.logical_or.reduce(is_clamp, axis=0), np.logical_or.reduce(is_median, axis=0))
