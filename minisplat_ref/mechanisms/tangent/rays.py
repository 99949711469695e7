"""Colours on given rays instead of pixels, for studies that turn or move a camera."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import EXACT_ORDER, LIST_ORDER, Conventions
from minisplat_ref.mechanisms.orders import blending_order
from minisplat_ref.mechanisms.tangent.planes import hit, project
from minisplat_ref.reference.hits import Hit, conic_hit, is_accepted
from minisplat_ref.reference.pinhole import pinhole
from minisplat_ref.reference.projection import project as project_ewa
from minisplat_ref.types import Bools, Camera, Floats, Ints, Primitives


class RayHits(NamedTuple):
    """The hits of G Gaussians, in the order of a list, on P rays."""

    ids: Ints  # [G] rows
    hit: Hit  # [G, P]


def ewa_hits(primitives: Primitives, camera: Camera, rays: Floats, conventions: Conventions) -> RayHits:
    """Return the hits of 3DGS's footprints on rays [P, 3] of the camera's frame, listed by camera z."""
    projection = project_ewa(*primitives, camera, conventions)
    ids = _list_visible(projection.depths, projection.radii)
    return RayHits(ids, conic_hit(projection, ids, pinhole(rays, camera)))


def tangent_hits(primitives: Primitives, camera: Camera, rays: Floats, conventions: Conventions) -> RayHits:
    """Return the hits of footprints on tangent planes on rays [P, 3] of the camera's frame, listed by distance."""
    footprints = project(primitives, camera, conventions)
    ids = _list_visible(footprints.distances, footprints.radii)
    return RayHits(ids, hit(footprints, ids, pinhole(rays, camera)))


def sorted_ewa_hits(primitives: Primitives, camera: Camera, rays: Floats, conventions: Conventions) -> RayHits:
    """Return the hits of 3DGS's footprints with the depths on the rays, so that only the order is StopThePop's."""
    found, footprints = ewa_hits(primitives, camera, rays, conventions), project(primitives, camera, conventions)
    depths = hit(footprints, found.ids, pinhole(rays, camera)).depths
    return found._replace(hit=found.hit._replace(depths=depths))


METHODS: dict[str, tuple[Callable[[Primitives, Camera, Floats, Conventions], RayHits], int]] = {
    "3DGS: EWA, by z": (ewa_hits, LIST_ORDER),
    "EWA, exact order": (sorted_ewa_hits, EXACT_ORDER),
    "tangent planes, by distance": (tangent_hits, LIST_ORDER),
    "tangent planes, buffer of 16": (tangent_hits, 16),
    "tangent planes, exact order": (tangent_hits, EXACT_ORDER),
}
"""Footprints and orders that are compared, by name."""


def ray_colors(
    method: str, primitives: Primitives, colors: Floats, camera: Camera, rays: Floats, conventions: Conventions
) -> Floats:
    """Return the colours [P, 3] along rays of the world over black.

    Parameters
    ----------
    method : str
        Key of ``METHODS``.
    primitives : Primitives
        N Gaussians.
    colors : ndarray of shape (N, 3)
        Colours, the same in all directions.
    camera : Camera
        It determines footprints and order.
    rays : ndarray of shape (P, 3)
        Directions in the world frame, in front of the camera.
    conventions : Conventions
        Thresholds and low-pass.
    """
    hits, buffer_size = METHODS[method]
    found = hits(primitives, camera, rays @ camera.cam_from_world_R.T, conventions)
    alphas = np.minimum(conventions.alpha_max, found.hit.unclamped)
    is_hit = alphas >= conventions.alpha_min
    order = blending_order(is_hit, found.hit.depths, buffer_size)
    alphas = np.take_along_axis(np.where(is_hit, alphas, 0), order, axis=0)
    T = np.cumprod(np.concatenate([np.ones((1, len(rays))), 1 - alphas]), axis=0)
    alphas = np.where(is_accepted(T[1:], conventions), alphas, 0)
    light: Floats = np.einsum("gp,gpd->pd", alphas * T[:-1], colors[found.ids][order])
    return light


def count_misordered(is_hit: Bools, depths: Floats) -> tuple[int, int]:
    """Return the number of pairs of hits of all rays, and of those in the opposite order to their depths.

    Parameters
    ----------
    is_hit : ndarray of shape (G, P)
        Hits in the order in which they are blended.
    depths : ndarray of shape (G, P)
        Depths in that order, world units.
    """
    n_all = n_wrong = 0
    for ray in range(depths.shape[1]):
        own = depths[is_hit[:, ray], ray]
        n_all += len(own) * (len(own) - 1) // 2
        n_wrong += int(np.triu(own[:, None] > own[None, :], 1).sum())
    return n_all, n_wrong


def _list_visible(depths: Floats, radii: Ints) -> Ints:
    """Return the rows that are seen, nearest first."""
    rows = np.flatnonzero(radii[:, 0] > 0)
    listed: Ints = rows[np.argsort(depths[rows], kind="stable")]
    return listed


def yaw_camera(camera: Camera, yaw: float) -> Camera:
    """Return the camera rotated in place by ``yaw`` radians about its own y axis."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    Y = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
    R = Y @ np.asarray(camera.cam_from_world_R, np.float64)
    return camera._replace(cam_from_world_R=R, cam_from_world_t=Y @ np.asarray(camera.cam_from_world_t, np.float64))


def orbit_camera(camera: Camera, angle: float, center: Floats) -> Camera:
    """Return the camera carried by ``angle`` radians around a vertical axis, world y, through ``center`` [3]."""
    cos, sin = np.cos(angle), np.sin(angle)
    Y = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
    R = np.asarray(camera.cam_from_world_R, np.float64)
    return camera._replace(cam_from_world_R=R @ Y, cam_from_world_t=R @ (center - Y @ center) + camera.cam_from_world_t)


class Changes(NamedTuple):
    """The change of the colours of P rays along a path of n cameras; the channel that changes most counts."""

    largest: Floats
    """[n - 1] of the rays, in each step."""
    mean: Floats
    """[n - 1] over the rays, in each step."""
    flicker: float
    """The change of the changes from step to step, summed over the path, as a mean over the rays: it is 0 for a colour
    that changes evenly, however far, and each jump counts twice."""


def color_changes(
    method: str,
    primitives: Primitives,
    colors: Floats,
    path: Sequence[Camera],
    rays: Sequence[Floats],
    conventions: Conventions,
) -> Changes:
    """Return the change of the colours of rays along a path.

    Parameters
    ----------
    method : str
        One of ``METHODS``.
    primitives : Primitives
    colors : ndarray of shape (N, 3)
    path : sequence of Camera
        At least three.
    rays : sequence of ndarray of shape (P, 3)
        World frame, for each camera.
    conventions : Conventions
    """
    seen = np.stack([ray_colors(method, primitives, colors, *at, conventions) for at in zip(path, rays, strict=True)])
    steps = np.diff(seen, axis=0)  # [n - 1, P, 3]
    changes = np.abs(steps).max(axis=2)
    flicker = np.abs(np.diff(steps, axis=0)).max(axis=2).mean(axis=1).sum()
    return Changes(changes.max(axis=1), changes.mean(axis=1), float(flicker))
