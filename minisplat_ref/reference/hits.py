"""Stage 5a: the hits of primitives on the pixels of a tile, their alphas, and the transmittance in front of each.

These are 3DGS equations (3) and (4), the volume rendering of Max (1995) with one sample per Gaussian::

    alpha_g = min(alpha_max, o_g exp(-d^T Q_g d / 2)),   d = p_g - pixel centre
    T_g = prod_{j before g} (1 - alpha_j)

Here a Gaussian is a flat ellipse, and its 3D shape plays no part. A :class:`Response` is the effect of a primitive on a
pixel; that of 3DGS is ``CONIC``. Rays against 3D Gaussians, surfels, masks and pixel integrals are other responses.

A tile is one array with hits along the rows and pixels along the columns. Hits are taken in the order of the tile's
list, which is that of the means' depths. A skipped hit has ``alpha_g = 0``, which changes no product and no sum.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.types import Bools, Floats, Ints, Projection, TileBins


class Hit(NamedTuple):
    """The hits of G primitives on P pixels."""

    unclamped: Floats  # [G, P] alpha before the clamp
    depths: Floats  # [G, P] along the ray
    place: Any  # where inside the primitive, arrays [G, P, ...]: what colours and gradients depend on


class ConicPlace(NamedTuple):
    """The positions of pixels in a projected Gaussian."""

    offsets: Floats  # [G, P, 2] Gaussian's centre minus pixel's centre, px
    falloffs: Floats  # [G, P] E = exp(-sigma)


def conic_boxes(projection: Projection) -> Ints:
    """Return the boxes of ``projection``, which stage 3 made."""
    return projection.boxes


def conic_hit(projection: Projection, ids: Ints, centers: Floats) -> Hit:
    """Evaluate the flat ellipses of projected Gaussians.

    Parameters
    ----------
    projection : Projection
        Footprints and opacities.
    ids : ndarray of shape (G,)
        Which of them.
    centers : ndarray of shape (P, 2)
        Pixel centres, px.

    Returns
    -------
    Hit
        The depth is that of the mean, the same for all pixels.
    """
    offsets = projection.means2d[ids, None] - centers.astype(projection.means2d.dtype)  # [G, P, 2]
    sigmas = np.einsum("gpi,gij,gpj->gp", offsets, conic_matrices(projection.conics[ids]), offsets) / 2
    falloffs = np.exp(-np.maximum(sigmas, 0))
    # A negative square is a rounding error.
    unclamped = np.where(sigmas >= 0, projection.opacities[ids, None] * falloffs, 0)
    depths = np.broadcast_to(projection.depths[ids, None], unclamped.shape)
    return Hit(unclamped, depths, ConicPlace(offsets, falloffs))


def conic_hit_vjp(
    projection: Projection, ids: Ints, hit: Hit, v_mean: Floats, v_shape: Floats, v_place: None
) -> tuple[Floats, Floats, Floats]:
    """Gradient of :func:`conic_hit`, summed over the pixels.

    With ``alpha = o E``, ``E = exp(-sigma)``, ``sigma = d^T Q d / 2``::

        v_o = E v_alpha,  v_sigma = -o E v_alpha
        v_p = v_sigma Q d
        v_a = v_sigma dx^2 / 2,  v_b = v_sigma dx dy,  v_c = v_sigma dy^2 / 2

    Parameters
    ----------
    projection, ids
        As for the forward function.
    hit : Hit
        Its result.
    v_mean, v_shape : ndarray of shape (G, P)
        ``v_alpha`` as it reaches p, and as it reaches o and the conic.
    v_place : None
        The colours do not depend on the place.

    Returns
    -------
    tuple
        With respect to means2d [G, 2], conics [G, 3] and opacities [G].
    """
    offsets, falloffs = hit.place
    unclamped = projection.opacities[ids, None] * falloffs  # [G, P] o E
    Q = conic_matrices(projection.conics[ids])
    v_means2d = np.einsum("gp,gij,gpj->gi", -unclamped * v_mean, Q, offsets)
    v_Q = np.einsum("gp,gpi,gpj->gij", -unclamped * v_shape / 2, offsets, offsets)
    v_conics = np.column_stack([v_Q[:, 0, 0], 2 * v_Q[:, 0, 1], v_Q[:, 1, 1]])
    return v_means2d, v_conics, np.sum(falloffs * v_shape, axis=1)


class Shading(NamedTuple):
    """Colours that vary inside a primitive: a texture, spherical harmonics on an ellipsoid, the depth on the ray.

    From S coefficients of a primitive they make D channels at the place of a hit. Places have to be finite even where a
    pixel misses the primitive.
    """

    shade: Callable[[Floats, Any], Floats]
    """(coefficients [G, S], place) -> channels [G, P, D]."""
    shade_vjp: Callable[[Floats, Any, Floats], tuple[Floats, Any]]
    """(coefficients, place, v [G, P, D]) -> (v_coefficients [G, S], v_place)."""


class Response(NamedTuple):
    """The effect of a primitive on a pixel. ``primitives`` may be any bundle that the functions take."""

    boxes: Callable[[Any], Ints]
    """[N, 4] half-open pixels x0, y0, x1, y1: nothing is hit elsewhere."""
    hit: Callable[[Any, Ints, Floats], Hit]
    """(primitives, ids [G], pixel centres [P, 2]) -> hits."""
    hit_vjp: Callable[[Any, Ints, Hit, Floats, Floats, Any], tuple[Floats, ...]]
    """(primitives, ids, hits, v_mean [G, P], v_shape [G, P], v_place) -> an array [G, ...] for each of ``fields``.

    ``v_mean`` and ``v_shape`` both are the derivative with respect to ``unclamped``: the first for what moves the
    primitive, the second for all else, because conventions may stop either at the clamp. ``v_place`` comes from
    the shading and is None without one.
    """
    fields: tuple[str, ...]
    """Names of the fields of ``primitives`` that have a derivative."""
    shading: Shading | None = None
    """None: a primitive has the same D channels everywhere."""


CONIC = Response(conic_boxes, conic_hit, conic_hit_vjp, ("means2d", "conics", "opacities"))
"""3DGS: a projected Gaussian of one colour."""


class TileHits(NamedTuple):
    """The hits of G primitives on the P pixels of one tile."""

    ids: Ints  # [G] front to back
    ys: Ints  # [P] pixel rows
    xs: Ints  # [P] pixel columns
    hit: Hit  # of all pixels, before the skip and the stop
    is_clamped: Bools  # [G, P] unclamped > alpha_max
    alphas: Floats  # [G, P] 0 where there is no hit
    transmittances: Floats  # [G + 1, P] row g is T_g, in front of hit g; the last row is T_end


def tile_hits(
    primitives: Any, bins: TileBins, conventions: Conventions, response: Response = CONIC
) -> Iterator[TileHits]:
    """Evaluate the tiles of an image, one after the other.

    Parameters
    ----------
    primitives : Projection
        Footprints and opacities, or what ``response`` takes.
    bins : TileBins
        The primitives of each tile, nearest first.
    conventions : Conventions
        Clamp, skip and stop thresholds.
    response : Response
        What a primitive does to a pixel.

    Yields
    ------
    TileHits
        One per tile, in row-major order.
    """
    grid, boxes = bins.grid, response.boxes(primitives)
    for t in range(grid.n_tiles_x * grid.n_tiles_y):
        ids = bins.gaussian_ids[bins.tile_offsets[t] : bins.tile_offsets[t + 1]]
        x, y = t % grid.n_tiles_x * grid.tile_width, t // grid.n_tiles_x * grid.tile_height
        columns = np.arange(x, min(x + grid.tile_width, grid.width))
        rows = np.arange(y, min(y + grid.tile_height, grid.height))
        ys, xs = (index.ravel() for index in np.meshgrid(rows, columns, indexing="ij"))

        hit = response.hit(primitives, ids, np.stack([xs, ys], axis=1) + 0.5)
        alphas = np.minimum(conventions.alpha_max, hit.unclamped)
        x0, y0, x1, y1 = boxes[ids, :, None].swapaxes(0, 1)  # [G, 1] each
        is_hit = (x0 <= xs) & (xs < x1) & (y0 <= ys) & (ys < y1) & (alphas >= conventions.alpha_min)
        alphas = np.where(is_hit, alphas, 0)

        # T never rises: once a hit would take it below the threshold, that hit and all behind it are left out.
        alphas = np.where(is_accepted(transmit(alphas)[1:], conventions), alphas, 0)
        is_clamped = hit.unclamped > conventions.alpha_max
        yield TileHits(ids, ys, xs, hit, is_clamped, alphas, transmit(alphas))


def transmit(alphas: Floats) -> Floats:
    """Return T before each of G hits ``alphas`` [G, P] and after the last, [G + 1, P]: products of ``1 - alpha``."""
    ones = np.ones_like(alphas, shape=(1, alphas.shape[1]))
    return np.cumprod(np.concatenate([ones, 1 - alphas]), axis=0)


def is_accepted(transmittances: Floats, conventions: Conventions) -> Bools:
    """Return whether a pixel takes a hit that would leave it with ``transmittances``; ``conventions`` set the bound."""
    if conventions.stops_at_equality:
        return transmittances > conventions.transmittance_min
    return transmittances >= conventions.transmittance_min


def conic_matrices(conics: Floats) -> Floats:
    """Return [[a, b], [b, c]] for ``conics`` (a, b, c) [G, 3]."""
    return conics[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
