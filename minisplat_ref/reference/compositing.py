"""Stage 5: blend sorted Gaussians into pixels, front to back, and carry a pixel's derivative back to them.

This is 3DGS equation (3) with the hits of :mod:`hits`, each of weight ``w_g = alpha_g T_g``::

    image = sum_g w_g c_g + T_end background,   alpha = 1 - T_end = sum_g w_g

``blend_tile`` is this equation for the pixels of a tile, and ``composite`` for an image. ``composite_hits`` is the same
for any :class:`~minisplat_ref.reference.hits.Response`.
"""

from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.reference.blend_stats import add_tile_stats, empty_stats, median_depths
from minisplat_ref.reference.hits import CONIC, Response, Shading, TileHits, is_accepted, tile_hits
from minisplat_ref.types import (
    BlendGradient,
    CompositeGradient,
    Floats,
    Projection,
    RenderOutput,
    TileBins,
)


def blend_tile(
    tile: TileHits, colors: Floats, background: Floats, shading: Shading | None = None
) -> tuple[Floats, Floats, Floats]:
    """Blend the hits of a tile; this is 3DGS equation (3).

    Parameters
    ----------
    tile : TileHits
        G hits on P pixels.
    colors : ndarray of shape (N, S)
        D channels of each primitive, or the coefficients from which ``shading`` computes them.
    background : ndarray of shape (D,)
        Seen through the transmittance that is left.
    shading : Shading, optional
        Of primitives whose colours vary.

    Returns
    -------
    image : ndarray of shape (P, D)
        Colours of the pixels.
    alpha : ndarray of shape (P,)
        Accumulated opacity.
    weights : ndarray of shape (G, P)
        w.
    """
    T, T_end = tile.transmittances[:-1], tile.transmittances[-1]  # [G, P], [P]
    weights = tile.alphas * T  # [G, P]
    if shading is None:
        light = weights.T @ colors[tile.ids]  # [P, D]
    else:
        light = np.einsum("gp,gpd->pd", weights, shading.shade(colors[tile.ids], tile.hit.place))
    image = light + T_end[:, None] * background
    alpha = 1 - T_end
    return image, alpha, weights


class TileGradient(NamedTuple):
    """Gradient of :func:`blend_tile`."""

    alphas: Floats  # [G, P] 0 where there is no hit
    colors: Floats  # [G, S]
    place: Any  # of the hits, None without a shading
    background: Floats  # [D]


def blend_tile_vjp(
    tile: TileHits,
    colors: Floats,
    background: Floats,
    shading: Shading | None,
    v_image: Floats,
    v_alpha: Floats,
) -> TileGradient:
    """Gradient of :func:`blend_tile` with respect to its inputs.

    For one pixel with ``v = v_image``: alpha is ``1 - T_end``, so the derivative with respect to ``T_end`` is
    ``v . background - v_alpha``. A hit contributes ``alpha_g T_g c_g`` and multiplies everything behind it by
    ``1 - alpha_g``, therefore::

        v_c_g        = w_g v
        v_background = T_end v
        behind_g     = sum_{j behind g} w_j (c_j . v) + T_end (v . background - v_alpha)
        v_alpha_g    = T_g (c_g . v) - behind_g / (1 - alpha_g)

    Parameters
    ----------
    tile, colors, background, shading
        As for the forward function.
    v_image : ndarray of shape (P, D)
        Derivative with respect to the colours of the pixels.
    v_alpha : ndarray of shape (P,)
        Derivative with respect to the accumulated opacity.
    """
    alphas, T, T_end = tile.alphas, tile.transmittances[:-1], tile.transmittances[-1]
    weights = alphas * T  # [G, P]
    v_c, v_dot_c, v_place = light_gradient(tile, weights, colors, shading, v_image)
    v_T_end = v_image @ background - v_alpha  # [P]
    behind = _suffix_sums(weights * v_dot_c) + T_end * v_T_end  # [G, P]
    v_alphas = np.where(alphas > 0, T * v_dot_c - behind / (1 - alphas), 0)
    return TileGradient(v_alphas, v_c, v_place, T_end @ v_image)


def light_gradient(
    tile: TileHits, weights: Floats, colors: Floats, shading: Shading | None, v: Floats
) -> tuple[Floats, Floats, Any]:
    """Return the gradient of ``sum_g w_g c_g`` with respect to colours [G, S], weights [G, P] and places.

    ::

        v_c_g = w_g v,   v_w_g = c_g . v

    Parameters
    ----------
    tile, colors, shading
        As for :func:`blend_tile`.
    weights : ndarray of shape (G, P)
        w.
    v : ndarray of shape (P, D)
        Derivative with respect to the sums.
    """
    c = colors[tile.ids]  # [G, S]
    if shading is None:
        return weights @ v, c @ v.T, None
    v_c, v_place = shading.shade_vjp(c, tile.hit.place, weights[:, :, None] * v)
    return v_c, np.einsum("gpd,pd->gp", shading.shade(c, tile.hit.place), v), v_place


def composite_hits(
    response: Response,
    primitives: Any,
    colors: Floats,
    background: Floats,
    bins: TileBins,
    conventions: Conventions,
    *,
    with_stats: bool = False,
    with_median_depth: bool = False,
) -> RenderOutput:
    """Blend the primitives of every tile, front to back.

    Parameters
    ----------
    response : Response
        What a primitive does to a pixel.
    primitives : NamedTuple
        What ``response`` takes.
    colors : ndarray of shape (N, S)
        D channels, or the coefficients from which the response's shading computes them.
    background : ndarray of shape (D,)
        Seen through the transmittance that is left.
    bins : TileBins
        The primitives of each tile, nearest first.
    conventions : Conventions
        Clamp, skip and stop thresholds.
    with_stats, with_median_depth : bool
        As for :func:`composite`.

    Returns
    -------
    RenderOutput
        Image [H, W, D] and alpha [H, W], and the requested results.
    """
    output = empty_output(colors, background, bins, with_stats, with_median_depth)
    for tile in tile_hits(primitives, bins, conventions, response):
        pixels = tile.ys, tile.xs
        output.image[pixels], output.alpha[pixels], weights = blend_tile(tile, colors, background, response.shading)
        if output.median_depth is not None:
            output.median_depth[pixels] = median_depths(tile)
        if output.stats is not None and len(tile.ids):
            heaviest = np.argmax(weights, axis=0)  # of equals the first, which is in front
            add_tile_stats(output.stats, tile, weights, heaviest)
    return output


def composite_hits_vjp(
    response: Response,
    primitives: Any,
    colors: Floats,
    background: Floats,
    bins: TileBins,
    conventions: Conventions,
    output: RenderOutput,
    v_output: tuple[Floats, Floats],
) -> BlendGradient:
    """Gradient of :func:`composite_hits` with respect to its inputs.

    It is that of :func:`blend_tile`, summed over the tiles: ``v_c_g = sum over pixels of w_g v``. The skip, the stop
    and the order are treated as fixed: the image jumps there and has no derivative.

    Parameters
    ----------
    response, primitives, colors, background, bins, conventions
        As for the forward function.
    output : RenderOutput
        Its result for these inputs. Not needed here: kernels start from its alpha.
    v_output : tuple of ndarray
        Derivatives with respect to the image [H, W, D] and the accumulated opacity [H, W].

    Returns
    -------
    BlendGradient
        Zeros for primitives without hits.
    """
    v_image, v_alpha = v_output
    sums = BlendGradient(
        primitives=tuple(np.zeros_like(getattr(primitives, name)) for name in response.fields),
        colors=np.zeros_like(colors),
        background=np.zeros_like(background),
    )
    for tile in tile_hits(primitives, bins, conventions, response):
        pixels = tile.ys, tile.xs
        v = blend_tile_vjp(tile, colors, background, response.shading, v_image[pixels], v_alpha[pixels])
        add_tile_gradient(sums, response, primitives, tile, conventions, v)
    return sums


def composite(
    projection: Projection,
    colors: Floats,
    background: Floats,
    bins: TileBins,
    conventions: Conventions,
    *,
    with_stats: bool = False,
    with_median_depth: bool = False,
) -> RenderOutput:
    """Blend the Gaussians of every tile, front to back.

    Parameters
    ----------
    projection : Projection
        Footprints, opacities and depths.
    colors : ndarray of shape (N, D)
        Any number of channels, including none.
    background : ndarray of shape (D,)
        Seen through the transmittance that is left.
    bins : TileBins
        The Gaussians of each tile, nearest first.
    conventions : Conventions
        Clamp, skip and stop thresholds.
    with_stats : bool
        Also collect :class:`BlendStats`.
    with_median_depth : bool
        Also return the depth at which the transmittance falls below one half.

    Returns
    -------
    RenderOutput
        Image [H, W, D] and alpha [H, W], and the requested results.
    """
    return composite_hits(
        CONIC,
        projection,
        colors,
        background,
        bins,
        conventions,
        with_stats=with_stats,
        with_median_depth=with_median_depth,
    )


def composite_vjp(
    projection: Projection,
    colors: Floats,
    background: Floats,
    bins: TileBins,
    conventions: Conventions,
    output: RenderOutput,
    v_image: Floats,
    v_alpha: Floats,
) -> CompositeGradient:
    """Gradient of :func:`composite` with respect to its inputs.

    ::

        v_projection, v_colors, v_background = those of :func:`composite_hits_vjp`

    Parameters
    ----------
    projection, colors, background, bins, conventions
        As for :func:`composite`.
    output : RenderOutput
        Its result for these inputs. Not needed here: kernels start from its alpha.
    v_image : ndarray of shape (H, W, D)
        Derivative with respect to the image.
    v_alpha : ndarray of shape (H, W)
        Derivative with respect to the accumulated opacity.

    Returns
    -------
    CompositeGradient
        Zeros for Gaussians without hits.
    """
    v = composite_hits_vjp(CONIC, projection, colors, background, bins, conventions, output, (v_image, v_alpha))
    v_means2d, v_conics, v_opacities = v.primitives
    return CompositeGradient(v_means2d, v_conics, v_opacities, v.colors, v.background)


def composite_all_pairs(
    projection: Projection, colors: Floats, background: Floats, width: int, height: int, conventions: Conventions
) -> tuple[Floats, Floats]:
    """Blend by 3DGS's recursion over all Gaussians, without tiles or cumulative products, to check :func:`composite`.

    Every pixel carries its transmittance T and whether it is finished. For each Gaussian from near to far::

        image <- image + T alpha c,   T <- T (1 - alpha)

    Parameters
    ----------
    projection, colors, background, conventions
        As for :func:`composite`.
    width, height : int
        Size of the image.

    Returns
    -------
    image : ndarray of shape (H, W, D)
        As from :func:`composite`.
    alpha : ndarray of shape (H, W)
        As from :func:`composite`.
    """
    ys, xs = np.mgrid[:height, :width]
    T = np.ones((height, width), dtype=projection.means2d.dtype)
    image = np.zeros((height, width, len(background)), dtype=T.dtype)
    is_open = np.ones((height, width), dtype=bool)
    for g in np.argsort(projection.depths, kind="stable"):
        x0, y0, x1, y1 = projection.boxes[g]
        a, b, c = projection.conics[g]
        dx = projection.means2d[g, 0] - (xs + 0.5).astype(T.dtype)
        dy = projection.means2d[g, 1] - (ys + 0.5).astype(T.dtype)
        sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        alpha = np.minimum(conventions.alpha_max, projection.opacities[g] * np.exp(-np.maximum(sigma, 0)))
        is_hit = (x0 <= xs) & (xs < x1) & (y0 <= ys) & (ys < y1)
        is_hit &= (sigma >= 0) & (alpha >= conventions.alpha_min)
        is_open &= ~(is_hit & ~is_accepted(T * (1 - alpha), conventions))
        alpha = np.where(is_hit & is_open, alpha, 0)
        image += (T * alpha)[:, :, None] * colors[g]
        T = T * (1 - alpha)
    return image + T[:, :, None] * background, 1 - T


def empty_output(
    colors: Floats, background: Floats, bins: TileBins, with_stats: bool, with_median_depth: bool
) -> RenderOutput:
    """Return arrays for the image, alpha and the requested results, which are filled tile by tile.

    Parameters
    ----------
    colors, background, bins, with_stats, with_median_depth
        As for :func:`composite_hits`; read for their sizes and dtypes.
    """
    shape, dtype = (bins.grid.height, bins.grid.width), colors.dtype
    image, alpha = np.empty((*shape, len(background)), dtype), np.empty(shape, dtype)
    median_depth = np.zeros(shape, dtype) if with_median_depth else None
    return RenderOutput(image, alpha, median_depth, empty_stats(len(colors), shape, dtype) if with_stats else None)


def add_tile_gradient(
    sums: BlendGradient,
    response: Response,
    primitives: Any,
    tile: TileHits,
    conventions: Conventions,
    v: TileGradient,
) -> None:
    """Add the gradient of a tile: that of the response, with ``v_alpha_g`` 0 where alpha was clamped.

    Parameters
    ----------
    sums : BlendGradient
        Is changed.
    response, primitives, conventions
        As for :func:`composite_hits`.
    tile : TileHits
        The hits.
    v : TileGradient
        From :func:`blend_tile_vjp`.
    """
    v_shape = np.where(tile.is_clamped & conventions.clamp_stops_shape_gradient, 0, v.alphas)
    v_mean = np.where(tile.is_clamped & conventions.clamp_stops_mean_gradient, 0, v.alphas)
    v_rows = response.hit_vjp(primitives, tile.ids, tile.hit, v_mean, v_shape, v.place)
    for v_field, v_row in zip(sums.primitives, v_rows, strict=True):
        v_field[tile.ids] += v_row
    sums.colors[tile.ids] += v.colors
    sums.background[:] += v.background


def _suffix_sums(terms: Floats) -> Floats:
    """Return for each row the sum [G, P] of the rows after it."""
    sums = np.cumsum(terms[::-1], axis=0)[::-1]  # [G, P] including the row itself
    return np.concatenate([sums[1:], np.zeros_like(terms[:1])])
