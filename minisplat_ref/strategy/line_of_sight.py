"""Free lines of sight: where a photograph shows a sparse point, nothing may lie on the ray in front of it.

Structure from motion has found each sparse point in several photographs. In each of them the point lies on the ray
through its pixel at a known depth d, and whatever a model blends at less than ``(1 - margin) d`` on that ray cannot be
there: it is a *veil*, painted before one camera so that its photograph is right, and fog in every other view. For point
q and the hits i of its ray, front to back::

    w_qi = alpha_qi prod_{j < i} (1 - alpha_qj)       weight of hit i
    T_q  = prod_{z_i < (1 - margin) d_q} (1 - alpha_qi)      transmittance before the point

Urban radiance fields (2111.14643) make such a line of sight a loss; here it is a measure, and a reason to remove a
Gaussian. Left out: its derivative.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from minisplat_ref.reference.pinhole import project_into_image
from minisplat_ref.rendering import RenderSettings, activate, as_model
from minisplat_ref.types import Bools, Floats, Ints, Model, TileGrid, View

MARGIN = 0.1
"""Part of the depth of a point within which a Gaussian may belong to the point's surface."""
OPAQUE = 0.5
"""Transmittance below which a point counts as hidden."""


class SightLines(NamedTuple):
    """The hits on the rays to the sparse points of a view, ray by ray, front to back."""

    rows: Ints
    """[M] Gaussian of the hit."""
    rays: Ints
    """[M] ray of the hit, an index from 0 to R - 1."""
    weights: Floats
    """[M] w, its weight on the ray."""
    is_before: Bools
    """[M] whether it is nearer than the point."""
    transmittances: Floats
    """[R] T of each ray before its point."""


def trace_sight_lines(model: Model, view: View, points: Floats, settings: RenderSettings, margin: float) -> SightLines:
    """Return the contributions that a view blends on the rays to its sparse points.

    Parameters
    ----------
    model : Model
        Of Gaussians, which are rendered as they are: without exposures, poses or a sky.
    view : View
        With ``point_ids``.
    points : ndarray of shape (P, 3)
        Sparse points of the scene, world frame.
    settings : RenderSettings
        Conventions and backend.
    margin : float
        Part of the depth of a point.
    """
    camera, conventions, backend = view.camera, settings.conventions, settings.backend
    _, xy, d = project_into_image(points[view.point_ids], camera)
    p = backend.project(*activate(model.gaussians), camera, conventions)
    grid = TileGrid(camera.width, camera.height, backend.tile_width, backend.tile_height)
    bins = backend.bin_gaussians(p, grid, conventions)
    column, row = xy.astype(int).T
    tile = row // grid.tile_height * grid.n_tiles_x + column // grid.tile_width  # [R]
    first, n = bins.tile_offsets[tile], np.diff(bins.tile_offsets)[tile]  # [R] pairs of each ray
    starts = np.cumsum(n) - n
    rays = np.repeat(np.arange(len(tile)), n)  # [M]
    rows = bins.gaussian_ids[np.arange(len(rays)) - np.repeat(starts - first, n)]
    dx, dy = (np.stack([column, row], axis=1)[rays] + 0.5 - p.means2d[rows]).astype(np.float64).T
    a, b, c = p.conics[rows].T
    alpha = p.opacities[rows] * np.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alpha = np.where(alpha < conventions.alpha_min, 0.0, np.minimum(alpha, conventions.alpha_max))
    logs = np.concatenate([[0.0], np.cumsum(np.log1p(-alpha))])  # [M + 1]
    T = np.exp(logs[:-1] - np.repeat(logs[starts], n))  # [M] before the hit
    is_before = p.depths[rows] < (1.0 - margin) * d[rays]
    absorbed = np.bincount(rays, np.where(is_before, np.log1p(-alpha), 0.0), minlength=len(tile))
    is_hit = alpha > 0
    return SightLines(rows[is_hit], rays[is_hit], (alpha * T)[is_hit], is_before[is_hit], np.exp(absorbed))


def hidden_share(
    model: Model, views: Sequence[View], points: Floats, settings: RenderSettings, margin: float = MARGIN
) -> float | None:
    """Return the fraction of the sparse points, view by view, that a model hides; None if no view has any.

    Parameters
    ----------
    model : Model or Gaussians
    views : sequence of View
    points : ndarray of shape (P, 3)
        World frame.
    settings : RenderSettings
    margin : float
        As for :func:`trace_sight_lines`.
    """
    n_hidden = n_points = 0
    for view in views:
        if view.point_ids is not None and len(view.point_ids):
            T = trace_sight_lines(as_model(model), view, points, settings, margin).transmittances
            n_hidden, n_points = n_hidden + int(np.count_nonzero(OPAQUE > T)), n_points + len(T)
    return n_hidden / n_points if n_points else None
