"""The response of a surfel in a pixel: 2D Gaussian Splatting, equations (8) to (11), in NumPy.

The pixel (x, y) is where two planes of its ray meet the disc. In the coordinates (u, v, 1) of the disc they are::

    h_u = x M_w - M_u,   h_v = y M_w - M_v,   p = h_u x h_v,   (u, v) = (p_0, p_1) / p_2

    rho = min(u^2 + v^2, 2 |c - x|^2),   alpha = o exp(-rho / 2)

The second form is a low-pass: a disc seen from its edge would otherwise vanish. Where it is the smaller one, the depth
of the hit is that of the centre; elsewhere it is ``z = M_w . (u, v, 1)``. Where ``p_2 = 0`` the ray is parallel to the
disc, and only the low-pass is left.
"""

from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.mechanisms.surfels.projection import LOW_PASS, Surfels
from minisplat_ref.reference.hits import Hit, Response, Shading
from minisplat_ref.types import Bools, Floats, Ints

FIELDS = ("transforms", "means2d", "opacities", "depths")
"""The inputs of a hit that have derivatives."""


class Layout(NamedTuple):
    """Which channels depend on the depth of the hit; the others are the same on a whole surfel."""

    depth: int | None = None
    """The channel to which z is added."""
    spread: int | None = None
    """The channel to which ``q = 1 / z - q_0`` is added; q^2 is added to the next. With A the accumulated opacity,
    ``A sum w q^2 - (sum w q)^2 = sum_{i<j} w_i w_j (q_i - q_j)^2``, whatever q_0: the distortion of 2D Gaussian
    Splatting up to a factor. A q_0 amid the depths of the view keeps the difference from cancelling in float32."""


class SurfelPlace(NamedTuple):
    """The places where P rays hit G surfels."""

    u: Floats  # [G, P] 0 where the low-pass is hit
    v: Floats  # [G, P]
    planes: tuple[Floats, Floats, Floats]  # h_u, h_v [G, P, 3] and 1 / p_2 [G, P], 0 where the low-pass is hit
    offsets: Floats  # [G, P, 2] c - x, px
    is_met: Bools  # [G, P] whether the disc is hit, not the low-pass
    falloffs: Floats  # [G, P] exp(-rho / 2), 0 where a hit is dropped
    depths: Floats  # [G, P] z
    pivot: float  # q_0


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # of planes that meet nowhere
def hit(surfels: Surfels, ids: Ints, centers: Floats) -> Hit:
    """Return the hits of surfels on the rays through image positions; this is the ``hit`` of a response.

    Parameters
    ----------
    surfels : Surfels
        From :func:`minisplat_ref.mechanisms.surfels.projection.project`.
    ids : ndarray of shape (G,)
        Rows of the surfels.
    centers : ndarray of shape (P, 2)
        Image positions, px.
    """
    T, rules = surfels.transforms[ids, None], surfels.rules  # [G, 1, 3, 3]
    h_u = centers[:, :1] * T[:, :, 2] - T[:, :, 0]  # [G, P, 3]
    h_v = centers[:, 1:] * T[:, :, 2] - T[:, :, 1]
    p = np.cross(h_u, h_v)
    inverse = np.where(p[:, :, 2] == 0, 0, 1 / p[:, :, 2])
    u, v = p[:, :, 0] * inverse, p[:, :, 1] * inverse
    rho_disc = np.where(inverse == 0, np.inf, u * u + v * v)
    offsets = surfels.means2d[ids, None] - centers
    rho_low_pass = LOW_PASS * np.sum(offsets * offsets, axis=2)
    is_met = rho_disc <= rho_low_pass
    u, v, inverse = (np.where(is_met, values, 0) for values in (u, v, inverse))
    z = T[:, :, 2, 0] * u + T[:, :, 2, 1] * v + T[:, :, 2, 2]
    falloffs = np.exp(-np.minimum(rho_disc, rho_low_pass) / 2)
    if rules.drops_near_hits:
        falloffs = np.where(z > surfels.near_plane, falloffs, 0)
    depths = z if rules.has_hit_depths else np.broadcast_to(surfels.depths[ids, None], z.shape)
    place = SurfelPlace(u, v, (h_u, h_v, inverse), offsets, is_met, falloffs, depths, surfels.pivot)
    return Hit(surfels.opacities[ids, None] * falloffs, depths, place)


def hit_vjp(
    surfels: Surfels, ids: Ints, found: Hit, v_mean: Floats, v_shape: Floats, v_depths: Floats | None
) -> tuple[Floats, Floats, Floats, Floats]:
    """Gradient of :func:`hit`, summed over the rays.

    With ``v_rho = -alpha v_alpha / 2``, on the low-pass ``v_c = 4 v_rho (c - x)``, and on the disc::

        v_u = 2 v_rho u + v_z M_w0,   v_v = 2 v_rho v + v_z M_w1
        v_p   = (v_u, v_v, -(u v_u + v v_v)) / p_2
        v_h_u = h_v x v_p,   v_h_v = v_p x h_u
        v_M_u = -v_h_u,   v_M_v = -v_h_v,   v_M_w = x v_h_u + y v_h_v + v_z (u, v, 1)

    Parameters
    ----------
    surfels, ids
        As for the forward function.
    found : Hit
        Its result.
    v_mean, v_shape : ndarray of shape (G, P)
        ``v_alpha``, as for every response; the same parameters move and shape a surfel, so ``v_mean`` serves both.
    v_depths : ndarray of shape (G, P), optional
        v_z, of the depths of the hits.

    Returns
    -------
    tuple
        With respect to transforms [G, 3, 3], means2d [G, 2], opacities [G] and depths [G].
    """
    place: SurfelPlace = found.place
    u, v, (h_u, h_v, inverse) = place.u, place.v, place.planes
    v_rho = -surfels.opacities[ids, None] * place.falloffs * v_mean / 2
    v_z = np.zeros_like(u) if v_depths is None else v_depths
    v_disc = v_z if surfels.rules.has_hit_depths else np.zeros_like(u)
    M_w = surfels.transforms[ids, None, 2]
    v_u = np.where(place.is_met, 2 * v_rho * u + v_disc * M_w[:, :, 0], 0)
    v_v = np.where(place.is_met, 2 * v_rho * v + v_disc * M_w[:, :, 1], 0)
    v_p = np.stack([v_u, v_v, -(u * v_u + v * v_v)], axis=2) * inverse[:, :, None]
    v_h_u, v_h_v = np.cross(h_v, v_p), np.cross(v_p, h_u)
    centers = surfels.means2d[ids, None] - place.offsets  # [G, P, 2]
    coordinates = np.stack([u, v, np.ones_like(u)], axis=2)
    v_M_w = centers[:, :, :1] * v_h_u + centers[:, :, 1:] * v_h_v + v_disc[:, :, None] * coordinates
    v_T = np.stack([-v_h_u.sum(axis=1), -v_h_v.sum(axis=1), v_M_w.sum(axis=1)], axis=1)
    v_c = 2 * LOW_PASS * np.sum(np.where(place.is_met, 0, v_rho)[:, :, None] * place.offsets, axis=1)
    v_depth = np.zeros(len(ids)) if surfels.rules.has_hit_depths else v_z.sum(axis=1)
    return v_T, v_c, np.sum(place.falloffs * v_shape, axis=1), v_depth


def surfel_response(layout: Layout) -> Response:
    """Return the response of surfels with the channels of a layout."""
    return Response(lambda surfels: surfels.boxes, hit, hit_vjp, FIELDS, depth_shading(layout))


def depth_shading(layout: Layout) -> Shading:
    """Return the shading of a response whose places have ``depths`` z [G, P] and a ``pivot``."""

    def shade(colors: Floats, place: Any) -> Floats:
        channels = np.broadcast_to(colors[:, None], (*place.depths.shape, colors.shape[1])).copy()
        if layout.depth is not None:
            channels[:, :, layout.depth] += place.depths
        if layout.spread is not None:
            q = 1 / place.depths - place.pivot
            channels[:, :, layout.spread] += q
            channels[:, :, layout.spread + 1] += q * q
        return channels

    def shade_vjp(colors: Floats, place: Any, v: Floats) -> tuple[Floats, Floats]:
        """With q = 1 / z - q_0: ``v_z = v_depth - (v_q + 2 q v_qq) / z^2``."""
        v_depths = np.zeros_like(place.depths)
        if layout.depth is not None:
            v_depths += v[:, :, layout.depth]
        if layout.spread is not None:
            q = 1 / place.depths - place.pivot
            v_q = v[:, :, layout.spread] + 2 * q * v[:, :, layout.spread + 1]
            v_depths -= v_q / place.depths**2
        return v.sum(axis=1), v_depths

    return Shading(shade, shade_vjp)
