"""The values of a scene that depend on rounding: pixels at thresholds, and counts and sums over them.

An exact scene leaves nothing to rounding, so nothing is set aside there.
"""

import numpy as np

from minisplat_ref.oracle.golden.format import Golden
from minisplat_ref.oracle.golden.running import projection_of, reference_bins
from minisplat_ref.oracle.thresholds import thresholds
from minisplat_ref.oracle.tolerances import TIE
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.types import Bools

PIXELWISE = ("image", "alpha", "feature_image", "accumulated_depth", "view", "view_alpha")
"""Image arrays that one hit more or less would change."""
BY_GAUSSIAN = ("blend_weight_sum", "blend_weight_max", "hit_count")
"""Gaussian arrays that one hit more or less would change."""


def doubts(truth: Golden) -> dict[str, Bools]:
    """Return, for each array that rounding may change, where it may do so, along the array's first axes.

    Parameters
    ----------
    truth : Golden
        All arrays of the scene.
    """
    a = truth.arrays
    tile_size = tuple(map(int, a["tile_size"]))
    projection = projection_of(a)
    bins = reference_bins(a, truth.conventions, (tile_size[0], tile_size[1]))
    found = thresholds(projection, bins, truth.conventions)
    jumps, ties = found.jumps, found.jumps | _ties(truth)
    medians = found.jumps | found.medians
    if truth.is_exact:
        jumps, ties, medians = (np.zeros_like(mask) for mask in (jumps, ties, medians))
    return {
        **dict.fromkeys(PIXELWISE, jumps),
        "median_depth": medians,
        "dominant_ids": ties,
        **dict.fromkeys(BY_GAUSSIAN, _find_touching(truth, jumps)),
        "dominant_count": _find_touching(truth, ties),
    }


def _ties(truth: Golden) -> Bools:
    """Find the pixels [H, W] whose two largest weights are equal up to rounding."""
    a = truth.arrays
    ties = np.zeros(a["alpha"].shape, bool)
    bins = reference_bins(a, truth.conventions, (int(a["tile_size"][0]), int(a["tile_size"][1])))
    for tile in tile_hits(projection_of(a), bins, truth.conventions):
        if len(tile.ids) > 1:
            weights = np.sort(tile.alphas * tile.transmittances[:-1], axis=0)  # [G, P]
            ties[tile.ys, tile.xs] = (weights[-1] > 0) & (weights[-1] - weights[-2] <= TIE * weights[-1])
    return ties


def _find_touching(truth: Golden, pixels: Bools) -> Bools:
    """Find the Gaussians [N] whose box contains one of these pixels."""
    boxes = truth.arrays["boxes"]
    return np.array([pixels[y0:y1, x0:x1].any() for x0, y0, x1, y1 in boxes], bool).reshape(len(boxes))
