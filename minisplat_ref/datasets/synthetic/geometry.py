"""Synthetic scenes, stage 2: shapes placed in the world, and the first of them that a ray hits.

Placing is a rotation and a translation, which keep the ray parameter t, so that distances need no conversion. Nothing
is transparent, and there is no acceleration structure: a bounding sphere each is enough for a few dozen primitives.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from minisplat_ref.datasets.synthetic.materials import Material
from minisplat_ref.datasets.synthetic.shapes import Shape, dot
from minisplat_ref.types import Floats, Ints

TINY = 1e-30  # added to directions: changes only a zero component, so that a parallel ray gives 1e30 instead of 0/0


class Primitive(NamedTuple):
    """A shape placed in the world, with its material."""

    shape: Shape
    """Geometry in its own frame."""
    material: Material
    """Colour and gloss."""
    centre: Floats
    """[3] world frame."""
    world_from_local_R: Floats
    """[3, 3] rotation."""
    casts_shadow: bool = True
    """False for walls and the ground, which have nothing behind them, and for the thinnest rods."""

    def to_local(self, points: Floats) -> Floats:
        """World points [n, 3] in the shape's frame."""
        return (points - self.centre) @ self.world_from_local_R

    def distances(self, origins: Floats, directions: Floats) -> Floats:
        """[n] ray parameter t of the first intersection, infinity where there is none; rays in the world frame."""
        return self.shape.distances(self.to_local(origins), directions @ self.world_from_local_R + TINY)

    def normals(self, points: Floats) -> Floats:
        """[n, 3] outward unit normals at surface points [n, 3], world frame."""
        return self.shape.normals(self.to_local(points)) @ self.world_from_local_R.T


class Hits(NamedTuple):
    """The first hits of n rays."""

    distances: Floats
    """[n] ray parameter t, infinity where nothing is hit."""
    primitive_ids: Ints
    """[n] int16 index of the primitive, -1 where nothing is hit."""


def first_hits(primitives: tuple[Primitive, ...], origins: Floats, directions: Floats) -> Hits:
    """Return the nearest intersection of every ray with the primitives.

    Parameters
    ----------
    primitives : tuple of Primitive
        The world.
    origins : ndarray of shape (3,) or (n, 3)
        World frame; one for all rays or one for each.
    directions : ndarray of shape (n, 3)
        World frame, any length.

    Returns
    -------
    Hits
        The first hit of each ray.
    """
    unit = directions / np.sqrt(dot(directions, directions))[:, None]  # [n, 3]
    nearest = np.full(len(directions), np.inf)
    primitive_ids = np.full(len(directions), -1, np.int16)
    for index, primitive in enumerate(primitives):
        if np.isinf(primitive.shape.bound_radius):
            t = primitive.distances(origins, directions)
            winners: Ints = np.flatnonzero(t < nearest)
            nearest[winners] = t[winners]
        else:
            rays = _rays_near(primitive, origins, unit)
            near_origins = origins if origins.ndim == 1 else take_rows(origins, rays)
            t = primitive.distances(near_origins, take_rows(directions, rays))
            is_nearer = t < nearest[rays]
            winners = rays[is_nearer]
            nearest[winners] = t[is_nearer]
        primitive_ids[winners] = index
    return Hits(nearest, primitive_ids)


def rays_by_primitive(primitives: tuple[Primitive, ...], hits: Hits) -> Iterator[tuple[Primitive, Ints]]:
    """Yield every primitive that is hit, with the ids [m] of the rays that hit it."""
    order = np.argsort(hits.primitive_ids, kind="stable")
    bounds = np.searchsorted(hits.primitive_ids[order], np.arange(len(primitives) + 1))
    for index in np.flatnonzero(np.diff(bounds)):
        yield primitives[index], order[bounds[index] : bounds[index + 1]]


def facing_normals(primitives: tuple[Primitive, ...], hits: Hits, points: Floats, directions: Floats) -> Floats:
    """[n, 3] unit normals on the side from which the rays come, world frame; 0 where nothing is hit.

    Parameters
    ----------
    primitives : tuple of Primitive
        The world.
    hits : Hits
        First hits of the n rays.
    points : ndarray of shape (n, 3)
        Hit points, world frame; any value where nothing is hit.
    directions : ndarray of shape (n, 3)
        Of the rays, world frame.
    """
    normals = np.zeros_like(directions)
    for primitive, rays in rays_by_primitive(primitives, hits):
        normals[rays] = primitive.normals(take_rows(points, rays))
    return np.where(dot(normals, directions)[:, None] > 0, -normals, normals)


def take_rows(array: Floats, ids: Ints) -> Floats:
    """Return ``array[ids]`` of an array [n, 3]: numpy.take copies whole rows and is five times as fast."""
    return array.take(ids, axis=0)


def _rays_near(primitive: Primitive, origins: Floats, unit_directions: Floats) -> Ints:
    """Return ids of the rays that enter the bounding sphere, so that small objects are tested against few rays.

    Seen from outside, a sphere fills the cone ``cos(angle) >= sqrt(distance^2 - radius^2) / distance``.
    """
    to_centre = primitive.centre - origins  # [3] or [n, 3]
    outside = dot(to_centre, to_centre) - primitive.shape.bound_radius**2  # [] or [n]
    least = np.where(outside > 0, np.sqrt(np.maximum(outside, 0.0)), -np.inf)  # every ray from inside is near
    return np.flatnonzero(dot(to_centre, unit_directions) >= least)
