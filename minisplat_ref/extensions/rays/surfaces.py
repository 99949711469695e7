"""Triangles among the Gaussians: intersection with rays, reflection and refraction.

The intersection of the ray ``O + t d`` with the triangle p0, p1, p2 follows from Cramer's rule (Moeller and Trumbore
1997), with ``e1 = p1 - p0``, ``e2 = p2 - p0``, ``s = O - p0`` and ``D = e1 . (d x e2)``:

    u = s . (d x e2) / D,   v = d . (s x e1) / D,   t = e2 . (s x e1) / D;    hit if u, v >= 0 and u + v <= 1

A ray that continues from x = O + t d in the direction d' keeps its t; its origin becomes ``x - t d'``, the apparent
position of the eye. Behind a mirror this is exactly the mirrored camera.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.mechanisms.rays.pixel_rays import Rays
from minisplat_ref.types import Bools, Floats, Ints

PAIRS_AT_ONCE = 1 << 18  # of rays and triangles: some ten arrays of 3 float64, 60 MB
NONE = -1
AWAY = 1e-7  # fraction of t by which a ray starts off the surface that it leaves
DIFFUSE, MIRROR, GLASS = range(3)


class Surfaces(NamedTuple):
    """Triangles and their materials."""

    corners: Floats
    """[F, 3, 3] triangle, corner, axis; world frame."""
    normals: Floats
    """[F, 3] unit normals, which point out of glass."""
    kinds: Ints
    """[F] ``DIFFUSE``, ``MIRROR`` or ``GLASS``."""
    colors: Floats
    """[F, 3] fraction of the light that is reflected or transmitted."""
    indices: Floats
    """[F] index of refraction."""


def normals_of(corners: Floats) -> Floats:
    """Return the unit normals [F, 3] of triangles [F, 3, 3] that have an area."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    unit: Floats = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return unit


def nearest_triangles(corners: Floats, rays: Rays) -> tuple[Floats, Ints]:
    """Return the first triangle on each ray between its limits.

    Parameters
    ----------
    corners : ndarray of shape (F, 3, 3)
        Triangles; F may be 0.
    rays : Rays
        P rays.

    Returns
    -------
    depths : ndarray of shape (P,)
        t; infinite where there is none.
    faces : ndarray of shape (P,)
        Rows of the triangles; ``NONE`` where there is none.
    """
    n_rays = len(rays.near)
    depths, faces = np.full(n_rays, np.inf), np.full(n_rays, NONE)
    if len(corners) == 0:
        return depths, faces
    p0, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    step = max(1, PAIRS_AT_ONCE // len(corners))
    for first in range(0, n_rays, step):
        part = slice(first, first + step)
        d, s = rays.directions[part, None], rays.origins[part, None] - p0  # [P', 1, 3], [P', F, 3]
        across, around = np.cross(d, e2), np.cross(s, e1)  # [P', F, 3]
        with np.errstate(divide="ignore", invalid="ignore"):  # D = 0: the ray is parallel to the triangle
            inverse = 1 / np.sum(e1 * across, axis=2)  # [P', F]
            u, v = np.sum(s * across, axis=2) * inverse, np.sum(d * around, axis=2) * inverse
            t = np.sum(e2 * around, axis=2) * inverse
            is_hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > rays.near[part, None]) & (t < rays.far[part, None])
        t = np.where(is_hit, t, np.inf)
        nearest = np.argmin(t, axis=1)
        depths[part] = t[np.arange(len(t)), nearest]
        faces[part] = np.where(np.isfinite(depths[part]), nearest, NONE)
    return depths, faces


def continue_rays(rays: Rays, depths: Floats, directions: Floats) -> Rays:
    """Return rays [P] that leave ``O + t d`` in new directions [P, 3] of the same lengths and keep counting t."""
    points = rays.origins + depths[:, None] * rays.directions
    return Rays(points - depths[:, None] * directions, directions, depths, rays.far)


def reflect(directions: Floats, normals: Floats) -> Floats:
    """Return ``d' = d - 2 (d . n) n`` [P, 3]."""
    return directions - 2 * np.sum(directions * normals, axis=1, keepdims=True) * normals


def refract(directions: Floats, normals: Floats, indices: Floats) -> tuple[Floats, Floats, Bools]:
    """Return the refracted directions at the boundary of glass by Snell's law, and the reflected fraction by Schlick's.

    With the ratio r of the indices before and behind the boundary, c = |d . n| / |d| and n against the ray::

        d' = r d + (r c - c') |d| n,   c' = sqrt(1 - r^2 (1 - c^2))
        F  = F0 + (1 - F0) (1 - c_air)^5,   F0 = ((1 - r) / (1 + r))^2

    with the cosine on the side of the air, c or c'. Where ``r^2 (1 - c^2) > 1`` all is reflected.

    Parameters
    ----------
    directions : ndarray of shape (P, 3)
        d, of any length.
    normals : ndarray of shape (P, 3)
        Unit normals that point out of the glass; a ray along them leaves it.
    indices : ndarray of shape (P,)
        Indices of refraction of the glass.

    Returns
    -------
    directions : ndarray of shape (P, 3)
        d', of the same lengths; d where all is reflected.
    shares : ndarray of shape (P,)
        F in [0, 1]; 1 where all is reflected.
    is_total : ndarray of shape (P,) of booleans
        Where all is reflected.
    """
    lengths = np.linalg.norm(directions, axis=1)
    along = np.sum(directions * normals, axis=1) / lengths
    is_leaving = along > 0
    r = np.where(is_leaving, indices, 1 / indices)
    facing = np.where(is_leaving[:, None], -normals, normals)
    c = np.abs(along)
    squared = 1 - r**2 * (1 - c**2)
    is_total = squared < 0
    behind = np.sqrt(np.maximum(squared, 0))
    bent = r[:, None] * directions + ((r * c - behind) * lengths)[:, None] * facing
    F0 = ((1 - r) / (1 + r)) ** 2
    shares = F0 + (1 - F0) * (1 - np.where(is_leaving, behind, c)) ** 5
    return np.where(is_total[:, None], directions, bent), np.where(is_total, 1.0, shares), is_total
