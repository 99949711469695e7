"""The choice of the Gaussians that a view shows, and their coverage in pixels, in NumPy.

A camera of focal length f shows ``c = f / z`` pixels per world unit at depth z. A cell of side w, a cube in which
Gaussians were merged into one, covers w c pixels per side there.
"""

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.types import Bools, Camera, Floats

NO_CELL = float(np.finfo(np.float32).max)  # the side of the parent's cell where there is no parent: never too small


def pixel_densities(means: Floats, camera: Camera, near_plane: float) -> Floats:
    """Return the densities ``c = sqrt(fx fy) / z`` of centres.

    Parameters
    ----------
    means : ndarray of shape (N, 3)
        Centres, world frame.
    camera : Camera
        Pose and focal lengths are used.
    near_plane : float
        Least z, world units; nearer centres count as at this depth.

    Returns
    -------
    ndarray of shape (N,)
        Pixels per world unit, in the dtype of the means.
    """
    z = means @ camera.cam_from_world_R[2].astype(means.dtype) + means.dtype.type(camera.cam_from_world_t[2])
    return means.dtype.type(np.sqrt(camera.fx * camera.fy)) / np.maximum(z, means.dtype.type(near_plane))


def are_shown(cells: Floats, densities: Floats) -> Bools:
    """Return which Gaussians a view shows, [N].

    ::

        w c < 1 <= w' c

    with the side w of a Gaussian's own cell and w' of its parent's. So the members of a cell are replaced by their
    parent exactly where the cell shrinks below a pixel.

    Parameters
    ----------
    cells : ndarray of shape (N, 2)
        World units: w, 0 where nothing was merged into the Gaussian, and w', ``NO_CELL`` where it has no parent.
    densities : ndarray of shape (N,)
        c, pixels per world unit.
    """
    with np.errstate(over="ignore"):
        own, parent = (cells * densities[:, None]).T
    return (own < 1) & (parent >= 1)


def coverages(log_scales: Floats, opacity_logits: Floats, densities: Floats, conventions: Conventions) -> Floats:
    """Return the width in pixels of each Gaussian, seen face on.

    The ellipse in which alpha is at least ``alpha_min`` has, for a standard deviation s, the width::

        S = 2 sqrt(2 ln(o / alpha_min)) s c

    s is the middle one of the three, so a flat Gaussian counts as wide in any orientation; otherwise it would disappear
    when seen edge on.

    Parameters
    ----------
    log_scales : ndarray of shape (N, 3)
        World units.
    opacity_logits : ndarray of shape (N,)
    densities : ndarray of shape (N,)
        c, pixels per world unit.
    conventions : Conventions
        ``alpha_min`` is used.

    Returns
    -------
    ndarray of shape (N,)
        Pixels; 0 where the Gaussian is too faint to be seen.
    """
    log_opacities = -np.logaddexp(0, -opacity_logits)
    reach = np.sqrt(2 * np.maximum(log_opacities - np.log(conventions.alpha_min), 0))
    S: Floats = 2 * reach * np.exp(np.sort(log_scales, axis=1)[:, 1]) * densities
    return S
