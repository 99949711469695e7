"""Stage 5: blend sorted Gaussians into pixels, front to back, and carry a pixel's derivative back to them.

This is 3DGS equation (3) with the hits of :mod:`hits`, each of weight ``w_g = alpha_g T_g``::

    image = sum_g w_g c_g + T_end background,   alpha = 1 - T_end = sum_g w_g

``composite_hits`` does that for any :class:`~minisplat_ref.reference.hits.Response`; ``composite`` is 3DGS's.
"""

from typing import Any

import numpy as np

from minisplat_ref.constants import MEDIAN_TRANSMITTANCE, Conventions
from minisplat_ref.reference.hits import CONIC, Response, goes_on, sort_by, tile_hits, undo_sort_by
from minisplat_ref.types import (
    BlendGradient,
    BlendStats,
    CompositeGradient,
    Floats,
    Projection,
    RenderOutput,
    TileBins,
)


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
    """Blend the primitives of every tile, each pixel in the order of its response.

    Parameters
    ----------
    response : Response
        What a primitive does to a pixel.
    primitives : NamedTuple
        What ``response`` takes.
    colors : ndarray of shape (N, S)
        D channels, or the coefficients from which ``response.shade`` computes them.
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
        Image [H, W, D] and alpha [H, W], and what was asked for.
    """
    height, width, n, dtype = bins.grid.height, bins.grid.width, len(colors), colors.dtype
    image = np.empty((height, width, len(background)), dtype=dtype)
    alpha = np.empty((height, width), dtype=dtype)
    median_depth = np.zeros((height, width), dtype=dtype) if with_median_depth else None
    stats = _no_hits(n, height, width, dtype) if with_stats else None
    for tile in tile_hits(primitives, bins, conventions, response):
        ids, ys, xs, order = tile.ids, tile.ys, tile.xs, tile.order
        weights = tile.alphas * undo_sort_by(order, tile.transmittances[:-1])  # [G, P]
        transmittance = tile.transmittances[-1]  # [P]
        if response.shade is None:
            light = weights.T @ colors[ids]  # [P, D]
        else:
            light = np.einsum("gp,gpd->pd", weights, response.shade(colors[ids], tile.hit.place))
        image[ys, xs] = light + transmittance[:, None] * background
        alpha[ys, xs] = 1 - transmittance
        if median_depth is not None and len(ids):
            is_beyond = tile.transmittances[1:] < MEDIAN_TRANSMITTANCE  # [G, P] true from the hit that crosses one half
            crossing = np.argmax(is_beyond, axis=0)[None]
            depths = sort_by(crossing, sort_by(order, tile.hit.depths))[0]
            median_depth[ys, xs] = np.where(transmittance < MEDIAN_TRANSMITTANCE, depths, 0)
        if stats is not None and len(ids):
            stats.blend_weight_sum[ids] += weights.sum(axis=1)
            stats.blend_weight_max[ids] = np.maximum(stats.blend_weight_max[ids], weights.max(axis=1))
            stats.hit_count[ids] += (weights > 0).sum(axis=1, dtype=np.int32)
            heaviest = np.argmax(sort_by(order, weights), axis=0)  # of equals the first, which is in front
            ids_in_order = sort_by(order, np.broadcast_to(ids[:, None], weights.shape))  # [G, P]
            dominant = np.where(weights.max(axis=0) > 0, sort_by(heaviest[None], ids_in_order)[0], -1)
            stats.dominant_ids[ys, xs] = dominant
            np.add.at(stats.dominant_count, dominant[dominant >= 0], 1)
    return RenderOutput(image, alpha, median_depth, stats)


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
    """Gradient of :func:`composite_hits` with respect to what it blends.

    For one pixel with ``v = v_image``: alpha is ``1 - T_end``, so the derivative with respect to ``T_end`` is
    ``v . background - v_alpha``. A hit contributes ``alpha_g T_g c_g`` and multiplies everything behind it by
    ``1 - alpha_g``, therefore::

        v_c_g        = w_g v
        v_background = T_end v
        behind_g     = sum_{j behind g} w_j (c_j . v) + T_end (v . background - v_alpha)
        v_alpha_g    = T_g (c_g . v) - behind_g / (1 - alpha_g)

    The response's own derivatives do the rest, with ``v_alpha_g`` 0 where alpha was clamped. The skip, the stop and the
    order are treated as fixed: the image jumps there and has no derivative.

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
    v_fields = tuple(np.zeros_like(getattr(primitives, name)) for name in response.fields)
    v_colors, v_background = np.zeros_like(colors), np.zeros_like(background)
    for tile in tile_hits(primitives, bins, conventions, response):
        ids, alphas, hit = tile.ids, tile.alphas, tile.hit
        T = undo_sort_by(tile.order, tile.transmittances[:-1])  # [G, P]
        T_end = tile.transmittances[-1]  # [P]
        v, c = v_image[tile.ys, tile.xs], colors[ids]  # [P, D], [G, S]
        weights, v_place = alphas * T, None  # [G, P]
        if response.shade is None or response.shade_vjp is None:
            v_colors[ids] += weights @ v
            v_dot_c = c @ v.T  # [G, P] c_g . v
        else:
            v_c, v_place = response.shade_vjp(c, hit.place, weights[:, :, None] * v)
            v_colors[ids] += v_c
            v_dot_c = np.einsum("gpd,pd->gp", response.shade(c, hit.place), v)
        v_background += T_end @ v

        v_T_end = v @ background - v_alpha[tile.ys, tile.xs]  # [P]
        in_front = sort_by(tile.order, weights * v_dot_c)
        behind = undo_sort_by(tile.order, _sum_behind(in_front)) + T_end * v_T_end
        v_alphas = np.where(alphas > 0, T * v_dot_c - behind / (1 - alphas), 0)

        v_shape = np.where(tile.is_clamped & conventions.clamp_stops_shape_gradient, 0, v_alphas)
        v_mean = np.where(tile.is_clamped & conventions.clamp_stops_mean_gradient, 0, v_alphas)
        for v_field, v_rows in zip(
            v_fields, response.hit_vjp(primitives, ids, hit, v_mean, v_shape, v_place), strict=True
        ):
            v_field[ids] += v_rows
    return BlendGradient(v_fields, v_colors, v_background)


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
        Image [H, W, D] and alpha [H, W], and what was asked for.
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
        is_open &= ~(is_hit & ~goes_on(T * (1 - alpha), conventions))
        alpha = np.where(is_hit & is_open, alpha, 0)
        image += (T * alpha)[:, :, None] * colors[g]
        T = T * (1 - alpha)
    return image + T[:, :, None] * background, 1 - T


def _sum_behind(terms: Floats) -> Floats:
    """Return for each row the sum [G, P] of the rows after it."""
    sums = np.cumsum(terms[::-1], axis=0)[::-1]  # [G, P] including the row itself
    return np.concatenate([sums[1:], np.zeros_like(terms[:1])])


def _no_hits(n: int, height: int, width: int, dtype: np.dtype) -> BlendStats:
    counts = np.zeros(n, dtype=np.int32)
    dominant_ids = np.full((height, width), -1, dtype=np.int32)
    return BlendStats(np.zeros(n, dtype), np.zeros(n, dtype), counts, counts.copy(), dominant_ids)
