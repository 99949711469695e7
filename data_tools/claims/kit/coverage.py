"""Coverage of a pixel: the number of other photographs that show what it shows.

A pixel whose surface no training photograph shows cannot be rendered rightly, except by luck; its error says nothing
about a recipe. So that recipes cannot influence what counts, coverage is computed from the sparse points alone: the
depth of each photograph is interpolated between the points that structure from motion found in it, linearly in 1/z, and
the surface point of each pixel is projected into the training photographs. One of them shows the point if it lies
inside the image and, where that is known, not far behind the interpolated surface there.

Left out: occlusion by what no sparse point lies on.
"""

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

from minisplat_ref.reference.pinhole import pinhole_rays, project_into_image
from minisplat_ref.types import Floats, Ints, View

POINTS_MIN = 8
"""Sparse points that a photograph needs for an interpolated depth."""
BEHIND = 1.2
"""A point farther than this times the interpolated depth is behind the surface: twice the tenth by which the depth
between sparse points is commonly wrong."""
STRIDE = 4
"""Pixels; coverage is computed for one pixel in a square of this side and holds for the square."""


def count_covering_views(view: View, others: Sequence[View], points: Floats) -> Ints | None:
    """Return how many of the other views show the surface at each pixel.

    Parameters
    ----------
    view : View
    others : sequence of View
        Training views.
    points : ndarray of shape (P, 3)
        Sparse points, world frame.

    Returns
    -------
    ndarray of shape (H, W), int, or None
        None where the view has too few sparse points, or the scene has no tracks.
    """
    camera = view.camera
    columns, rows = (np.arange(0, side, STRIDE) + 0.5 for side in (camera.width, camera.height))
    xy = np.stack(np.meshgrid(columns, rows), axis=-1)  # [h, w, 2] pixels
    depths = interpolate_depths(view, points, xy)
    if depths is None:
        return None
    rays = pinhole_rays(xy[..., 0], xy[..., 1], camera)  # [h, w, 3] camera frame
    surface = (rays * depths[..., None] - camera.cam_from_world_t) @ camera.cam_from_world_R  # [h, w, 3] world frame
    counts = np.zeros(xy.shape[:2], int)
    for other in others:
        counts += _shows(other, surface, points)
    return np.repeat(np.repeat(counts, STRIDE, axis=0), STRIDE, axis=1)[: camera.height, : camera.width]


def interpolate_depths(view: View, points: Floats, xy: Floats) -> Floats | None:
    """Return the depth at pixels (x, y) [..., 2] between the sparse points of a view, [...]; None if it has too few."""
    if view.point_ids is None or len(view.point_ids) < POINTS_MIN:
        return None
    _, uv, z = project_into_image(points[view.point_ids], view.camera)
    if len(z) < POINTS_MIN:
        return None
    flat = xy.reshape(-1, 2)
    inverse = LinearNDInterpolator(uv, 1.0 / z)(flat)
    outside = np.isnan(inverse)
    inverse[outside] = NearestNDInterpolator(uv, 1.0 / z)(flat[outside])
    return (1.0 / inverse).reshape(xy.shape[:-1])


def _shows(view: View, surface: Floats, points: Floats) -> Ints:
    """Return for surface points [h, w, 3] whether a view shows them."""
    here, uv, z = project_into_image(surface.reshape(-1, 3), view.camera)
    depths = interpolate_depths(view, points, uv) if len(here) else None
    is_shown = np.zeros(surface.shape[0] * surface.shape[1], int)
    is_shown[here] = 1 if depths is None else z < BEHIND * depths
    return is_shown.reshape(surface.shape[:2])
