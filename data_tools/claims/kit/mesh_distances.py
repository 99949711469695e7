"""Distances of a mesh from the truth: accuracy, completeness, Chamfer distance, F-score, error of the normals.

With P points drawn on the mesh and the points Q of the true surface, and ``d(p, Q)`` the distance to the nearest point:

    accuracy     = mean over P of d(p, Q)          what is there and should not be
    completeness = mean over Q of d(q, P)          what should be there and is not
    Chamfer      = (accuracy + completeness) / 2
    F            = 2 A C / (A + C)                 A, C: shares of P and of Q within tau of the other

The normals of P are compared with those of the nearest of Q, without regard to their sign.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from minisplat_ref.mechanisms.oriented.thin_axis import angles_between
from minisplat_ref.types import Floats, Ints


class OrientedPoints(NamedTuple):
    """Points of a surface with its normals there."""

    points: Floats
    """[P, 3] world frame."""
    normals: Floats
    """[P, 3] of length 1."""


class Distances(NamedTuple):
    """A mesh against the truth; lengths in world units."""

    accuracy: float
    completeness: float
    f_score: float
    """In [0, 1]."""
    normal_error: float
    """Degrees, mean."""

    @property
    def chamfer(self) -> float:
        """Mean of accuracy and completeness."""
        return (self.accuracy + self.completeness) / 2


def sample_surface(vertices: Floats, faces: Ints, n: int, rng: np.random.Generator) -> OrientedPoints:
    """Draw n points on a mesh, uniformly by area.

    Parameters
    ----------
    vertices : ndarray of shape (P, 3)
        World frame.
    faces : ndarray of shape (T, 3)
        At least one triangle with an area.
    n : int
    rng : Generator
    """
    p0, p1, p2 = np.moveaxis(vertices[faces], 1, 0)
    across = np.cross(p1 - p0, p2 - p0)  # [T, 3] twice the area
    areas = np.linalg.norm(across, axis=1)
    chosen = rng.choice(len(faces), n, p=areas / areas.sum())
    a, b = rng.random((2, n, 1))
    is_beyond = a + b > 1  # the other half of the parallelogram
    a, b = np.where(is_beyond, 1 - a, a), np.where(is_beyond, 1 - b, b)
    points = p0[chosen] + a * (p1 - p0)[chosen] + b * (p2 - p0)[chosen]
    return OrientedPoints(points, across[chosen] / areas[chosen, None])


def compare_surfaces(found: OrientedPoints, truth: OrientedPoints, tau: float) -> Distances:
    """Return the distances between points of a mesh and of the true surface; ``tau`` in world units."""
    to_truth, nearest = cKDTree(truth.points).query(found.points)
    to_found, _ = cKDTree(found.points).query(truth.points)
    precision, recall = float(np.mean(to_truth <= tau)), float(np.mean(to_found <= tau))
    return Distances(
        float(to_truth.mean()),
        float(to_found.mean()),
        2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0,
        float(angles_between(found.normals, truth.normals[nearest]).mean()),
    )
