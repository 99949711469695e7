"""Synthetic scenes, stage 1: intersections of rays with rectangles, boxes, spheres and cylinders, in closed form.

A ray is ``origin + t * direction`` with a direction of any length; an intersection is the smallest t > 0, infinity
where there is none. Every shape lies in its own frame, centred at 0 and aligned with the axes. No triangle meshes.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from minisplat_ref.types import Bools, Floats

TINY_RADIUS = 1e-30  # instead of a radius of zero on a cylinder's axis, where the side has no normal


class Shape(Protocol):
    """A solid or a sheet in its own frame."""

    @property
    def bound_radius(self) -> float:
        """Radius of a sphere around 0 that holds the shape; infinite when it is not worth testing."""

    def distances(self, origins: Floats, directions: Floats) -> Floats:
        """[n] ray parameter t of the first intersection; infinity where there is none.

        Parameters
        ----------
        origins : ndarray of shape (3,) or (n, 3)
            Shape's frame, world units.
        directions : ndarray of shape (n, 3)
            Shape's frame, no zero component.
        """

    def normals(self, points: Floats) -> Floats:
        """[n, 3] outward unit normals at points [n, 3] of the surface, both in the shape's frame."""


@dataclass(frozen=True)
class Rectangle:
    """The part ``|x| <= half_x, |y| <= half_y`` of the plane z = 0, seen from both sides."""

    half_x: float
    half_y: float

    @property
    def bound_radius(self) -> float:
        """Return infinity: walls and floors fill the view, so a test that rejects nothing would only cost time."""
        return np.inf

    def distances(self, origins: Floats, directions: Floats) -> Floats:
        """Plane equation: t = -o_z / d_z."""
        t = -origins[..., 2] / directions[:, 2]  # [n]
        x = origins[..., 0] + t * directions[:, 0]
        y = origins[..., 1] + t * directions[:, 1]
        is_hit = (t > 0) & (np.abs(x) <= self.half_x) & (np.abs(y) <= self.half_y)
        return np.where(is_hit, t, np.inf)

    def normals(self, points: Floats) -> Floats:
        """The z axis everywhere."""
        return np.broadcast_to(np.array([0.0, 0.0, 1.0]), points.shape)


@dataclass(frozen=True)
class Box:
    """``|x| <= half_x, |y| <= half_y, |z| <= half_z``."""

    half_x: float
    half_y: float
    half_z: float

    @property
    def bound_radius(self) -> float:
        """Half the diagonal."""
        return float(np.linalg.norm([self.half_x, self.half_y, self.half_z]))

    def distances(self, origins: Floats, directions: Floats) -> Floats:
        """The ray is inside between the last entry into and the first exit from three slabs."""
        entry, leave = _slab(origins, directions, 0, self.half_x)  # [n]
        for axis, half in ((1, self.half_y), (2, self.half_z)):
            slab_entry, slab_leave = _slab(origins, directions, axis, half)
            entry, leave = np.maximum(entry, slab_entry), np.minimum(leave, slab_leave)
        return _first_positive(entry, leave, entry <= leave)

    def normals(self, points: Floats) -> Floats:
        """The axis of the face that is nearest to the point."""
        half = np.array([self.half_x, self.half_y, self.half_z])
        axes = np.argmin(np.abs(half - np.abs(points)), axis=1)  # [n]
        rows = np.arange(len(points))
        normals = np.zeros_like(points)
        normals[rows, axes] = np.sign(points[rows, axes])
        return normals


@dataclass(frozen=True)
class Sphere:
    """``|p| <= radius``."""

    radius: float

    @property
    def bound_radius(self) -> float:
        """The sphere itself."""
        return self.radius

    def distances(self, origins: Floats, directions: Floats) -> Floats:
        """Roots of |o + t d|^2 = radius^2."""
        a = dot(directions, directions)  # [n]
        half_b = dot(origins, directions)
        c = dot(origins, origins) - self.radius**2
        discriminant = half_b**2 - a * c
        root = np.sqrt(np.maximum(discriminant, 0.0))
        return _first_positive((-half_b - root) / a, (-half_b + root) / a, discriminant >= 0)

    def normals(self, points: Floats) -> Floats:
        """Radial."""
        return points / np.linalg.norm(points, axis=1, keepdims=True)


@dataclass(frozen=True)
class Cylinder:
    """``x^2 + y^2 <= radius^2, |z| <= half_length``, closed by two discs."""

    radius: float
    half_length: float

    @property
    def bound_radius(self) -> float:
        """Distance of the rim."""
        return float(np.hypot(self.radius, self.half_length))

    def distances(self, origins: Floats, directions: Floats) -> Floats:
        """The interval inside the infinite tube, cut with the interval between the caps."""
        (x, y), (dx, dy) = origins[..., :2].T, directions[:, :2].T
        a = dx**2 + dy**2  # [n]
        half_b = x * dx + y * dy
        c = x**2 + y**2 - self.radius**2
        discriminant = half_b**2 - a * c
        root = np.sqrt(np.maximum(discriminant, 0.0))
        bottom, top = _slab(origins, directions, 2, self.half_length)
        entry = np.maximum((-half_b - root) / a, bottom)
        leave = np.minimum((-half_b + root) / a, top)
        return _first_positive(entry, leave, (discriminant >= 0) & (entry <= leave))

    def normals(self, points: Floats) -> Floats:
        """The axis on the caps, radial on the side, whichever is nearer to the point."""
        radial = np.hypot(points[:, 0], points[:, 1])  # [n]
        is_cap = np.abs(self.half_length - np.abs(points[:, 2])) < np.abs(self.radius - radial)
        side = points * np.array([1.0, 1.0, 0.0]) / np.maximum(radial, TINY_RADIUS)[:, None]  # [n, 3]
        cap = np.sign(points[:, 2:]) * np.array([0.0, 0.0, 1.0])
        return np.where(is_cap[:, None], cap, side)


def _slab(origins: Floats, directions: Floats, axis: int, half: float) -> tuple[Floats, Floats]:
    """[n] ray parameters of entry into and exit from the slab between -half and half across an axis."""
    middle = -origins[..., axis] / directions[:, axis]
    width = half / np.abs(directions[:, axis])
    return middle - width, middle + width


def _first_positive(entry: Floats, leave: Floats, is_hit: Bools) -> Floats:
    """Return the entry if it lies ahead, the exit for a ray that starts inside, infinity for a miss."""
    t = np.where(entry > 0, entry, leave)
    return np.where(is_hit & (t > 0), t, np.inf)


def dot(a: Floats, b: Floats) -> Floats:
    """Return the inner product along the last axis; either argument may be one vector for all."""
    if b.ndim == 2 and a.ndim == 1:
        return b @ a
    return np.einsum("...i,...i->...", a, b)
