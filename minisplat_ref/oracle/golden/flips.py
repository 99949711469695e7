"""Pixels that rounding decides: a hit at the skip threshold, a transmittance at the stop threshold.

The image jumps there. Two renderers that agree to the last digit but one may differ by a whole hit, so such a pixel
says nothing about either; it is counted, not averaged in.
"""

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.oracle.tolerances import FLIP_ALPHA, FLIP_RELATIVE
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.types import Bools, Projection, TileBins


def flip_candidates(projection: Projection, bins: TileBins, conventions: Conventions) -> Bools:
    """Pixels of which some hit may be taken or left.

    Parameters
    ----------
    projection : Projection
        Footprints, float64.
    bins : TileBins
        The Gaussians of each tile.
    conventions : Conventions
        Its ``alpha_min`` and ``transmittance_min`` are the thresholds.

    Returns
    -------
    ndarray of bool of shape (H, W)
        True where, before the pixel is finished, some alpha is within ``FLIP_ALPHA`` of ``alpha_min``, or some
        transmittance within the part ``FLIP_RELATIVE`` of ``transmittance_min``. Hits outside of a Gaussian's box
        count as well, since the other renderer's box may hold them.
    """
    candidates = np.zeros((bins.grid.height, bins.grid.width), bool)
    for tile in tile_hits(projection, bins, conventions):
        unclamped = tile.hit.unclamped
        alphas = np.where(tile.is_clamped, conventions.alpha_max, unclamped)  # [G, P] whether they count or not
        left = tile.transmittances[:-1] * (1 - alphas)  # T that the pixel would have after the hit
        stops = (alphas >= conventions.alpha_min + FLIP_ALPHA) & (tile.alphas == 0)
        stops &= left <= conventions.transmittance_min * (1 + FLIP_RELATIVE)
        is_open = np.cumsum(stops, axis=0) - stops == 0  # no hit before this one finished the pixel
        is_near = np.abs(alphas - conventions.alpha_min) <= FLIP_ALPHA
        is_near |= np.abs(left / conventions.transmittance_min - 1) <= FLIP_RELATIVE
        candidates[tile.ys, tile.xs] = (is_near & is_open).any(axis=0)
    return candidates
