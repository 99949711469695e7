"""Local planes: principal axes of the nearest neighbours of each point (Hoppe et al. 1992).

With the k nearest points p_j of a point, itself among them, and their mean m, the axes are the eigenvectors of

    C = 1/k sum_j (p_j - m) (p_j - m)^T

and the normal is that of the least eigenvalue. The outside is unknown, so normals are turned towards
places that see the point, such as the cameras, where these are known.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from minisplat_ref.errors import InputError
from minisplat_ref.types import Floats, Gaussians

N_NEIGHBOURS = 12
N_AXES = 3
FLATNESS = 0.3  # thickness of a Gaussian at the start, relative to its radius


class LocalPlanes(NamedTuple):
    """The plane around each point, world frame."""

    centers: Floats
    """[P, 3] m, on the plane."""
    axes: Floats
    """[P, 3, 3] columns are the unit axes, the widest first; right-handed, and the last is the normal."""
    deviations: Floats
    """[P, 3] standard deviations along them, world units."""

    @property
    def normals(self) -> Floats:
        """[P, 3] unit normals."""
        return self.axes[:, :, 2]

    def project(self, points: Floats) -> Floats:
        """Return the nearest places [P, 3] on the planes to points [P, 3]."""
        offsets = np.sum((points - self.centers) * self.normals, axis=1, keepdims=True)
        return points - offsets * self.normals


def fit_planes(points: Floats, n_neighbours: int = N_NEIGHBOURS, towards: Floats | None = None) -> LocalPlanes:
    """Return the plane around each point.

    Parameters
    ----------
    points : ndarray of shape (P, 3)
        World frame.
    n_neighbours : int
        k; fewer if there are not enough points.
    towards : ndarray of shape (C, 3), optional
        Places from which the surface is seen: each normal is turned to the nearest of them.

    Raises
    ------
    InputError
        There are fewer than 3 points.
    """
    if len(points) < N_AXES:
        raise InputError(f"points has {len(points)} rows, a plane needs {N_AXES}: give more points")
    points = np.asarray(points, float)
    _, ids = cKDTree(points).query(points, min(n_neighbours, len(points)))  # [P, k]
    near = points[ids]
    centers = near.mean(axis=1)
    apart = near - centers[:, None]
    values, vectors = np.linalg.eigh(np.einsum("pki,pkj->pij", apart, apart) / near.shape[1])
    axes = vectors[:, :, ::-1].copy()  # the widest first
    if towards is not None:
        nearest = towards[cKDTree(towards).query(points)[1]]
        axes[:, :, 2] *= np.where(np.sum(axes[:, :, 2] * (nearest - points), axis=1) < 0, -1.0, 1.0)[:, None]
    axes[:, :, 1] *= np.sign(np.linalg.det(axes))[:, None]
    return LocalPlanes(centers, axes, np.sqrt(np.maximum(values[:, ::-1], 0)))


def flatten_on_planes(gaussians: Gaussians, centers: Floats) -> Gaussians:
    """Return Gaussians at ``centers`` [N, 3], flattened onto the planes of their neighbours there.

    Raises
    ------
    InputError
        There are fewer than 3.
    """
    dtype = gaussians.means.dtype
    quats = Rotation.from_matrix(fit_planes(centers).axes).as_quat()[:, [3, 0, 1, 2]]
    log_scales = gaussians.log_scales.copy()
    log_scales[:, 2] += np.log(FLATNESS)
    return gaussians._replace(means=centers.astype(dtype), quats=quats.astype(dtype), log_scales=log_scales)
