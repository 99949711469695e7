"""Quantities that depend on the order of the hits on a ray: the median depth, and gsplat's distortion.

With the weights w_i and depths z_i of a pixel's hits, front to back, and ``T_i`` the transmittance in front of hit i::

    median     = z_i of the last hit with T_i > 1/2, 0 where there is none
    distortion = sum_ij w_i w_j |z_i - z_j| = 2 sum_i w_i (z_i A_i - M_i)
    A_i        = sum_{j<i} w_j,   M_i = sum_{j<i} w_j z_j

The second form holds where depths never fall along the ray; where they do, gsplat computes it all the same, and so
does this module. It is the distortion of Mip-NeRF 360; that of 2D Gaussian Splatting squares the difference and needs
no order (see :class:`minisplat_ref.mechanisms.surfels.response.Layout`).
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import MEDIAN_TRANSMITTANCE, Conventions
from minisplat_ref.mechanisms.surfels.projection import Surfels
from minisplat_ref.mechanisms.surfels.response import FIELDS, Layout, surfel_response
from minisplat_ref.reference.hits import TileHits, tile_hits
from minisplat_ref.types import Floats, Ints, TileBins


class RayMeasures(NamedTuple):
    """Images of the measures along each ray."""

    median: Floats
    """[H, W] world units."""
    distortion: Floats
    """[H, W] world units."""
    median_ranks: Ints
    """[H, W] which of the pixel's hits, counted from 1, has the median depth; 0: none."""
    depth_sums: Floats
    """[H, W] ``sum w z``."""
    alpha: Floats
    """[H, W] ``sum w``."""


def measure_rays(surfels: Surfels, bins: TileBins, conventions: Conventions) -> RayMeasures:
    """Measure along the rays of an image.

    Parameters
    ----------
    surfels : Surfels
        N surfels. The depth of a hit follows its rules.
    bins : TileBins
        The surfels of each tile, nearest first.
    conventions : Conventions
        Thresholds of blending.
    """
    shape = bins.grid.height, bins.grid.width
    images = [np.zeros(shape) for _ in range(4)]
    ranks = np.zeros(shape, np.int32)
    for tile in tile_hits(surfels, bins, conventions, surfel_response(Layout())):
        pixels, w, z = (tile.ys, tile.xs), _weights(tile), tile.hit.depths
        if len(z) == 0:
            continue
        A, M = _sum_earlier_rows(w), _sum_earlier_rows(w * z)
        is_median = _is_median(tile)
        values = (is_median * z).sum(axis=0), 2 * np.sum(w * (z * A - M), axis=0), (w * z).sum(axis=0), w.sum(axis=0)
        for image, value in zip(images, values, strict=True):
            image[pixels] = value
        ranks[pixels] = (is_median * np.cumsum(tile.alphas > 0, axis=0)).sum(axis=0)
    median, distortion, depth_sums, alpha = images
    return RayMeasures(median, distortion, ranks, depth_sums, alpha)


def measure_rays_vjp(
    surfels: Surfels,
    bins: TileBins,
    conventions: Conventions,
    measures: RayMeasures,
    v_median: Floats,
    v_distortion: Floats,
) -> tuple[Floats, ...]:
    """Gradient of :func:`measure_rays` with respect to the fields of a hit.

    With ``v = v_distortion`` and A, M the sums over the whole ray::

        v_w_i = 2 v ((z_i A_i - M_i) + (M - M_i - w_i z_i) - z_i (A - A_i - w_i))
        v_z_i = 2 v w_i (2 A_i + w_i - A), and v_median for the hit of that depth
        v_alpha_i = T_i v_w_i - sum_{j>i} w_j v_w_j / (1 - alpha_i)

    Parameters
    ----------
    surfels, bins, conventions
        As for the forward function.
    measures : RayMeasures
        Its result. Not needed here: kernels start from it.
    v_median, v_distortion : ndarray of shape (H, W)
        Derivatives.

    Returns
    -------
    tuple of ndarray
        In the order of :data:`minisplat_ref.mechanisms.surfels.response.FIELDS`.
    """
    response = surfel_response(Layout())
    v_fields = tuple(np.zeros_like(getattr(surfels, name)) for name in FIELDS)
    for tile in tile_hits(surfels, bins, conventions, response):
        if len(tile.ids) == 0:
            continue
        w, z, alphas = _weights(tile), tile.hit.depths, tile.alphas
        A, M, v = _sum_earlier_rows(w), _sum_earlier_rows(w * z), v_distortion[tile.ys, tile.xs]
        A_end, M_end = w.sum(axis=0), (w * z).sum(axis=0)
        v_w = 2 * v * ((z * A - M) + (M_end - M - w * z) - z * (A_end - A - w))
        v_z = 2 * v * w * (2 * A + w - A_end) + _is_median(tile) * v_median[tile.ys, tile.xs]
        behind = np.sum(w * v_w, axis=0) - _sum_earlier_rows(w * v_w) - w * v_w
        v_alphas = np.where(alphas > 0, tile.transmittances[:-1] * v_w - behind / (1 - alphas), 0)
        v_mean = np.where(tile.is_clamped & conventions.clamp_stops_mean_gradient, 0, v_alphas)
        v_shape = np.where(tile.is_clamped & conventions.clamp_stops_shape_gradient, 0, v_alphas)
        rows = response.hit_vjp(surfels, tile.ids, tile.hit, v_mean, v_shape, v_z)
        for v_field, v_rows in zip(v_fields, rows, strict=True):
            v_field[tile.ids] += v_rows
    return v_fields


def _weights(tile: TileHits) -> Floats:
    return tile.alphas * tile.transmittances[:-1]


def _sum_earlier_rows(values: Floats) -> Floats:
    """Return for each row the sum of the rows before it."""
    return np.cumsum(values, axis=0) - values


def _is_median(tile: TileHits) -> Floats:
    """Return [G, P] whether a hit is the last one with T > 1/2 in front of it."""
    is_candidate = (tile.alphas > 0) & (tile.transmittances[:-1] > MEDIAN_TRANSMITTANCE)
    rank = np.cumsum(is_candidate, axis=0)
    return is_candidate & (rank == rank[-1])
