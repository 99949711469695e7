"""Blend statistics of one view from its list of hits, as Mini-Splatting needs them."""

import numpy as np

from minisplat_ref.extensions.rays.types import Hits
from minisplat_ref.types import BlendStats


def blend_stats(hits: Hits, size: tuple[int, int], n: int) -> BlendStats:
    """Return the contribution of each of n Gaussians to a picture.

    Parameters
    ----------
    hits : Hits
        Hits of the picture's rays, row by row.
    size : tuple of 2 ints
        Height and width.
    n : int
        Number of Gaussians.
    """
    ids, rays, weights = hits.gaussian_ids, hits.ray_ids, hits.weights
    largest, dominant_ids = np.zeros(n), np.full(size[0] * size[1], -1, np.int32)
    np.maximum.at(largest, ids, weights)
    heaviest_last = np.lexsort((-np.arange(len(ids)), weights, rays))  # of equals the front-most comes last
    dominant_ids[rays[heaviest_last]] = ids[heaviest_last]
    counts = np.bincount(dominant_ids[dominant_ids >= 0], minlength=n)
    return BlendStats(
        np.bincount(ids, weights, n).astype(np.float64),
        largest,
        np.bincount(ids, minlength=n).astype(np.int32),
        counts.astype(np.int32),
        dominant_ids.reshape(size),
    )
