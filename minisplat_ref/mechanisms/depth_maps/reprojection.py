"""Reprojection of a depth map into another view and back, and the agreement of several views (after MVSNet's fusion).

A pixel p of a reference view r with the depth D is the point X. A source view k sees X at p_k and has a depth map
itself, which there shows the point X_k; r sees that at p'' in the depth D''. The two agree on p if

    |p'' - p| < e_pix   and   |D'' - D| / D < e_dep

Between the centres of pixels the inverse of a depth is interpolated, since that of a plane is linear in the image. A
source without a depth at one of the four pixels around p_k has no vote.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from minisplat_ref.reference.pinhole import pinhole, pinhole_rays
from minisplat_ref.types import Bools, Camera, Floats, Ints


class DepthView(NamedTuple):
    """A depth map and where it was taken."""

    depth: Floats
    """[H, W] camera z, world units; 0 where there is none."""
    camera: Camera


class RoundTrip(NamedTuple):
    """Errors of each pixel of a reference view after the way to a source view and back; all [H, W]."""

    is_seen: Bools
    """Whether the pixel has a depth, and the source one where it sees the pixel's point."""
    pixel_error: Floats
    """|p'' - p|, pixels; infinite where not seen."""
    depth_error: Floats
    """|D'' - D| / D; infinite where not seen."""
    depth: Floats
    """D'', world units; 0 where not seen."""


class Tolerances(NamedTuple):
    """Conditions for the agreement of two views, and the number of views that must agree."""

    pixels: float = 1.0
    """e_pix."""
    depth: float = 0.01
    """e_dep."""
    n_views: int = 2
    """Sources that have to agree with the reference."""


USUAL_TOLERANCES = Tolerances()


class Agreement(NamedTuple):
    """The agreement of a reference view with its sources; both [H, W]."""

    n_agreeing: Ints
    """Sources that agree."""
    depth: Floats
    """Mean of D and of the D'' of these sources, world units; 0 where fewer agree than must."""


def unproject(view: DepthView) -> Floats:
    """Return the points [H, W, 3] of a depth map, world frame; those of pixels without a depth are meaningless."""
    height, width = view.depth.shape
    rays = pinhole_rays(np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5, view.camera)
    return (view.depth[..., None] * rays - view.camera.cam_from_world_t) @ view.camera.cam_from_world_R


def sample_depth(depth: Floats, pixels: Floats) -> Floats:
    """Return the depths [P] between the centres of pixels, 0 where one of the four around has none or is outside.

    Parameters
    ----------
    depth : ndarray of shape (H, W)
    pixels : ndarray of shape (P, 2)
        The centre of the first pixel is (0.5, 0.5).
    """
    height, width = depth.shape
    low = np.floor(pixels - 0.5)
    with np.errstate(invalid="ignore"):
        is_inside = np.all((low >= 0) & (low + 1 < [width, height]), axis=1)
    columns, rows = np.where(is_inside[:, None], low, 0).astype(int).T
    a, b = np.where(is_inside[:, None], pixels - 0.5 - low, 0).T
    right, below = np.minimum(columns + 1, width - 1), np.minimum(rows + 1, height - 1)
    four = np.stack([depth[rows, columns], depth[rows, right], depth[below, columns], depth[below, right]])  # [4, P]
    shares = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    is_known = is_inside & np.all(four > 0, axis=0)
    inverse = np.sum(shares / np.where(four > 0, four, 1), axis=0)
    return np.where(is_known, 1 / inverse, 0)


def round_trip(reference: DepthView, source: DepthView) -> RoundTrip:
    """Return each pixel of the reference after its way to a source and back."""
    shape = reference.depth.shape
    in_source = _transform_to_camera(unproject(reference).reshape(-1, 3), source.camera)  # [P, 3]
    is_before = (reference.depth.ravel() > 0) & (in_source[:, 2] > 0)
    in_source = np.where(is_before[:, None], in_source, [0, 0, 1])
    p_k = pinhole(in_source, source.camera)
    d_k = np.where(is_before, sample_depth(source.depth, p_k), 0)
    rays = pinhole_rays(p_k[:, 0], p_k[:, 1], source.camera)
    X_k = (d_k[:, None] * rays - source.camera.cam_from_world_t) @ source.camera.cam_from_world_R
    back = _transform_to_camera(X_k, reference.camera)
    is_seen = (d_k > 0) & (back[:, 2] > 0)
    back = np.where(is_seen[:, None], back, [0, 0, 1])
    rows, columns = np.indices(shape)
    p = np.stack([columns, rows], axis=-1).reshape(-1, 2) + 0.5
    depth = reference.depth.ravel()
    pixel_error = np.linalg.norm(pinhole(back, reference.camera) - p, axis=1)
    depth_error = np.abs(back[:, 2] - depth) / np.where(is_seen, depth, 1)
    return RoundTrip(
        is_seen.reshape(shape),
        np.where(is_seen, pixel_error, np.inf).reshape(shape),
        np.where(is_seen, depth_error, np.inf).reshape(shape),
        np.where(is_seen, back[:, 2], 0).reshape(shape),
    )


def agree(reference: DepthView, sources: Sequence[DepthView], tolerances: Tolerances = USUAL_TOLERANCES) -> Agreement:
    """Return the agreement of a reference view with its sources."""
    n_agreeing, total = np.zeros(reference.depth.shape, int), reference.depth.astype(float)
    for source in sources:
        trip = round_trip(reference, source)
        agrees = (trip.pixel_error < tolerances.pixels) & (trip.depth_error < tolerances.depth)
        n_agreeing += agrees
        total += np.where(agrees, trip.depth, 0)
    is_kept = (n_agreeing >= tolerances.n_views) & (reference.depth > 0)
    return Agreement(n_agreeing, np.where(is_kept, total / (1 + n_agreeing), 0))


def nearest_views(cameras: Sequence[Camera], n_sources: int, max_degrees: float = 60.0) -> list[list[int]]:
    """Return for each camera the ``n_sources`` nearest others that look in about its direction, the nearest first."""
    centers = np.array([camera.center for camera in cameras], float)
    axes = np.array([camera.cam_from_world_R[2] for camera in cameras], float)
    chosen = []
    for index in range(len(cameras)):
        is_alike = axes @ axes[index] > np.cos(np.radians(max_degrees))
        is_alike[index] = False
        distances = np.where(is_alike, np.linalg.norm(centers - centers[index], axis=1), np.inf)
        order = np.argsort(distances, kind="stable")[:n_sources]
        chosen.append([int(k) for k in order if np.isfinite(distances[k])])
    return chosen


def _transform_to_camera(points: Floats, camera: Camera) -> Floats:
    return points @ camera.cam_from_world_R.T + camera.cam_from_world_t
