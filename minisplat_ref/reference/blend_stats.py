"""Statistics of blending: the contribution of each primitive, the dominant one of a pixel, and the median depth.

Mini-Splatting and Mini-Splatting2 choose by them the Gaussians that are split and those that stay.
"""

import numpy as np

from minisplat_ref.constants import MEDIAN_TRANSMITTANCE
from minisplat_ref.reference.hits import TileHits
from minisplat_ref.types import BlendStats, Floats, Ints


def empty_stats(n: int, shape: tuple[int, int], dtype: np.dtype) -> BlendStats:
    """Return the statistics of n primitives without hits, for an image of ``shape`` (H, W); weights have the dtype."""
    counts, dominant_ids = np.zeros(n, np.int32), np.full(shape, -1, np.int32)
    return BlendStats(np.zeros(n, dtype), np.zeros(n, dtype), counts, counts.copy(), dominant_ids)


def add_tile_stats(stats: BlendStats, tile: TileHits, weights: Floats, heaviest: Ints) -> None:
    """Add the hits of a tile to the statistics.

    Parameters
    ----------
    stats : BlendStats
        Is changed.
    tile : TileHits
        G hits, at least one, on P pixels.
    weights : ndarray of shape (G, P)
        ``alpha_g T_g``.
    heaviest : ndarray of shape (P,)
        Row of the largest weight of each pixel; of equals that in front.
    """
    ids = tile.ids
    stats.blend_weight_sum[ids] += weights.sum(axis=1)
    stats.blend_weight_max[ids] = np.maximum(stats.blend_weight_max[ids], weights.max(axis=1))
    stats.hit_count[ids] += (weights > 0).sum(axis=1, dtype=np.int32)
    dominant = np.where(weights.max(axis=0) > 0, ids[heaviest], -1)
    stats.dominant_ids[tile.ys, tile.xs] = dominant
    np.add.at(stats.dominant_count, dominant[dominant >= 0], 1)


def median_depths(tile: TileHits) -> Floats:
    """Return the depth [P] of the hit that takes each pixel of a tile below T = 1/2; 0 where none does."""
    T = tile.transmittances[:-1]  # [G, P]
    is_median = (T >= MEDIAN_TRANSMITTANCE) & (T * (1 - tile.alphas) < MEDIAN_TRANSMITTANCE)
    depths: Floats = np.where(is_median, tile.hit.depths, 0).sum(axis=0)
    return depths
