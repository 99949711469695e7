"""A dense start: surface points between the sparse ones, by stereo on small photographs.

How many points structure from motion finds depends on the features and on the light, not on how much there is to model.
A training that starts from few of them grows into the air: it ends with few Gaussians, and with fog before cameras. So
each photograph, made small, is compared with those that share most points with it
(:mod:`minisplat_ref.strategy.plane_sweep`), and what two of them agree on becomes a point, unless there is one within a
few pixels already: rich and poor sparse points give a similar start. ``docs/measured/adaptive.md`` has what
this is worth.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from minisplat_ref.interface.progress import with_progress
from minisplat_ref.io.images import resize_image, resize_mask
from minisplat_ref.io.scene import rescale_camera
from minisplat_ref.reference.pinhole import project_into_image
from minisplat_ref.strategy.line_of_sight import MARGIN
from minisplat_ref.strategy.plane_sweep import (
    DepthMap,
    GrayView,
    are_confirmed,
    choose_planes,
    surface_points,
    sweep_planes,
)
from minisplat_ref.types import Bools, Floats, Ints, Scene, View, some_of

LONG_SIDE = 144
"""Pixels, of the small photographs: a sweep takes half a second."""
N_NEIGHBOURS = 4
"""Photographs that each is compared with, at most. No reason recorded."""
VIEWS_MAX = 32
"""Photographs that are compared, evenly spread, at most, so that the start takes less than half a minute."""
SPACING = 3.0
"""Pixels of the small photographs: nearer than this to another point no point is added."""
COMPANY, REACH = 3, 4.0
"""A point with fewer others within this many spacings is a mistake. No reason recorded for three and four."""
NEAR_A_RAY = 1.0
"""Pixels of the small photographs: a point is on the ray to a sparse point that is not farther from it."""
ANGLE_GOOD, ANGLE_MAX = 6.0, 40.0
"""Degrees between the rays to a point: from the first on depth is well determined, beyond the second windows look
different."""
POINTS_MIN = 8
"""Minimum number of sparse points of a photograph from which its depths are taken; with fewer, all in its image
count."""
DEPTH_MARGINS = (0.5, 2.0)
"""Factors of the depths of the nearest and the farthest hundredth of these points, between which planes are swept. The
ground before a photographer is nearer than the house that has the points, and what is nearer than all planes is found
at a wrong depth; nearer than half of the way, free balls say that there is nothing
(:mod:`minisplat_ref.strategy.camera_clearance`). Measured beside 0.7 and 0.35 (``docs/measured/adaptive.md``, U)."""
EXTENT_DEPTHS = (0.3, 20.0)
"""In units of the scene's extent: depths that are swept where a view has no points."""


class _Small(NamedTuple):
    gray_view: GrayView
    rgb: NDArray[np.uint8]  # [h, w, 3]
    mask: Bools | None  # [h, w]
    near: float  # depths between which planes are swept, world units
    far: float


def densify_points(scene: Scene) -> tuple[Floats, NDArray[np.uint8]]:
    """Return the sparse points of a scene, and points that stereo has found between them.

    Parameters
    ----------
    scene : Scene
        Its training photographs are compared.

    Returns
    -------
    points : ndarray of shape (P, 3)
        World frame; the sparse points first.
    colors : ndarray of shape (P, 3), uint8
    """
    views = some_of(scene.train_views, VIEWS_MAX)
    smalls = [_shrink(view.load(), *_depth_range(view, scene)) for view in views]
    neighbours = choose_neighbours(views, scene.points)
    jobs = list(zip(smalls, neighbours, strict=True))
    progress = with_progress(jobs, "stereo", "photographs")
    maps = [_sweep(small, [smalls[k].gray_view for k in near]) for small, near in progress]
    points, colors, spacings = scene.points, scene.point_colors, np.full(len(scene.points), np.inf)
    for small, own, near in zip(smalls, maps, neighbours, strict=True):
        is_confirmed = are_confirmed(small.gray_view, own, [(smalls[k].gray_view, maps[k]) for k in near])
        rows, columns = np.nonzero(is_confirmed)
        order = np.argsort(-own.correlations[rows, columns], kind="stable")
        rows, columns = rows[order], columns[order]
        camera = small.gray_view.camera
        found = surface_points(camera, own.depths, rows, columns)
        wide = SPACING * own.depths[rows, columns] / camera.fx
        chosen = choose_spread(found, wide, points)
        points, spacings = np.concatenate([points, found[chosen]]), np.concatenate([spacings, wide[chosen]])
        colors = np.concatenate([colors, small.rgb[rows[chosen], columns[chosen]]])
    stays = ~is_before_sparse(points, views, scene.points) & has_company(points, spacings)
    stays[: len(scene.points)] = True
    return points[stays], colors[stays]


def choose_neighbours(views: Sequence[View], points: Floats) -> list[list[int]]:
    """Return for each view the others, best first, that share most points with it at a good angle.

    A shared point counts in proportion to the angle between its rays up to :data:`ANGLE_GOOD`, and not at all beyond
    :data:`ANGLE_MAX`. Where the scene has no points, those count whose cameras look in similar directions, the nearest
    first.
    """
    seen = [_seen_ids(view, points) for view in views]
    centers = np.array([view.camera.center for view in views])
    axes = np.array([view.camera.cam_from_world_R[2] for view in views])  # [V, 3] viewing directions, world frame
    chosen = []
    for i, own in enumerate(seen):
        scores = np.zeros(len(views))
        for k, ids in enumerate(seen):
            if k == i:
                continue
            shared = points[np.intersect1d(own, ids, assume_unique=True)]
            if len(points):
                angles = _angles(shared - centers[i], shared - centers[k])
                scores[k] = np.where(angles > ANGLE_MAX, 0.0, np.minimum(angles / ANGLE_GOOD, 1.0)).sum()
            elif axes[i] @ axes[k] > np.cos(np.radians(ANGLE_MAX)):
                distance = np.linalg.norm(centers[i] - centers[k])
                scores[k] = 1.0 / distance if distance > 0 else 0.0
        best = np.argsort(-scores, kind="stable")[:N_NEIGHBOURS]
        chosen.append([int(k) for k in best if scores[k] > 0])
    return chosen


def is_before_sparse(points: Floats, views: Sequence[View], sparse_points: Floats) -> Bools:
    """Return which points [P] lie in front of a sparse point that a view shows within a small pixel of them.

    Where a photograph shows a sparse point, the ray up to it is free (:mod:`minisplat_ref.strategy.line_of_sight`);
    stereo that is deceived by a repeated pattern puts points there.
    """
    found = np.zeros(len(points), bool)
    for view in views:
        if view.point_ids is None or not len(view.point_ids):
            continue
        camera = view.camera
        radius = NEAR_A_RAY * max(1.0, max(camera.width, camera.height) / LONG_SIDE)
        _, known_xy, known_z = project_into_image(sparse_points[view.point_ids], camera)
        rows, xy, z = project_into_image(points, camera)
        if len(known_z) and len(z):
            distances, nearest = cKDTree(known_xy).query(xy, distance_upper_bound=radius)
            is_near = np.isfinite(distances)
            found[rows[is_near]] |= z[is_near] < (1.0 - MARGIN) * known_z[nearest[is_near]]
    return found


def has_company(points: Floats, spacings: Floats) -> Bools:
    """Return which points [P] have :data:`COMPANY` others within :data:`REACH` times their spacing.

    Surfaces are covered densely; what is alone, far behind the scene or in the air, is a mistake of stereo.
    """
    if len(points) <= COMPANY:
        return np.ones(len(points), bool)
    distances, _ = cKDTree(points).query(points, COMPANY + 1)  # the first is the point itself
    return distances[:, -1] <= REACH * spacings


def choose_spread(points: Floats, spacings: Floats, others: Floats) -> Ints:
    """Return which points stay so that each keeps its distance from the others and from those before it.

    Parameters
    ----------
    points : ndarray of shape (P, 3)
        Best first.
    spacings : ndarray of shape (P,)
        Minimum distance of each.
    others : ndarray of shape (Q, 3)
        Points that are there already.

    Returns
    -------
    ndarray of shape (R,) of int
        Rows, ascending.
    """
    free = np.ones(len(points), bool)
    if len(others) and len(points):
        free = cKDTree(others).query(points)[0] > spacings
    rows = np.flatnonzero(free)
    if not len(rows):
        return rows
    near = cKDTree(points[rows]).query_ball_point(points[rows], spacings[rows], return_sorted=True)
    stays = np.ones(len(rows), bool)
    for i, close in enumerate(near):
        if stays[i]:
            stays[[k for k in close if k > i]] = False
    return rows[stays]


def _shrink(view: View, near: float, far: float) -> _Small:
    """Return a photograph made small, with the depths to sweep, between the nearest and the farthest."""
    camera = view.camera
    factor = min(1.0, LONG_SIDE / max(camera.width, camera.height))
    width, height = (max(1, round(side * factor)) for side in (camera.width, camera.height))
    rgb = resize_image(view.image, width, height)
    mask = None if view.mask is None else resize_mask(view.mask, width, height)
    gray = rgb.mean(axis=2, dtype=np.float32) / np.float32(255.0)
    return _Small(GrayView(rescale_camera(camera, width, height), gray), rgb, mask, near, far)


def _depth_range(view: View, scene: Scene) -> tuple[float, float]:
    """Return the nearest and the farthest depth at which a view may show something, world units."""
    _, _, depths = project_into_image(scene.points[_seen_ids(view, scene.points)], view.camera)
    if not len(depths):
        return EXTENT_DEPTHS[0] * scene.extent, EXTENT_DEPTHS[1] * scene.extent
    near, far = np.percentile(depths, (1, 99)) * DEPTH_MARGINS
    return float(near), float(far)


def _seen_ids(view: View, points: Floats) -> Ints:
    """Return which sparse points a view shows: those of its track, or all in its image."""
    if view.point_ids is not None and len(view.point_ids) >= POINTS_MIN:
        return view.point_ids
    return project_into_image(points, view.camera)[0]


def _sweep(small: _Small, others: Sequence[GrayView]) -> DepthMap:
    """Return the depths of a small photograph, without those of masked pixels."""
    if not others:
        nothing = np.zeros(small.gray_view.gray.shape)
        return DepthMap(nothing, nothing)
    planes = choose_planes(small.gray_view.camera, [other.camera for other in others], small.near, small.far)
    found = sweep_planes(small.gray_view, others, planes)
    return found if small.mask is None else DepthMap(*(np.where(small.mask, field, 0.0) for field in found))


def _angles(a: Floats, b: Floats) -> Floats:
    """Return the angles between vectors [P, 3], degrees."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1)))
