"""Ray tracing of 3D Gaussians in NumPy: every ray is tested against every Gaussian.

This is section 3 of RaySplats. The map ``M = diag(1/s) R^T`` takes the Gaussian around mu to the unit ball. On the ray
``O + t d``

    p = M (mu - O),  v = M d
    t = (v . p) / (v . v)            where the density on the ray is greatest
    e = p - t v,  q = e . e          the squared distance from the centre there, in standard deviations
    alpha = min(alpha_max, o exp(-q / 2))

Hits are blended in the order of t, and of the rows where t is equal, with the weights ``w_i = alpha_i T_i`` of equation
(3) of 3DGS. A hit does not count if ``alpha < alpha_min`` or t is outside the ray's limits; the first hit that would
reduce the transmittance to its minimum ends the ray and does not count either.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.extensions.rays.types import BlendedRays, Hits, RayGradient, Rays, Whitened
from minisplat_ref.reference.hits import goes_on
from minisplat_ref.types import Floats, Ints

PAIRS_AT_ONCE = 1 << 18  # of rays and Gaussians: some thirty arrays of float64, 60 MB


class Pairs(NamedTuple):
    """The intermediate values of H pairs of a ray and a Gaussian."""

    p: Floats  # [H, 3]
    v: Floats  # [H, 3]
    e: Floats  # [H, 3]
    depths: Floats  # [H] t
    unclamped: Floats  # [H] o exp(-q / 2)


def evaluate_pairs(gaussians: Whitened, rays: Rays, ray_ids: Ints, gaussian_ids: Ints) -> Pairs:
    """Return the values of Gaussians at their peaks on rays, pair by pair.

    Parameters
    ----------
    gaussians : Whitened
        N Gaussians.
    rays : Rays
        P rays.
    ray_ids, gaussian_ids : ndarray of shape (H,)
        Indices of the ray and of the Gaussian of each pair.

    Returns
    -------
    Pairs
        t in units of the ray's direction.
    """
    M = gaussians.maps[gaussian_ids]  # [H, 3, 3]
    p = np.einsum("hij,hj->hi", M, gaussians.means[gaussian_ids] - rays.origins[ray_ids])
    v = np.einsum("hij,hj->hi", M, rays.directions[ray_ids])
    with np.errstate(invalid="ignore", over="ignore"):  # a Gaussian that is too thin for float64 is not hit
        t = np.sum(v * p, axis=1) / np.sum(v * v, axis=1)
        e = p - t[:, None] * v
        unclamped = gaussians.opacities[gaussian_ids] * np.exp(-0.5 * np.sum(e * e, axis=1))
    return Pairs(p, v, e, t, unclamped)


def evaluate_pairs_vjp(
    gaussians: Whitened, rays: Rays, ray_ids: Ints, gaussian_ids: Ints, v_unclamped: Floats, v_depths: Floats
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Gradient of :func:`evaluate_pairs`, pair by pair.

    Because e is orthogonal to v, the dependence of t on p does not contribute to dq/dp::

        E = exp(-q / 2)
        v_o = E v_alpha,   v_q = -o E v_alpha / 2
        v_p = 2 v_q e + v_t v / a                            a = v . v
        v_v = -2 t v_q e + v_t (p - 2 t v) / a
        v_M = v_p (mu - O)^T + v_v d^T
        v_mu = M^T v_p,   v_O = -M^T v_p,   v_d = M^T v_v

    Parameters
    ----------
    gaussians, rays, ray_ids, gaussian_ids
        As for :func:`evaluate_pairs`.
    v_unclamped, v_depths : ndarray of shape (H,)
        Derivatives with respect to its results.

    Returns
    -------
    tuple
        Gradients with respect to means [H, 3], maps [H, 3, 3], opacities [H], origins [H, 3] and directions [H, 3].
    """
    pairs = evaluate_pairs(gaussians, rays, ray_ids, gaussian_ids)
    t, e = pairs.depths[:, None], pairs.e
    a = np.sum(pairs.v * pairs.v, axis=1, keepdims=True)  # [H, 1]
    v_q = (-0.5 * pairs.unclamped * v_unclamped)[:, None]
    v_t = v_depths[:, None]
    v_p = 2 * v_q * e + v_t * pairs.v / a
    v_v = -2 * t * v_q * e + v_t * (pairs.p - 2 * t * pairs.v) / a
    M = gaussians.maps[gaussian_ids]
    offsets = gaussians.means[gaussian_ids] - rays.origins[ray_ids]
    v_maps = v_p[:, :, None] * offsets[:, None] + v_v[:, :, None] * rays.directions[ray_ids][:, None]
    v_means = np.einsum("hij,hi->hj", M, v_p)
    v_opacities = pairs.unclamped / gaussians.opacities[gaussian_ids] * v_unclamped
    return v_means, v_maps, v_opacities, -v_means, np.einsum("hij,hi->hj", M, v_v)


def list_hits(gaussians: Whitened, rays: Rays, conventions: Conventions) -> Hits:
    """Return the blended hits of each ray, nearest first.

    Parameters
    ----------
    gaussians : Whitened
        N Gaussians.
    rays : Rays
        P rays.
    conventions : Conventions
        Clamp, skip and stop thresholds.
    """
    n, n_rays = len(gaussians.means), len(rays.near)
    ids, alphas, depths, weights, rows = ([np.zeros(0, kind)] for kind in (int, float, float, float, int))
    transmittances = np.ones(n_rays)
    for some in _chunks(n_rays, n):
        pairs = evaluate_pairs(gaussians, rays, np.repeat(some, n), np.tile(np.arange(n), len(some)))
        unclamped, t = (array.reshape(len(some), n) for array in (pairs.unclamped, pairs.depths))
        alpha = np.minimum(conventions.alpha_max, unclamped)
        is_hit = (alpha >= conventions.alpha_min) & (t > rays.near[some, None]) & (t < rays.far[some, None])
        order = np.argsort(np.where(is_hit, t, np.inf), axis=1, kind="stable")  # [P', N]
        alpha = np.take_along_axis(np.where(is_hit, alpha, 0.0), order, axis=1)
        after = np.cumprod(1 - alpha, axis=1)
        alpha = np.where(goes_on(after, conventions), alpha, 0.0)  # T never rises, so only the end is cut off
        T = np.cumprod(np.column_stack([np.ones(len(some)), 1 - alpha]), axis=1)  # [P', N + 1]
        row, place = np.nonzero(alpha > 0)  # of each ray in its order
        found = order[row, place]
        transmittances[some] = T[:, -1]
        ids.append(found)
        alphas.append(unclamped[row, found])
        depths.append(t[row, found])
        weights.append((alpha * T[:, :-1])[row, place])
        rows.append(some[row])
    ray_ids = np.concatenate(rows)
    offsets = np.concatenate([[0], np.cumsum(np.bincount(ray_ids, minlength=n_rays))])
    return Hits(
        offsets,
        ray_ids,
        np.concatenate(ids),
        np.concatenate(alphas),
        np.concatenate(depths),
        np.concatenate(weights),
        transmittances,
    )


def blend_rays(
    gaussians: Whitened, colors: Floats, rays: Rays, background: Floats, conventions: Conventions
) -> BlendedRays:
    """Return the colour ``sum_i w_i c_i + T_end b`` and the accumulated depth ``sum_i w_i t_i`` of each ray.

    Parameters
    ----------
    gaussians : Whitened
        N Gaussians.
    colors : ndarray of shape (N, 3)
        One colour per Gaussian.
    rays : Rays
        P rays.
    background : ndarray of shape (3,)
        b.
    conventions : Conventions
        Clamp, skip and stop thresholds.
    """
    hits = list_hits(gaussians, rays, conventions)
    image, depths = np.zeros((len(rays.near), 3)), np.zeros(len(rays.near))
    np.add.at(image, hits.ray_ids, hits.weights[:, None] * colors[hits.gaussian_ids])
    np.add.at(depths, hits.ray_ids, hits.weights * hits.depths)
    is_seen = np.bincount(hits.gaussian_ids, minlength=len(gaussians.means)) > 0
    image += hits.transmittances[:, None] * background
    return BlendedRays(image, depths, hits.transmittances, np.diff(hits.offsets), is_seen)


def blend_rays_vjp(
    gaussians: Whitened,
    colors: Floats,
    rays: Rays,
    background: Floats,
    conventions: Conventions,
    blended: BlendedRays,
    v_blended: tuple[Floats, Floats, Floats],
) -> RayGradient:
    """Gradient of :func:`blend_rays`.

    With ``f_i = v_image . c_i + v_depth t_i`` and the sum ``B_i = sum_{j > i} w_j f_j + T_end (v_image . b + v_T)``
    over what lies behind hit i::

        v_c_i     = w_i v_image,   v_t_i = w_i v_depth,   v_b = sum T_end v_image
        v_alpha_i = T_i f_i - B_i / (1 - alpha_i)                                     0 where alpha is clamped

    Parameters
    ----------
    gaussians, colors, rays, background, conventions
        As for :func:`blend_rays`.
    blended : BlendedRays
        The result of :func:`blend_rays`.
    v_blended : tuple
        Derivatives with respect to the image [P, 3], the depths [P] and the transmittances [P].
    """
    v_image, v_depths, v_transmittances = v_blended
    hits = list_hits(gaussians, rays, conventions)
    ray_ids, ids = hits.ray_ids, hits.gaussian_ids
    alphas = np.minimum(conventions.alpha_max, hits.unclamped)
    f = np.sum(v_image[ray_ids] * colors[ids], axis=1) + v_depths[ray_ids] * hits.depths
    places = np.arange(len(ids)) - hits.offsets[ray_ids]
    table = np.zeros((len(rays.near), int(places.max(initial=-1)) + 2))
    table[ray_ids, places + 1] = hits.weights * f
    table[:, 0] = blended.transmittances * (v_image @ background + v_transmittances)
    behind = np.cumsum(table[:, :0:-1], axis=1)[:, ::-1] - table[:, 1:] + table[:, :1]  # B [P, K]
    v_alphas = hits.weights / alphas * f - behind[ray_ids, places] / (1 - alphas)
    v_unclamped = np.where(hits.unclamped <= conventions.alpha_max, v_alphas, 0.0)
    pairs = evaluate_pairs_vjp(gaussians, rays, ray_ids, ids, v_unclamped, hits.weights * v_depths[ray_ids])
    n, n_rays = len(gaussians.means), len(rays.near)
    return RayGradient(
        means=_summed(pairs[0], ids, n),
        maps=_summed(pairs[1], ids, n),
        opacities=_summed(pairs[2], ids, n),
        colors=_summed(hits.weights[:, None] * v_image[ray_ids], ids, n),
        background=np.sum(blended.transmittances[:, None] * v_image, axis=0),
        origins=_summed(pairs[3], ray_ids, n_rays),
        directions=_summed(pairs[4], ray_ids, n_rays),
    )


def _summed(values: Floats, rows: Ints, n_rows: int) -> Floats:
    """Return the sums [n_rows, ...] of those values [H, ...] that belong to the same row."""
    sums = np.zeros((n_rows, *values.shape[1:]))
    np.add.at(sums, rows, values)
    return sums


def _chunks(n_rays: int, n: int) -> Iterator[Ints]:
    """Yield the rays in chunks, so that not too many pairs are in memory at once."""
    step = max(1, PAIRS_AT_ONCE // max(n, 1))
    for first in range(0, n_rays, step):
        yield np.arange(first, min(first + step, n_rays))
