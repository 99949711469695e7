"""Depth reinitialisation (Mini-Splatting, Sec. 4.1): replace all Gaussians by points of the rendered surface.

Trained Gaussians crowd where gradients were large and leave plain surfaces to few. A fresh set with equally many points
per photograph covers the scene evenly. A point lies where a pixel's ray meets the visible surface, and its colour is
the photograph's. The paper compares three definitions of "where" (Table 4):

- midpoint: the densest point of the dominant Gaussian on the ray (appendix D), the default;
- centre: the ray at the depth of the dominant Gaussian's mean;
- blended: the ray at the blended depth, ``sum w z / sum w``.

In the paper pixels are chosen at random; the released code draws them with probability proportional to the accumulated
opacity, and so do we. Two safeguards are ours, for places where the photographs do not determine the depth, such as sky
and bare walls: a minimum of the accumulated opacity of chosen pixels, and a vote of other views on each point.

Left out: in the released kernel a Gaussian whose densest point lies behind the camera does not change the
transmittance. Here such a pixel has no point.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref import memory
from minisplat_ref.constants import Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.reference.depth import expected_depth
from minisplat_ref.reference.pinhole import pinhole_rays, with_principal_point
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.strategy.simplify import sample
from minisplat_ref.types import Bools, Camera, Floats, Ints, View

N_PARTNERS = 8  # views that vote on a point: more of them agree more often by chance, and cost time
BEST_PARALLAX = np.radians(
    20.0
)  # of partners: from a nearer one a floater looks the same, from a farther one less is seen
SCORE_MIN = 0.05  # of a partner: 1 degree of parallax on all points, or the best on a twentieth of them
MAP_BYTES = 8  # per pixel: depth and weight in float32
N_PROBES = 256  # points of a view with which its partners are chosen


class PixelPoints(NamedTuple):
    """The point where the ray of each pixel's centre meets the visible surface."""

    points: Floats
    """[H, W, 3] world frame; 0 where there is none."""
    depths: Floats
    """[H, W] camera z, world units; 0 where there is none."""
    alpha: Floats
    """[H, W] accumulated opacity."""


def midpoint_points(model: Any, view: View, settings: RenderSettings) -> PixelPoints:
    """Return the densest point of the dominant Gaussian on each ray, the midpoint of the ray's chord through it.

    Parameters
    ----------
    model : Model or Gaussians
    view : View
        Only its camera is used.
    settings : RenderSettings

    Returns
    -------
    PixelPoints
        In the dtype of the Gaussians.
    """
    output, _ = settings.render_view(model, view, frozenset({"surface"}), sh_degree=0)
    points, depths = output.extras["surface"]
    return PixelPoints(points, depths, output.alpha)


def centre_points(model: Any, view: View, settings: RenderSettings) -> PixelPoints:
    """Return the point on each ray at the depth of the dominant Gaussian's mean.

    It is not the mean itself, with which all pixels of a large Gaussian would become one point.

    Parameters
    ----------
    model, view, settings
        As for :func:`midpoint_points`.

    Returns
    -------
    PixelPoints
        In the dtype of the Gaussians.
    """
    output, _ = settings.render_view(model, view, frozenset({"dominant_depth"}), sh_degree=0)
    return _points_on_rays(output.extras["dominant_depth"], output.alpha, view.camera, settings.conventions)


def blend_points(model: Any, view: View, settings: RenderSettings) -> PixelPoints:
    """Return the point on each ray at the blended depth, ``sum w z / sum w``.

    Where a ray passes through several surfaces, at the edge of an object or under a floater, it lies on none of them.

    Parameters
    ----------
    model, view, settings
        As for :func:`midpoint_points`.

    Returns
    -------
    PixelPoints
        In the dtype of the Gaussians.
    """
    wants = frozenset({"depth"})
    output, _ = settings.render_view(model, view, wants, sh_degree=0)
    sums = output.image[..., settings.renderer.channels(wants)["depth"]][..., 0]  # [H, W]
    depths = expected_depth(sums, output.alpha)  # [H, W]
    return _points_on_rays(depths, output.alpha, view.camera, settings.conventions)


def reinitial_points(
    model: Any,
    views: Sequence[View],
    n_points: int,
    *,
    settings: RenderSettings = RenderSettings(),  # noqa: B008  (a constant)
    points_of: Callable[[Any, View, RenderSettings], PixelPoints] = midpoint_points,
    min_alpha: float,
    depth_tolerance: float | None,
    backdrop_distance: float | None = None,
    rng: np.random.Generator,
) -> tuple[Floats, NDArray[np.uint8]]:
    """Draw points of the surface that the Gaussians show, equally many from every view.

    Within a view pixels are drawn without replacement, with probability proportional to the accumulated opacity. Where
    fewer pixels can be drawn than requested, all of them are. Masked pixels are never drawn.

    Parameters
    ----------
    model : Model or Gaussians
    views : sequence of View
    n_points : int
        Points over all views; every view gives ``n_points // n_views``.
    settings : RenderSettings
    points_of : callable
        :func:`midpoint_points`, :func:`centre_points` or :func:`blend_points`.
    min_alpha : float
        Pixels of lower accumulated opacity are not drawn; 0 for the paper's rule.
    depth_tolerance : float or None
        A point is on another view's surface if its depth differs from that view's by at most this, relatively. It is
        refuted if, of up to 8 other views, at least as many see through it as have it on their surface. A point that no
        other view can judge is not refuted. None for the paper's rule, which refutes nothing.
    backdrop_distance : float or None
        Refuted points move along their rays to this distance from the camera, behind the scene, world units. None: they
        are not drawn.
    rng : numpy.random.Generator
        Draws the pixels.

    Returns
    -------
    points : ndarray of shape (P, 3), float64
        World frame; P is at most ``n_points``.
    colors : ndarray of shape (P, 3), uint8
        The photographs' pixels.

    Raises
    ------
    InputError
        There are fewer points than views, no pixel of any view can be drawn, or all depths do not fit into memory.
    """
    if n_points < len(views):
        raise InputError(f"{n_points} points from {len(views)} views are none from each: ask for more points")
    cameras = [with_principal_point(view.camera, settings.conventions) for view in views]
    _check_room(cameras)
    depth_maps, weight_maps = [], []  # MAP_BYTES per pixel of all views; points would be 12 more
    for view in views:
        _, depths, alpha = points_of(model, view, settings)
        is_drawable = (depths > 0) & (alpha >= min_alpha)
        if (mask := view.mask) is not None:
            is_drawable &= mask
        depth_maps.append(depths)
        weight_maps.append(np.where(is_drawable, alpha, 0))

    points: list[Floats] = []
    colors: list[NDArray[np.uint8]] = []
    for i, view in enumerate(views):
        view_points, weights = unproject(depth_maps[i], cameras[i]).reshape(-1, 3), weight_maps[i].ravel()
        if depth_tolerance is not None:
            candidates = np.flatnonzero(weights)
            is_refuted = find_refuted(view_points[candidates], i, cameras, depth_maps, depth_tolerance)
            unsure = candidates[is_refuted]
            if backdrop_distance is None:
                weights[unsure] = 0
            else:
                rays = _rays(view_points[unsure], cameras[i])
                view_points[unsure] = cameras[i].center + backdrop_distance * rays
        n = min(n_points // len(views), int(np.count_nonzero(weights)))
        pixels = sample(weights, n, rng) if n > 0 else np.zeros(0, np.intp)
        points.append(view_points[pixels])
        colors.append(view.image.reshape(-1, 3)[pixels])
    if sum(map(len, points)) == 0:
        raise InputError("no pixel of any view shows a surface: lower min_alpha or raise depth_tolerance")
    return np.concatenate(points), np.concatenate(colors)


def _check_room(cameras: Sequence[Camera]) -> None:
    """Refuse views whose depths, which are all needed at once, do not fit into memory."""
    needed = MAP_BYTES * sum(camera.width * camera.height for camera in cameras)
    free = memory.free_bytes()
    if needed > free:
        raise InputError(
            f"the depths of all {len(cameras)} views take {memory.as_text(needed)} of memory,"
            f" {memory.as_text(free)} are free: train on smaller photographs (--downscale), or by a recipe that does"
            " not begin again from depth, such as 3dgs-accel"
        )


def unproject(depths: Floats, camera: Camera) -> Floats:
    """Return the points on the rays of the pixels' centres.

    Parameters
    ----------
    depths : ndarray of shape (H, W)
        Camera z, world units.
    camera : Camera
        Its principal point is used.

    Returns
    -------
    points : ndarray of shape (H, W, 3), float64
        World frame; the camera's centre where the depth is 0.
    """
    height, width = depths.shape
    rays = pinhole_rays(np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5, camera)  # [H, W, 3]
    return (depths[:, :, None] * rays - camera.cam_from_world_t) @ camera.cam_from_world_R  # rows of R^T (x - t)


def _points_on_rays(depths: Floats, alpha: Floats, camera: Camera, conventions: Conventions) -> PixelPoints:
    points = unproject(depths, with_principal_point(camera, conventions))  # [H, W, 3]
    return PixelPoints(np.where(depths[:, :, None] > 0, points, 0).astype(depths.dtype), depths, alpha)


def find_refuted(
    points: Floats, own_id: int, cameras: Sequence[Camera], depth_maps: Sequence[Floats], tolerance: float
) -> Bools:
    """Return which points of a view are refuted: at least as many partners see through one as have it on their surface.

    A partner that sees something nearer there, or whose image does not contain the point, has no vote. A point that no
    partner can judge is not refuted: a corner that only one photograph shows, a single photograph, a camera that only
    turned on its tripod.

    Parameters
    ----------
    points : ndarray of shape (P, 3)
        World frame.
    own_id : int
        The view that they come from.
    cameras : sequence of Camera
        Of all views.
    depth_maps : sequence of ndarray of shape (H, W)
        Camera z of the surface in each view, world units; 0 where there is none.
    tolerance : float
        Relative difference of two depths of the same surface.

    Returns
    -------
    ndarray of shape (P,), bool
    """
    partner_ids = _partners(points, own_id, cameras)
    n_agreeing, n_seeing_through = np.zeros((2, len(points)), np.int32)
    for j in partner_ids:
        z, pixels = _project(points, cameras[j])
        depths = np.where(pixels >= 0, depth_maps[j].ravel()[pixels], 0)  # [P], 0 where the partner sees nothing
        is_near = np.abs(depths - z) <= tolerance * z
        n_agreeing += is_near
        n_seeing_through += ~is_near & (depths > z)
    return (n_seeing_through > 0) & (n_seeing_through >= n_agreeing)


def _partners(points: Floats, own_id: int, cameras: Sequence[Camera]) -> Ints:
    """Return up to ``N_PARTNERS`` views that see many of the points [P, 3] from another, but similar, direction."""
    probes = points[:: max(1, len(points) // N_PROBES)]  # [S, 3]
    own_rays = _rays(probes, cameras[own_id])  # [S, 3]
    scores = np.zeros(len(cameras))
    for j, camera in enumerate(cameras):
        parallaxes = np.arccos(np.clip((own_rays * _rays(probes, camera)).sum(axis=1), -1, 1))  # [S]
        ratios = parallaxes / BEST_PARALLAX
        _, pixels = _project(probes, camera)
        scores[j] = np.where(pixels >= 0, np.minimum(ratios, 1 / np.maximum(ratios, 1)), 0).sum()
    best = np.argsort(-scores, kind="stable")[:N_PARTNERS]
    return best[scores[best] >= SCORE_MIN * len(probes)]


def _rays(points: Floats, camera: Camera) -> Floats:
    """Return the unit vectors [P, 3] from the camera's centre to points [P, 3]."""
    rays = points - camera.center
    return rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), np.finfo(rays.dtype).tiny)


def _project(points: Floats, camera: Camera) -> tuple[Floats, Ints]:
    """Return camera z [P] of points [P, 3] and the pixels [P] that they fall on, counted row by row; -1 outside."""
    x, y, z = camera.cam_from_world_R @ points.T + camera.cam_from_world_t[:, None]
    is_in_front = z > 0
    depths = np.where(is_in_front, z, 1.0)
    u, v = camera.fx * x / depths + camera.cx, camera.fy * y / depths + camera.cy  # pixels
    is_inside = is_in_front & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    pixels = np.where(is_inside, v, 0).astype(np.intp) * camera.width + np.where(is_inside, u, 0).astype(np.intp)
    return z, np.where(is_inside, pixels, -1)
