"""Clearance of cameras: where a camera stands, and part of the way to all that is known around it, there is nothing.

A Gaussian beside a camera, outside its image, changes no pixel of its photograph. Photographs from the far side may
have made it: as their background it lies anywhere behind the scene, and there the cameras of the near side stand. Any
new camera near these sees it as fog, and no line of sight (:mod:`minisplat_ref.strategy.line_of_sight`) comes near it,
because no photograph shows a sparse point behind it. But a camera stands in free space, and structure from motion finds
the surfaces around it. So around each centre c there is a *free ball* of the radius ::

    r = share |q_k - c|          q_k: the k-th nearest of all sparse points, k = NEIGHBOUR

The sparse points of all photographs count. Those of its own tell nothing of what is beside it; and where another one
has found a surface (a macro photograph, a camera among leaves, the floor), that is evidence for the surface, and the
ball shrinks. A surface without features, like a white wall beside a camera, gives no such evidence; ``share`` leaves
room for it.

A Gaussian counts as far as it extends towards the camera. Widths add as squares where one blurs the other, so it is in
the ball if the camera is within n standard deviations of the Gaussian blurred by the ball::

    (c - m)^T (n^2 Sigma + r^2 I)^-1 (c - m) < 1

Of a small Gaussian the mean must be in the ball, of a large one the camera in its ellipsoid; a flat one beside the
camera, such as part of a wall or a floor, counts by its distance and its thickness, however long it is. To add the
widths themselves (whether a point of the ellipsoid is in the ball) would take surfaces that a training has not yet
sharpened for fog.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.types import Bools, Floats, Primitives, View

NEIGHBOUR = 3
"""One or two points nearer than all others may be mistakes of the matching; three are a surface."""
ROWS = 1024
"""Gaussians near cameras that are compared with all of them at a time, to bound the memory."""


class FreeBalls(NamedTuple):
    """The balls around B cameras in which there is nothing."""

    centers: Floats
    """[B, 3] world frame."""
    radii: Floats
    """[B] above 0, world units."""


def find_free_balls(views: Sequence[View], points: Floats, share: float) -> FreeBalls:
    """Return the free balls of the views that have tracks.

    Where no tracks are known, it is not known either that photographs show the points: they may be random ones.

    Parameters
    ----------
    views : sequence of View
        Those without ``point_ids`` have no ball; nor has an orthographic camera, whose rays have no centre.
    points : ndarray of shape (P, 3)
        All sparse points, world frame; with fewer than :data:`NEIGHBOUR` there is no ball.
    share : float
        Radius of the balls in units of the distance of the nearest points; with 0 there is no ball.
    """
    centers = np.array([view.camera.center for view in views if _has_ball(view)], np.float64).reshape(-1, 3)
    if len(points) < NEIGHBOUR or not len(centers):
        return FreeBalls(np.zeros((0, 3)), np.zeros(0))
    radii = share * cKDTree(points).query(centers, [NEIGHBOUR])[0][:, 0]
    return FreeBalls(centers[radii > 0], radii[radii > 0])


def are_in_free_balls(primitives: Primitives, balls: FreeBalls, n_sigmas: float) -> Bools:
    """Return which Gaussians [N] are in the free ball of a camera.

    Parameters
    ----------
    primitives : Primitives
        N Gaussians; opacities do not matter.
    balls : FreeBalls
    n_sigmas : float
        n, standard deviations up to which a Gaussian counts; with 0 its mean alone counts.
    """
    found = np.zeros(len(primitives.means), bool)
    if not len(found) or not len(balls.radii):
        return found
    longest = n_sigmas * primitives.scales.max(axis=1).astype(np.float64)  # [N]
    nearest = cKDTree(balls.centers).query(primitives.means)[0]
    candidates = np.flatnonzero(nearest < np.hypot(longest, balls.radii.max()))
    for start in range(0, len(candidates), ROWS):
        rows = candidates[start : start + ROWS]
        are_near = cdist(primitives.means[rows], balls.centers) < np.hypot(longest[rows, None], balls.radii)
        i, cameras = np.nonzero(are_near)
        rows = rows[i]  # [M] pairs of a Gaussian and a camera
        offsets = balls.centers[cameras] - primitives.means[rows]
        along_axes = np.einsum("mij,mi->mj", rotation_matrices(primitives.quats[rows]), offsets)  # R^T (c - m)
        widths = np.hypot(n_sigmas * primitives.scales[rows].astype(np.float64), balls.radii[cameras, None])
        found[rows[((along_axes / widths) ** 2).sum(axis=1) < 1]] = True
    return found


def _has_ball(view: View) -> bool:
    optics = view.camera.optics
    return view.point_ids is not None and len(view.point_ids) > 0 and (optics is None or not optics.is_parallel)
