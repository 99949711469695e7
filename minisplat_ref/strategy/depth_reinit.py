"""Depth reinitialisation (Mini-Splatting, Sec. 4.1): all Gaussians give way to points of the surface that they show.

Trained Gaussians crowd where gradients were large and leave plain surfaces to few. A fresh set with equally many points
per photograph covers the scene evenly. A point is where a pixel's ray meets what the pixel shows, and its colour is the
photograph's. The paper compares three meanings of "where" (Table 4):

- mid-point: the densest point of the dominant Gaussian on the ray (appendix D), the default;
- centre: the ray at the depth of the dominant Gaussian's mean;
- blended: the ray at the blended depth, ``sum w z / sum w``.

The paper says that pixels are chosen at random; the released code draws them with probability proportional to the
accumulated opacity, and so do we. Two guards are ours: a floor of the accumulated opacity, below which a pixel is never
drawn, and a test whether another view sees a surface at the same place.

Left out: that a Gaussian whose densest point lies behind the camera leaves the transmittance untouched, as in the
released kernel. Such a pixel has no point here.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.backends import CPU, Backend
from minisplat_ref.constants import DEPTH_ALPHA_MIN, GSPLAT_MAIN, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.reference.pinhole import with_principal_point
from minisplat_ref.render import render
from minisplat_ref.types import Camera, Floats, Gaussians, Ints, View


class PixelPoints(NamedTuple):
    """Where each pixel's ray meets what the pixel shows."""

    points: Floats
    """[H, W, 3] world frame; 0 where there is none."""
    depths: Floats
    """[H, W] camera z, world units; 0 where there is none."""
    alpha: Floats
    """[H, W] accumulated opacity."""


PointsOf = Callable[[Gaussians, Camera, Conventions, Backend], PixelPoints]


def midpoint_points(gaussians: Gaussians, camera: Camera, conventions: Conventions, backend: Backend) -> PixelPoints:
    """Densest point of the dominant Gaussian on each ray, which is the middle of the ray's chord through it.

    Parameters
    ----------
    gaussians : Gaussians
    camera : Camera
    conventions : Conventions
    backend : Backend

    Returns
    -------
    PixelPoints
        In the dtype of the Gaussians.
    """
    output, tape = render(gaussians, camera, sh_degree=0, conventions=conventions, backend=backend, with_stats=True)
    assert output.stats is not None
    means, quats, scales, _ = tape.splats.primitives
    seen_camera = with_principal_point(camera, conventions)
    surface = backend.surface_points(means, quats, scales, seen_camera, output.stats.dominant_ids)
    return PixelPoints(surface.points, surface.depths, output.alpha)


def centre_points(gaussians: Gaussians, camera: Camera, conventions: Conventions, backend: Backend) -> PixelPoints:
    """Point of each ray at the depth of the dominant Gaussian's mean.

    Not the mean itself: all pixels of a large Gaussian would become one point.

    Parameters
    ----------
    gaussians, camera, conventions, backend
        As for :func:`midpoint_points`.

    Returns
    -------
    PixelPoints
        In the dtype of the Gaussians.
    """
    output, tape = render(gaussians, camera, sh_degree=0, conventions=conventions, backend=backend, with_stats=True)
    assert output.stats is not None
    dominant_ids = output.stats.dominant_ids
    depths = np.append(tape.projection.depths, gaussians.means.dtype.type(0))[dominant_ids]  # [H, W], 0 for id -1
    return PixelPoints(_unproject(depths, with_principal_point(camera, conventions)), depths, output.alpha)


def blended_points(gaussians: Gaussians, camera: Camera, conventions: Conventions, backend: Backend) -> PixelPoints:
    """Point of each ray at the blended depth, ``sum w z / sum w``.

    At the edge of an object the mean of two depths lies on neither surface.

    Parameters
    ----------
    gaussians, camera, conventions, backend
        As for :func:`midpoint_points`.

    Returns
    -------
    PixelPoints
        In the dtype of the Gaussians.
    """
    output, _ = render(gaussians, camera, sh_degree=0, conventions=conventions, backend=backend, with_depth=True)
    depths = output.image[..., 3] / np.maximum(output.alpha, output.alpha.dtype.type(DEPTH_ALPHA_MIN))  # [H, W]
    return PixelPoints(_unproject(depths, with_principal_point(camera, conventions)), depths, output.alpha)


def reinitial_points(
    gaussians: Gaussians,
    views: Sequence[View],
    n_points: int,
    *,
    points_of: PointsOf = midpoint_points,
    least_alpha: float,
    depth_tolerance: float | None,
    rng: np.random.Generator,
    conventions: Conventions = GSPLAT_MAIN,
    backend: Backend = CPU,
) -> tuple[Floats, NDArray[np.uint8]]:
    """Draw points of the surface that the Gaussians show, equally many from every view.

    Within a view pixels are drawn without replacement, with probability proportional to the accumulated opacity. Where
    fewer pixels can be drawn than asked for, all of them are.

    Parameters
    ----------
    gaussians : Gaussians
    views : sequence of View
    n_points : int
        Points over all views; every view gives ``n_points // n_views``.
    points_of : callable
        :func:`midpoint_points`, :func:`centre_points` or :func:`blended_points`.
    least_alpha : float
        Pixels of lower accumulated opacity are not drawn; 0 for the paper's rule.
    depth_tolerance : float or None
        A pixel is drawn only if its point has, in another view, that view's depth up to this relative difference; None
        for the paper's rule, which does not ask.
    rng : numpy.random.Generator
        Draws the pixels.
    conventions : Conventions
    backend : Backend

    Returns
    -------
    points : ndarray of shape (P, 3), float64
        World frame; P is at most ``n_points``.
    colors : ndarray of shape (P, 3), uint8
        The photographs' pixels.

    Raises
    ------
    InputError
        No pixel of any view can be drawn.
    """
    n_per_view = n_points // len(views)
    pixel_points = [points_of(gaussians, view.camera, conventions, backend) for view in views]
    points, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    for view, (view_points, depths, alpha) in zip(views, pixel_points, strict=True):
        weights = np.where((depths > 0) & (alpha >= least_alpha), alpha, 0)
        if view.mask is not None:
            weights = np.where(view.mask, weights, 0)
        pixels = _draw(weights.ravel(), n_per_view, rng)
        points.append(view_points.reshape(-1, 3)[pixels].astype(np.float64))
        colors.append(view.image.reshape(-1, 3)[pixels])
    if sum(map(len, points)) == 0:
        raise InputError("no pixel of any view shows a surface: lower least_alpha or reinitialise later")
    return np.concatenate(points), np.concatenate(colors)


def _draw(weights: Floats, n: int, rng: np.random.Generator) -> Ints:
    """Return up to ``n`` rows in ascending order, drawn without replacement with probability proportional to weight.

    The first of several exponential clocks to ring is each with probability proportional to its rate, so the first n
    to ring are such a draw.
    """
    rows = np.flatnonzero(weights)
    if n >= len(rows):
        return rows
    ringing_times = rng.exponential(size=len(rows)) / weights[rows]
    return np.sort(rows[np.argpartition(ringing_times, n)[:n]])


def _unproject(depths: Floats, camera: Camera) -> Floats:
    """Return the points [H, W, 3] on the pixels' rays at these camera z; 0 where the depth is."""
    height, width = depths.shape
    x, y = (np.arange(width) + 0.5 - camera.cx) / camera.fx, (np.arange(height) + 0.5 - camera.cy) / camera.fy
    in_camera = np.stack(np.broadcast_arrays(x, y[:, None], 1.0), axis=-1) * depths[:, :, None]  # [H, W, 3]
    points = (in_camera - camera.cam_from_world_t) @ camera.cam_from_world_R  # R^T (x - t) for rows
    return np.where(depths[:, :, None] > 0, points, 0).astype(depths.dtype)
