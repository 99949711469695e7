"""A ray and a 3D Gaussian, in NumPy; ``mechanisms.rays.blending`` blends many of them along a ray.

This is section 3 of RaySplats. The map ``M = diag(1/s) R^T`` takes the Gaussian around mu to the unit ball. On the ray
``O + t d``

    p = M (mu - O),  v = M d
    t = (v . p) / (v . v)            where the density on the ray is greatest
    e = p - t v,  q = e . e          the squared distance from the centre there, in standard deviations
    alpha = min(alpha_max, o exp(-q / 2))
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.extensions.rays.geometry import Whitened
from minisplat_ref.mechanisms.rays.blending import IntersectionGradient, Meeting
from minisplat_ref.mechanisms.rays.pixel_rays import Rays
from minisplat_ref.types import Floats, Ints


class Intersections(NamedTuple):
    """The intermediate values of H intersections of a ray and a Gaussian."""

    p: Floats  # [H, 3]
    v: Floats  # [H, 3]
    e: Floats  # [H, 3]
    depths: Floats  # [H] t
    unclamped: Floats  # [H] o exp(-q / 2)


def intersect(gaussians: Whitened, rays: Rays, ray_ids: Ints, gaussian_ids: Ints) -> Intersections:
    """Return the values of Gaussians at their peaks on rays, one by one.

    Parameters
    ----------
    gaussians : Whitened
        N Gaussians.
    rays : Rays
        P rays.
    ray_ids, gaussian_ids : ndarray of shape (H,)
        Indices of the ray and of the Gaussian of each intersection.

    Returns
    -------
    Intersections
        t in units of the ray's direction.
    """
    M = gaussians.maps[gaussian_ids]  # [H, 3, 3]
    p = np.einsum("hij,hj->hi", M, gaussians.means[gaussian_ids] - rays.origins[ray_ids])
    v = np.einsum("hij,hj->hi", M, rays.directions[ray_ids])
    with np.errstate(invalid="ignore", over="ignore"):  # a Gaussian that is too thin for float64 is not hit
        t = np.sum(v * p, axis=1) / np.sum(v * v, axis=1)
        e = p - t[:, None] * v
        unclamped = gaussians.opacities[gaussian_ids] * np.exp(-0.5 * np.sum(e * e, axis=1))
    return Intersections(p, v, e, t, unclamped)


def intersect_vjp(
    gaussians: Whitened, rays: Rays, ray_ids: Ints, gaussian_ids: Ints, v_unclamped: Floats, v_depths: Floats
) -> IntersectionGradient:
    """Gradient of :func:`intersect`, one by one.

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
        As for :func:`intersect`.
    v_unclamped, v_depths : ndarray of shape (H,)
        Derivatives with respect to its results.

    Returns
    -------
    IntersectionGradient
        Its shapes are the maps, [H, 3, 3].
    """
    found = intersect(gaussians, rays, ray_ids, gaussian_ids)
    t, e = found.depths[:, None], found.e
    a = np.sum(found.v * found.v, axis=1, keepdims=True)  # [H, 1]
    v_q = (-0.5 * found.unclamped * v_unclamped)[:, None]
    v_t = v_depths[:, None]
    v_p = 2 * v_q * e + v_t * found.v / a
    v_v = -2 * t * v_q * e + v_t * (found.p - 2 * t * found.v) / a
    M = gaussians.maps[gaussian_ids]
    offsets = gaussians.means[gaussian_ids] - rays.origins[ray_ids]
    v_maps = v_p[:, :, None] * offsets[:, None] + v_v[:, :, None] * rays.directions[ray_ids][:, None]
    v_means = np.einsum("hij,hi->hj", M, v_p)
    v_opacities = found.unclamped / gaussians.opacities[gaussian_ids] * v_unclamped
    return IntersectionGradient(v_means, v_maps, v_opacities, -v_means, np.einsum("hij,hi->hj", M, v_v))


def prepare_meeting(gaussians: Whitened) -> Meeting:
    """Return the intersection of rays with these Gaussians."""

    def alphas_and_depths(rays: Rays, ray_ids: Ints, gaussian_ids: Ints) -> tuple[Floats, Floats]:
        found = intersect(gaussians, rays, ray_ids, gaussian_ids)
        return found.unclamped, found.depths

    return Meeting(len(gaussians.means), alphas_and_depths, lambda *args: intersect_vjp(gaussians, *args))
