"""Exact search for the triangle of a mesh that is nearest to a point.

The distance of x from a triangle is that from its plane, if the projection of x lies inside, and otherwise the least of
those from its three sides. Comparing every point with every triangle takes long; so a k-d tree of the triangles'
centres proposes the k nearest ones. A triangle extends no farther from its centre than r, the largest such distance in
the mesh, so if the best of the k lies nearer than the k-th centre less r, no other can be better. The points for which
this does not hold are searched again with more candidates.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from minisplat_ref.mechanisms.meshes.mesh import Mesh
from minisplat_ref.types import Floats, Ints

FIRST_CANDIDATES = 8
PAIRS_AT_ONCE = 1 << 18  # of points and triangles; a dozen arrays of 3 float64 each, so 75 MB


class Nearest(NamedTuple):
    """The nearest triangle of each point."""

    faces: Ints
    """[N] rows of the mesh's faces; of several that are equally near, the first."""
    distances: Floats
    """[N] world units."""


def triangle_distances(points: Floats, corners: Floats) -> Floats:
    """Return the distances of points from triangles.

    With the sides ``s_k = p_{k+1} - p_k`` and the normal n of a triangle, the projection of x lies inside where
    ``n . (s_k x (x - p_k)) >= 0`` for all k; the nearest point of a side is ``p_k + clip(t, 0, 1) s_k`` with
    ``t = s_k . (x - p_k) / s_k^2``.

    Parameters
    ----------
    points : ndarray of shape (..., 3)
        World frame.
    corners : ndarray of shape (..., 3, 3)
        World frame: triangle, corner, axis. Every triangle has an area.

    Returns
    -------
    ndarray of shape (...,)
        World units.
    """
    sides = np.roll(corners, -1, axis=-2) - corners  # [..., 3, 3]
    to_point = points[..., None, :] - corners  # [..., 3, 3]
    n = np.cross(sides[..., 0, :], sides[..., 1, :])
    n = n / np.linalg.norm(n, axis=-1, keepdims=True)  # [..., 3]
    is_inside = (np.einsum("...i,...ki->...k", n, np.cross(sides, to_point)) >= 0).all(axis=-1)
    t = np.clip(np.sum(sides * to_point, axis=-1) / np.sum(sides * sides, axis=-1), 0, 1)  # [..., 3]
    from_sides = np.linalg.norm(to_point - t[..., None] * sides, axis=-1).min(axis=-1)
    from_plane = np.abs(np.sum(n * to_point[..., 0, :], axis=-1))
    return np.where(is_inside, from_plane, from_sides)


def nearest_triangles(
    points: Floats, mesh: Mesh, progress: Callable[[Iterable[Ints]], Iterable[Ints]] = iter
) -> Nearest:
    """Return the nearest triangle of each point.

    Parameters
    ----------
    points : ndarray of shape (N, 3)
        World frame.
    mesh : Mesh
        It has at least one triangle, and every triangle has an area.
    progress : callable
        Wraps the batches in which points are searched, as :func:`~minisplat_ref.interface.progress.with_progress`.
    """
    points = points.astype(np.float64)
    centres = mesh.corners.mean(axis=1)  # [T, 3]
    reach = np.linalg.norm(mesh.corners - centres[:, None], axis=2).max()  # r
    tree = cKDTree(centres)
    faces, distances = np.zeros(len(points), np.int64), np.zeros(len(points))
    parts = np.array_split(np.arange(len(points)), max(1, len(points) * FIRST_CANDIDATES // PAIRS_AT_ONCE))
    for part in progress(parts):
        rows, k = part, min(FIRST_CANDIDATES, len(centres))
        while len(rows):
            n_at_once = max(1, PAIRS_AT_ONCE // k)
            is_settled = []
            for some in np.array_split(rows, -(-len(rows) // n_at_once)):
                to_centres, candidates = tree.query(points[some], k=np.arange(1, k + 1))  # [N', k], nearest first
                order = np.argsort(candidates, axis=1)  # the first face of equally near ones
                candidates = np.take_along_axis(candidates, order, axis=1)
                found = triangle_distances(points[some, None], mesh.corners[candidates])  # [N', k]
                best = found.argmin(axis=1)[:, None]  # [N', 1]
                faces[some] = np.take_along_axis(candidates, best, axis=1)[:, 0]
                distances[some] = np.take_along_axis(found, best, axis=1)[:, 0]
                is_settled.append(distances[some] < to_centres[:, -1] - reach)
            rows = rows[~np.concatenate(is_settled)] if k < len(centres) else rows[:0]
            k = min(4 * k, len(centres))
    return Nearest(faces, distances)
