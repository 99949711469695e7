"""Stage 5a: which Gaussians hit which pixels of a tile, how strongly, and what light is left in front of each hit.

3DGS equations (3) and (4), the volume rendering of Max (1995) with one sample per Gaussian::

    alpha_g = min(alpha_max, o_g exp(-d^T Q_g d / 2)),   d = p_g - pixel centre
    T_g = prod_{j < g} (1 - alpha_j)

A tile is one array with hits g along the rows and pixels along the columns. Skipping a hit is ``alpha_g = 0``, which
changes no product and no sum. Left out: any use of the 3D shape; a Gaussian is a flat ellipse here.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.types import Bools, Floats, Ints, Projection, TileBins


class TileHits(NamedTuple):
    """The hits of G Gaussians on the P pixels of one tile."""

    ids: Ints  # [G] front to back
    ys: Ints  # [P] pixel rows
    xs: Ints  # [P] pixel columns
    offsets: Floats  # [G, P, 2] Gaussian's centre minus pixel's centre, px
    falloffs: Floats  # [G, P] E = exp(-sigma)
    is_clamped: Bools  # [G, P] o E > alpha_max
    alphas: Floats  # [G, P] 0 where there is no hit
    transmittances: Floats  # [G + 1, P] row g is T before hit g, the last row is T_end


def tile_hits(projection: Projection, bins: TileBins, conventions: Conventions) -> Iterator[TileHits]:
    """Evaluate the tiles of an image, one after the other.

    Parameters
    ----------
    projection : Projection
        Footprints and opacities.
    bins : TileBins
        The Gaussians of each tile, nearest first.
    conventions : Conventions
        Clamp, skip and stop thresholds.

    Yields
    ------
    TileHits
        One per tile, in row-major order.
    """
    grid, dtype = bins.grid, projection.means2d.dtype
    for t in range(grid.n_tiles_x * grid.n_tiles_y):
        ids = bins.gaussian_ids[bins.tile_offsets[t] : bins.tile_offsets[t + 1]]
        x, y = t % grid.n_tiles_x * grid.tile_width, t // grid.n_tiles_x * grid.tile_height
        columns = np.arange(x, min(x + grid.tile_width, grid.width))
        rows = np.arange(y, min(y + grid.tile_height, grid.height))
        ys, xs = (index.ravel() for index in np.meshgrid(rows, columns, indexing="ij"))

        centers = np.stack([xs, ys], axis=1).astype(dtype) + dtype.type(0.5)  # [P, 2]
        offsets = projection.means2d[ids, None] - centers  # [G, P, 2]
        sigmas = np.einsum("gpi,gij,gpj->gp", offsets, conic_matrices(projection.conics[ids]), offsets) / 2
        falloffs = np.exp(-np.maximum(sigmas, 0))
        unclamped = projection.opacities[ids, None] * falloffs
        alphas = np.minimum(conventions.alpha_max, unclamped)

        x0, y0, x1, y1 = projection.boxes[ids, :, None].swapaxes(0, 1)  # [G, 1] each
        is_hit = (x0 <= xs) & (xs < x1) & (y0 <= ys) & (ys < y1)
        is_hit &= (sigmas >= 0) & (alphas >= conventions.alpha_min)  # a negative square is a rounding error
        alphas = np.where(is_hit, alphas, 0)
        # T never rises, so once a hit would take it below the threshold, that hit and all behind it are left out.
        alphas = np.where(goes_on(_transmittances(alphas)[1:], conventions), alphas, 0)
        yield TileHits(
            ids, ys, xs, offsets, falloffs, unclamped > conventions.alpha_max, alphas, _transmittances(alphas)
        )


def _transmittances(alphas: Floats) -> Floats:
    """T before each of G hits and after the last, [G + 1, P]: the running product of ``1 - alpha``."""
    ones = np.ones_like(alphas, shape=(1, alphas.shape[1]))
    return np.cumprod(np.concatenate([ones, 1 - alphas]), axis=0)


def goes_on(transmittances: Floats, conventions: Conventions) -> Bools:
    """Whether a pixel takes the hit that would leave it with ``transmittances``; ``conventions`` set the bound."""
    if conventions.stops_at_equality:
        return transmittances > conventions.transmittance_min
    return transmittances >= conventions.transmittance_min


def conic_matrices(conics: Floats) -> Floats:
    """[[a, b], [b, c]] of ``conics`` (a, b, c) [G, 3]."""
    return conics[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
