"""Textures on discs, in NumPy: the places that a hit reads, the normals that they hold, and their blending.

A ray hits a disc at (u, v), in standard deviations (:mod:`minisplat_ref.mechanisms.surfels.response`). A texture of
T x T texels covers |u|, |v| <= 4 with its outer texels on the border, and is read linearly between texels; those
outside are 0::

    x = (u / 4 + 1) (T - 1) / 2,   y = (v / 4 + 1) (T - 1) / 2
    X(u, v) = sum_ji h(y - j) h(x - i) X_ji,   h(t) = max(0, 1 - |t|),   image = sum_g w_g X_g(u_g, v_g)

with the weights w_g of blending, so an image is linear in the texels. On the low-pass (u, v) = 0.

Normals have two channels, raw numbers whose tanh is their part along the axes a_0 and a_1 of the disc with the normal
a_2::

    (x, y) = tanh(raw),   z = sqrt(1 - min(x^2 + y^2, 0.99)),   n = x a_0 + y a_1 + z a_2
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.mechanisms.surfels.projection import Surfels
from minisplat_ref.mechanisms.surfels.response import Layout, SurfelPlace, surfel_response
from minisplat_ref.reference.hits import TileHits, tile_hits
from minisplat_ref.types import Floats, Ints, TileBins

REACH = 4.0  # standard deviations that a texture covers to each side
TILT_MAX = 0.99  # of x^2 + y^2
N_CHANNELS = 8  # of a texel: normal, albedo, metallic share, roughness


class Corners(NamedTuple):
    """The four texels around each hit, in the first axis of 4."""

    texels: Ints  # [4, ...] index j T + i; 0 outside, where the weight is 0
    weights: Floats  # [4, ...]
    slopes_u: Floats  # [4, ...] their derivatives
    slopes_v: Floats


class TexelGradient(NamedTuple):
    """Gradient of the loss with respect to the inputs of :func:`blend_texels`."""

    transforms: Floats  # [N, 3, 3]
    means2d: Floats  # [N, 2]
    opacities: Floats  # [N]
    texels: Floats  # [N, T^2, 8]


def find_corners(u: Floats, v: Floats, size: int) -> Corners:
    """Return the texels that hits at (u, v), any shape, read of textures of ``size`` x ``size``."""
    per_sigma = (size - 1) / (2 * REACH)
    along = []
    for coordinate in (u, v):
        x = coordinate * per_sigma + (size - 1) / 2
        first = np.floor(x).astype(int)
        share = x - first
        for index, weight, slope in ((first, 1 - share, -per_sigma), (first + 1, share, per_sigma)):
            is_there = (index >= 0) & (index < size)
            along.append((np.where(is_there, index, 0), np.where(is_there, weight, 0), np.where(is_there, slope, 0)))
    columns, rows = along[:2], along[2:]
    pairs = [(row, column) for row in rows for column in columns]
    return Corners(
        np.stack([j * size + i for (j, _, _), (i, _, _) in pairs]),
        np.stack([b * a for (_, b, _), (_, a, _) in pairs]),
        np.stack([b * slope for (_, b, _), (_, _, slope) in pairs]),
        np.stack([slope * a for (_, _, slope), (_, a, _) in pairs]),
    )


def blend_texels(surfels: Surfels, texels: Floats, bins: TileBins, conventions: Conventions) -> Floats:
    """Return sums over the hits of every pixel, [H, W, 8].

    Parameters
    ----------
    surfels : Surfels
        From :func:`minisplat_ref.mechanisms.surfels.projection.project`.
    texels : ndarray of shape (N, T^2, 8)
        What is read.
    bins : TileBins
        The surfels of every tile, nearest first.
    conventions : Conventions
        Clamp, skip and stop thresholds.
    """
    image = np.zeros((bins.grid.height, bins.grid.width, N_CHANNELS), texels.dtype)
    for tile in tile_hits(surfels, bins, conventions, surfel_response(Layout())):
        weights = tile.alphas * tile.transmittances[:-1]  # [G, P]
        image[tile.ys, tile.xs] = np.einsum("gp,gpk->pk", weights, _read(tile, texels)[0])
    return image


def blend_texels_vjp(
    surfels: Surfels, texels: Floats, bins: TileBins, conventions: Conventions, image: Floats, v_image: Floats
) -> TexelGradient:
    """Gradient of :func:`blend_texels`; ``image`` is its result, from which kernels start.

    ::

        v_X_g     = w_g v,   v_texel = sum over hits of h h v_X_g,   v_u = sum of texel . v_X_g dh/du, likewise v_v
        behind_g  = sum_{j behind g} w_j (X_j . v)
        v_alpha_g = T_g (X_g . v) - behind_g / (1 - alpha_g)

    and from there to the surfels, as for colours; (u, v) adds to the gradient that moves a hit.
    """
    response, n = surfel_response(Layout()), len(texels)
    v_T, v_c, v_o = np.zeros((n, 3, 3)), np.zeros((n, 2)), np.zeros(n)
    v_texels = np.zeros_like(texels)
    for tile in tile_hits(surfels, bins, conventions, response):
        ids, alphas, T = tile.ids, tile.alphas, tile.transmittances[:-1]
        read, corners = _read(tile, texels)
        v, weights = v_image[tile.ys, tile.xs], alphas * T  # [P, 8], [G, P]
        v_dot_X = np.einsum("gpk,pk->gp", read, v)
        in_front = np.cumsum(weights * v_dot_X, axis=0)
        v_alphas = np.where(alphas > 0, T * v_dot_X - (in_front[-1:] - in_front) / (1 - alphas), 0)
        v_shape = np.where(tile.is_clamped & conventions.clamp_stops_shape_gradient, 0, v_alphas)
        v_mean = np.where(tile.is_clamped & conventions.clamp_stops_mean_gradient, 0, v_alphas)
        v_u, v_v = np.zeros_like(weights), np.zeros_like(weights)
        rows = np.broadcast_to(ids[:, None], weights.shape)
        for texel, weight, slope_u, slope_v in zip(*corners, strict=True):
            np.add.at(v_texels, (rows, texel), (weight * weights)[:, :, None] * v)
            along_v = weights * np.einsum("gpk,pk->gp", texels[rows, texel], v)
            v_u += along_v * slope_u
            v_v += along_v * slope_v
        fields = response.hit_vjp(surfels, ids, tile.hit, v_mean, v_shape, None)
        v_T[ids] += fields[0] + _coordinates_vjp(tile.hit.place, surfels.means2d[ids], v_u, v_v)
        v_c[ids] += fields[1]
        v_o[ids] += fields[2]
    return TexelGradient(v_T, v_c, v_o, v_texels)


def tangent_normals(raw: Floats) -> Floats:
    """Return normals [..., 3] in the frames of the discs from raw numbers [..., 2]."""
    xy = np.tanh(raw)
    tilts = np.minimum(np.sum(xy * xy, axis=-1, keepdims=True), TILT_MAX)
    normals: Floats = np.concatenate([xy, np.sqrt(1 - tilts)], axis=-1)
    return normals


def tangent_normals_vjp(raw: Floats, v_normals: Floats) -> Floats:
    """Gradient of :func:`tangent_normals`: ``v_raw = (1 - x^2) (v_x - [x^2 + y^2 < 0.99] (x / z) v_z)``."""
    normals = tangent_normals(raw)
    xy, z = normals[..., :2], normals[..., 2:]
    is_free = np.sum(xy * xy, axis=-1, keepdims=True) < TILT_MAX
    v_raw: Floats = (1 - xy * xy) * (v_normals[..., :2] - np.where(is_free, xy / z, 0) * v_normals[..., 2:])
    return v_raw


def raw_normals(tangent: Floats) -> Floats:
    """Return the raw numbers [..., 2] of normals [..., 3] in the frames of the discs, of any length.

    Those that are tilted by more than a texture holds are tilted by less.
    """
    length = np.linalg.norm(tangent, axis=-1, keepdims=True)
    xy = tangent[..., :2] / np.where(length > 0, length, 1)
    tilts, limit = np.linalg.norm(xy, axis=-1, keepdims=True), np.sqrt(TILT_MAX) * (1 - 1e-6)
    is_over = (tilts > limit) | (tangent[..., 2:] < 0)
    raw: Floats = np.arctanh(np.where(is_over, xy * (limit / np.where(tilts > 0, tilts, 1)), xy))
    return raw


def _read(tile: TileHits, texels: Floats) -> tuple[Floats, Corners]:
    """Return the values that the hits of a tile read, [G, P, 8], and their places."""
    place: SurfelPlace = tile.hit.place
    # Misses may lie anywhere: they read the middle.
    u, v = (np.where(tile.alphas > 0, values, 0) for values in (place.u, place.v))
    corners = find_corners(u, v, round(texels.shape[1] ** 0.5))
    rows = np.broadcast_to(tile.ids[:, None], u.shape)
    read = sum(
        weight[:, :, None] * texels[rows, texel] for texel, weight in zip(corners.texels, corners.weights, strict=True)
    )
    return np.asarray(read), corners


def _coordinates_vjp(place: SurfelPlace, means2d: Floats, v_u: Floats, v_v: Floats) -> Floats:
    """Gradient of (u, v) with respect to the transforms, [G, 3, 3].

    ::

        v_p   = (v_u, v_v, -(u v_u + v v_v)) / p_2,   v_h_u = h_v x v_p,   v_h_v = v_p x h_u
        v_M_u = -v_h_u,   v_M_v = -v_h_v,   v_M_w = x v_h_u + y v_h_v
    """
    h_u, h_v, inverse = place.planes  # the inverse is 0 on the low-pass, where (u, v) stays
    v_p = np.stack([v_u, v_v, -(place.u * v_u + place.v * v_v)], axis=2) * inverse[:, :, None]
    v_h_u, v_h_v = np.cross(h_v, v_p), np.cross(v_p, h_u)
    centers = means2d[:, None] - place.offsets
    v_M_w = centers[:, :, :1] * v_h_u + centers[:, :, 1:] * v_h_v
    return np.stack([-v_h_u.sum(axis=1), -v_h_v.sum(axis=1), v_M_w.sum(axis=1)], axis=1)
