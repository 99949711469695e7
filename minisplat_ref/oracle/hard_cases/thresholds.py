"""Pixels that stand on a threshold, where a rounding error decides whether a hit counts.

Alpha is compared with ``alpha_min`` and ``alpha_max``, the transmittance with ``transmittance_min``; the image or its
gradient jumps there. Such pixels are counted by themselves: averaged in they would hide an error, left out they would
hide themselves.
"""

import numpy as np

from minisplat_ref.constants import MEDIAN_TRANSMITTANCE
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.splatting import SplatTape
from minisplat_ref.types import Bools

ALPHA_MARGIN = 1e-6  # relative: some roundings of 6e-8 in sigma and in the exponential
# 1 - 0.99 is 1e-6 off in float32, because 0.99 is rounded at its own size; a pixel can take several such hits.
TRANSMITTANCE_MARGIN = 1e-5


def pixels_at_thresholds(tape: SplatTape) -> Bools:
    """Return [H, W] True where a hit's alpha or what it leaves is so near to a bound that float32 may decide otherwise.

    Parameters
    ----------
    tape : SplatTape
        A view in float64.
    """
    conventions, grid = tape.conventions, tape.bins.grid
    is_near = np.zeros((grid.height, grid.width), dtype=bool)
    for tile in tile_hits(tape.projection, tape.bins, conventions):
        unclamped = tile.hit.unclamped  # [G, P]
        alphas = np.where(unclamped < conventions.alpha_min, 0, np.minimum(unclamped, conventions.alpha_max))
        after = tile.transmittances[:-1] * (1 - alphas)
        hits = _is_near(unclamped, conventions.alpha_min, ALPHA_MARGIN)
        hits |= _is_near(unclamped, conventions.alpha_max, ALPHA_MARGIN)
        hits |= _is_near(after, conventions.transmittance_min, TRANSMITTANCE_MARGIN)
        hits |= _is_near(after, MEDIAN_TRANSMITTANCE, ALPHA_MARGIN)
        is_open = tile.transmittances[:-1] > conventions.transmittance_min  # behind, nothing is looked at any more
        is_near[tile.ys, tile.xs] = (hits & is_open).any(axis=0)
    return is_near


def jump_max(tape: SplatTape) -> float:
    """Return the largest weight that one hit on a threshold can gain or lose."""
    c = tape.conventions
    return max(c.alpha_min, c.transmittance_min / (1 - c.alpha_max)) * (1 + TRANSMITTANCE_MARGIN)


def _is_near(values: np.ndarray, bound: float, margin: float) -> Bools:
    return np.abs(values - bound) <= margin * bound
