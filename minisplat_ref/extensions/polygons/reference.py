"""A ray and a flat Gaussian in its polygon, in NumPy; ``mechanisms.rays.blending`` blends many of them along a ray.

REdiSplats, section 3. The spans ``S_a = s_a e_a`` and ``S_b = s_b e_b`` are perpendicular, and so the ray ``O + t d``
meets the plane of the Gaussian around mu at the place (u, v), in standard deviations:

    n = S_a x S_b,   t = n . (mu - O) / n . d,   x = O + t d - mu
    u = x . S_a / |S_a|^2,   v = x . S_b / |S_b|^2,   alpha = min(alpha_max, o exp(-(u^2 + v^2) / 2))

It hits the polygon of n sides and radius r if it is on the inner side of every edge:

    u cos psi_j + v sin psi_j <= r cos(pi / n),   psi_j = (2 j + 1) pi / n

A polygon of radius 0 is never hit. The edge has no gradient: at most ``o exp(-(r cos(pi / n))^2 / 2)`` of alpha ends
there, 0.008 for an octagon of opacity 1.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.extensions.polygons.geometry import Polygons
from minisplat_ref.mechanisms.rays.blending import IntersectionGradient, Meeting
from minisplat_ref.mechanisms.rays.pixel_rays import Rays
from minisplat_ref.types import Bools, Floats, Ints


class Intersections(NamedTuple):
    """Rays and polygons that meet, one by one."""

    x: Floats  # [H, 3] from mu to the place
    places: Floats  # [H, 2] u, v
    depths: Floats  # [H] t; not a number or infinite for a ray in parallel to the plane
    unclamped: Floats  # [H] o exp(-(u^2 + v^2) / 2), 0 outside of the polygon


def meet(polygons: Polygons, rays: Rays, ray_ids: Ints, gaussian_ids: Ints) -> Intersections:
    """Evaluate flat Gaussians on rays, one by one.

    Parameters
    ----------
    polygons : Polygons
        N flat Gaussians.
    rays : Rays
        P rays.
    ray_ids, gaussian_ids : ndarray of shape (H,)
        The ray and the polygon that may meet.

    Returns
    -------
    Intersections
        t in units of the ray's direction.
    """
    S, d = polygons.spans[gaussian_ids], rays.directions[ray_ids]  # [H, 3, 2], [H, 3]
    offsets = polygons.means[gaussian_ids] - rays.origins[ray_ids]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # a ray in the plane; no finite size
        n = np.cross(polygons.spans[:, :, 0], polygons.spans[:, :, 1])[gaussian_ids]
        t = np.sum(n * offsets, axis=1) / np.sum(n * d, axis=1)
        x = t[:, None] * d - offsets
        places = np.einsum("hi,hik->hk", x, S) / np.sum(S * S, axis=1)
        unclamped = polygons.opacities[gaussian_ids] * np.exp(-0.5 * np.sum(places**2, axis=1))
        is_hit = is_inside(places, polygons.radii[gaussian_ids], polygons.n_sides)
    return Intersections(x, places, t, np.where(is_hit, unclamped, 0.0))


def is_inside(places: Floats, radii: Floats, n_sides: int) -> Bools:
    """Return whether places (u, v) [H, 2] lie in polygons of radii [H], their edges included."""
    psi = (2 * np.arange(n_sides) + 1) * np.pi / n_sides
    is_in: Bools = (radii > 0) & (np.abs(places) <= radii[:, None]).all(axis=1)  # few are left
    near = np.flatnonzero(is_in)
    outermost = np.max(places[near] @ np.array([np.cos(psi), np.sin(psi)]), axis=1)
    is_in[near] = outermost <= radii[near] * np.cos(np.pi / n_sides)
    return is_in


def meet_vjp(
    polygons: Polygons, rays: Rays, ray_ids: Ints, gaussian_ids: Ints, v_unclamped: Floats, v_depths: Floats
) -> IntersectionGradient:
    """Gradient of :func:`meet`, where they meet.

    With the spans S_k, k = a, b, the places u_k and the offset ``m = mu - O``::

        v_o    = exp(-(u_a^2 + u_b^2) / 2) v_alpha,   v_u_k = -alpha u_k v_alpha
        v_x    = sum_k v_u_k S_k / |S_k|^2
        w      = (v_t + v_x . d) / (n . d)                                     of the numerator of t
        v_n    = -w x
        v_S_a  = v_u_a (x - 2 u_a S_a) / |S_a|^2 + S_b x v_n,   v_S_b likewise with v_n x S_a
        v_m    = w n - v_x,   v_mu = v_m,   v_O = -v_m,   v_d = t (v_x - w n)

    Parameters
    ----------
    polygons, rays, ray_ids, gaussian_ids
        As for :func:`meet`.
    v_unclamped, v_depths : ndarray of shape (H,)
        Derivatives with respect to its results.

    Returns
    -------
    IntersectionGradient
        Its shapes are with respect to the spans, [H, 3, 2].
    """
    found = meet(polygons, rays, ray_ids, gaussian_ids)
    S, d, x, t = polygons.spans[gaussian_ids], rays.directions[ray_ids], found.x, found.depths[:, None]
    n, squares = np.cross(S[:, :, 0], S[:, :, 1]), np.sum(S * S, axis=1)  # [H, 3], [H, 2]
    v_u = -(found.unclamped * v_unclamped)[:, None] * found.places / squares  # [H, 2] over |S_k|^2
    v_x = np.einsum("hik,hk->hi", S, v_u)
    w = ((v_depths + np.sum(v_x * d, axis=1)) / np.sum(n * d, axis=1))[:, None]
    v_n = -w * x
    v_S = v_u[:, None, :] * (x[:, :, None] - 2 * found.places[:, None, :] * S)
    v_S += np.stack([np.cross(S[:, :, 1], v_n), np.cross(v_n, S[:, :, 0])], axis=2)
    v_m = w * n - v_x
    v_opacities = found.unclamped / polygons.opacities[gaussian_ids] * v_unclamped
    return IntersectionGradient(v_m, v_S, v_opacities, -v_m, -t * v_m)


def prepare_meeting(polygons: Polygons) -> Meeting:
    """Return the intersection of rays with these polygons."""

    def alphas_and_depths(rays: Rays, ray_ids: Ints, gaussian_ids: Ints) -> tuple[Floats, Floats]:
        found = meet(polygons, rays, ray_ids, gaussian_ids)
        return found.unclamped, found.depths

    return Meeting(len(polygons.means), alphas_and_depths, lambda *args: meet_vjp(polygons, *args))
