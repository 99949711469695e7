"""The squared change of the image without each Gaussian.

A pixel is linear in the alpha of each of its hits (3DGS equation (3)), so without hit g its colour C changes by exactly
``-q_g = -alpha_g dC/dalpha_g``. With the residual ``r = C - photograph``, the squared error changes by::

    sum of |r - q_g|^2 - |r|^2 = sum of |q_g|^2 - 2 r . q_g          over pixels and channels

The second term is a gradient, that of the squared error with respect to the Gaussian's opacity, times the opacity. At a
minimum it vanishes, and then the first is the whole increase: the saliency of optimal brain damage (LeCun et al. 1990).
In mid-training the gradient is large, and shows what the next steps will correct. So this stage returns the first term.

It is exact for one Gaussian, unless the pixel stops before its last hit: without g it could take some more. It is not
additive: of two Gaussians one behind the other, each alone may be superfluous.
"""

from typing import Any

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.reference.hits import CONIC, Response, Shading, TileHits, tile_hits
from minisplat_ref.types import Floats, Projection, RenderOutput, TileBins


def removal_changes(
    projection: Projection,
    colors: Floats,
    bins: TileBins,
    conventions: Conventions,
    output: RenderOutput,
) -> Floats:
    """Return the squared change of the image without each Gaussian.

    Behind hit g comes the light that the pixel's colour C has besides that of the hits up to g: from other hits, the
    background, a sky. Removing the hit takes its own light away and lets all of B_g through, of which it has let only
    ``1 - alpha_g`` pass::

        B_g = C - sum_{j up to g} w_j c_j
        q_g = w_g c_g - alpha_g / (1 - alpha_g) B_g
        S_g = sum over pixels and channels of q_g^2

    Parameters
    ----------
    projection, colors, bins, conventions
        As for :func:`~minisplat_ref.reference.compositing.composite`.
    output : RenderOutput
        Its result for these inputs; C is its image, to which light from behind all hits may have been added.

    Returns
    -------
    changes : ndarray of shape (N,)
        S, float64, in squared units of the channels; 0 for Gaussians without hits.
    """
    return removal_changes_of_hits(CONIC, projection, colors, bins, conventions, output)


def removal_changes_of_hits(
    response: Response,
    primitives: Any,
    colors: Floats,
    bins: TileBins,
    conventions: Conventions,
    output: RenderOutput,
) -> Floats:
    """Return the squared change of the image without each primitive.

    Parameters
    ----------
    response, primitives, colors, bins, conventions
        As for :func:`~minisplat_ref.reference.compositing.composite_hits`.
    output : RenderOutput
        As for :func:`removal_changes`.

    Returns
    -------
    changes : ndarray of shape (N,)
        As from :func:`removal_changes`.
    """
    changes = np.zeros(len(colors))
    for tile in tile_hits(primitives, bins, conventions, response):
        c = hit_colors(tile, colors, response.shading)  # [G, P, D]
        lights = (tile.alphas * tile.transmittances[:-1])[:, :, None] * c  # w_g c_g
        B = output.image[tile.ys, tile.xs] - np.cumsum(lights, axis=0)
        q = lights - (tile.alphas / (1 - tile.alphas))[:, :, None] * B
        squares = np.sum(q**2, axis=2, dtype=np.float64)  # [G, P]
        changes[tile.ids] += squares.sum(axis=1)
    return changes


def hit_colors(tile: TileHits, colors: Floats, shading: Shading | None) -> Floats:
    """Return the colour of each hit of a tile [G, P, D]; ``colors`` are coefficients where there is a ``shading``."""
    if shading is not None:
        return shading.shade(colors[tile.ids], tile.hit.place)
    return np.broadcast_to(colors[tile.ids][:, None], (*tile.alphas.shape, colors.shape[1]))
