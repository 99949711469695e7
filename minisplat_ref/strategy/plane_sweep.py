"""Plane-sweep stereo (Collins 1996): the depth of each pixel of a small photograph, from its neighbours.

Structure from motion finds points where a photograph has corners; a sweep gives depths between them. For a plane
parallel to the image at depth d, a neighbour's photograph is warped by the homography of the plane,

    x_n ~ K_n (R + t e_z^T / d) K^-1 x        (R, t): neighbour's camera from the photograph's

and compared over a window W by the zero-mean normalised cross-correlation, which neither a gain nor an offset of the
brightness changes:

    zncc = (E[a b] - E[a] E[b]) / sqrt(Var[a] Var[b])        E, Var over W

The planes are evenly spaced in 1/d, a pixel and a half of a neighbour apart. The score of a plane is the mean over the
better half of the neighbours, because in the others something may hide it; the depth is that of the best plane, refined
by the parabola through it and the planes beside it. A depth counts where the correlation is high, and where a
neighbour's own depth agrees (:func:`are_confirmed`). Left out: slanted planes, and any smoothness between pixels.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates, uniform_filter

from minisplat_ref.reference.pinhole import pinhole_rays, project_into_image
from minisplat_ref.types import Bools, Camera, Floats, Ints

WINDOW = 5
"""Pixels, side of W."""
HALF = WINDOW // 2
"""Pixels on either side of the middle of a window."""
CORRELATION_MIN = 0.7
"""Of a depth that counts. Noise alone correlates by 0.2, one over the root of 25 pixels. With 0.8, and with two
neighbours that confirm, more points are right, and held-out photographs worse (``docs/measured/adaptive.md``).
"""
CONTRAST_MIN = 0.01
"""Standard deviation of the brightness in W, out of 1, below which a pixel has no depth: 2.5 levels of 255."""
AGREEMENT = 0.02
"""Of the depth; a neighbour's depth that differs by less confirms a point."""
PIXELS_BETWEEN = 1.5
"""Pixels from one plane to the next, in the median over the pixels and the neighbours: less than a third of W, so that
no peak of the correlation is missed."""
PLANES_MIN, PLANES_MAX = 48, 192
"""Planes, whatever the neighbours. With 192 a sweep takes half a second; no reason recorded for 48."""
VARIANCE_PRODUCT_MIN = 1e-10
"""Guards the division where a window is uniform; the contrast rules these pixels out."""


class GrayView(NamedTuple):
    """A small photograph without its colours."""

    camera: Camera
    gray: Floats
    """[H, W] float32 in [0, 1]."""


class DepthMap(NamedTuple):
    """The depths of a photograph, as far as they count."""

    depths: Floats
    """[H, W] camera z, world units; 0 where none counts."""
    correlations: Floats
    """[H, W] score of the best plane; 0 where no depth counts."""


def sweep_planes(view: GrayView, others: Sequence[GrayView], inverse_depths: Floats) -> DepthMap:
    """Return the depths at which a photograph looks like its neighbours.

    Parameters
    ----------
    view : GrayView
    others : sequence of GrayView
        Its neighbours, at least one.
    inverse_depths : ndarray of shape (D,)
        1/d of the planes, evenly spaced, ascending; D is at least 3.

    Returns
    -------
    DepthMap
        Without depths at the first and the last plane, beyond which the best one may lie.
    """
    height, width = view.gray.shape
    mean_a, var_a = _moments(view.gray)
    scores = np.empty((len(others), len(inverse_depths), height, width), np.float32)
    for k, other in enumerate(others):
        rays = relative_rays(view.camera, other.camera)
        for i, inverse_depth in enumerate(inverse_depths):
            b, is_inside = warp(rays, other, inverse_depth)
            mean_b, var_b = _moments(b)
            covariance = uniform_filter(view.gray * b, WINDOW) - mean_a * mean_b
            zncc = covariance / np.sqrt(np.maximum(var_a * var_b, VARIANCE_PRODUCT_MIN))
            scores[k, i] = np.where(is_inside, zncc, -1.0)
    better_half = max(1, (len(others) + 1) // 2)
    total = np.sort(scores, axis=0)[-better_half:].mean(axis=0)  # [D, H, W]
    best = total.argmax(axis=0)  # [H, W]
    highest = np.take_along_axis(total, best[None], axis=0)[0]
    is_between = (best > 0) & (best < len(inverse_depths) - 1)
    offset = _vertex(total, np.clip(best, 1, len(inverse_depths) - 2))
    inverse = inverse_depths[best] + offset * (inverse_depths[1] - inverse_depths[0])
    counts = is_between & (highest > CORRELATION_MIN) & (var_a > CONTRAST_MIN**2)
    counts[:HALF], counts[-HALF:], counts[:, :HALF], counts[:, -HALF:] = False, False, False, False  # no whole window
    return DepthMap(np.where(counts, 1.0 / inverse, 0.0), np.where(counts, highest, 0.0))


def choose_planes(camera: Camera, others: Sequence[Camera], near: float, far: float) -> Floats:
    """Return 1/d of the planes [D] to sweep between two depths, evenly spaced, ascending.

    Parameters
    ----------
    camera : Camera
        Of the photograph.
    others : sequence of Camera
        Of its neighbours.
    near, far : float
        Camera z, world units.
    """
    moves = [np.zeros(0)]
    for other in others:
        rays = relative_rays(camera, other)
        (u, v, at_far), (u_near, v_near, at_near) = (meet_plane(rays, other, 1 / depth) for depth in (far, near))
        move = np.hypot(u_near - u, v_near - v)
        moves.append(move[at_far & at_near & np.isfinite(move)])
    pixels = np.concatenate(moves)
    n = math.ceil(np.median(pixels) / PIXELS_BETWEEN) + 1 if len(pixels) else PLANES_MAX
    return np.linspace(1 / far, 1 / near, min(max(n, PLANES_MIN), PLANES_MAX))


class PlaneRays(NamedTuple):
    """The rays of a camera's pixels in the frame of another: a plane at depth d is met at ``directions + t / d``."""

    directions: Floats
    """[3, H, W] float32, R times the ray with z = 1."""
    t: Floats
    """[3] float32, world units."""


def relative_rays(camera: Camera, other: Camera) -> PlaneRays:
    """Return the rays of a camera in the frame of another."""
    R = other.cam_from_world_R @ camera.cam_from_world_R.T
    t = other.cam_from_world_t - R @ camera.cam_from_world_t
    xs, ys = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    directions = np.moveaxis(pinhole_rays(xs, ys, camera) @ R.T, -1, 0)
    return PlaneRays(np.ascontiguousarray(directions, np.float32), t.astype(np.float32))


def meet_plane(rays: PlaneRays, other: Camera, inverse_depth: float) -> tuple[Floats, Floats, Bools]:
    """Return where a neighbour's image has the points at which rays meet a plane, u and v [H, W], pixels.

    The third array says which of them are in front of the neighbour; where others are has no meaning.
    """
    x, y, z = (d + np.float32(shift * inverse_depth) for d, shift in zip(rays.directions, rays.t, strict=True))
    is_before = z > 0
    z = np.where(is_before, z, np.float32(1))
    u = np.float32(other.fx) * x / z + np.float32(other.cx)
    return u, np.float32(other.fy) * y / z + np.float32(other.cy), is_before


def warp(rays: PlaneRays, other: GrayView, inverse_depth: float) -> tuple[Floats, Bools]:
    """Return a neighbour's photograph as the camera would see it on the plane at that depth.

    Parameters
    ----------
    rays : PlaneRays
        Of the camera, in the neighbour's frame.
    other : GrayView
        The neighbour.
    inverse_depth : float

    Returns
    -------
    gray : ndarray of shape (H, W)
        float32.
    is_inside : ndarray of shape (H, W) of bool
        Where the neighbour shows the plane, and half a window around it.
    """
    camera = other.camera
    u, v, is_inside = meet_plane(rays, camera, inverse_depth)
    is_inside &= (u >= HALF) & (v >= HALF) & (u <= camera.width - HALF) & (v <= camera.height - HALF)
    half = np.float32(0.5)
    return map_coordinates(other.gray, [v - half, u - half], order=1, mode="nearest"), is_inside


def are_confirmed(view: GrayView, own: DepthMap, others: Sequence[tuple[GrayView, DepthMap]]) -> Bools:
    """Return where the depth of a photograph is also that of a neighbour, [H, W]."""
    ys, xs = np.nonzero(own.depths > 0)
    points = surface_points(view.camera, own.depths, ys, xs)
    is_confirmed = np.zeros(own.depths.shape, bool)
    for other, found in others:
        ids, xy, z = project_into_image(points, other.camera)
        columns, rows = xy.astype(int).T
        there = found.depths[rows, columns]
        agrees = ids[(there > 0) & (np.abs(there - z) < AGREEMENT * z)]
        is_confirmed[ys[agrees], xs[agrees]] = True
    return is_confirmed


def surface_points(camera: Camera, depths: Floats, rows: Ints, columns: Ints) -> Floats:
    """Return the points [P, 3], world frame, at the depths of these pixels."""
    in_camera = pinhole_rays(columns + 0.5, rows + 0.5, camera) * depths[rows, columns][:, None]
    return (in_camera - camera.cam_from_world_t) @ camera.cam_from_world_R


def _moments(gray: Floats) -> tuple[Floats, Floats]:
    """Return mean and variance over the window around each pixel."""
    mean = uniform_filter(gray, WINDOW)
    return mean, np.maximum(uniform_filter(gray * gray, WINDOW) - mean * mean, 0.0)


def _vertex(total: Floats, middle: Ints) -> Floats:
    """Return the peak of the parabola through three neighbouring planes, in planes from the middle one."""
    left, center, right = (np.take_along_axis(total, (middle + k)[None], axis=0)[0] for k in (-1, 0, 1))
    curvature = left - 2 * center + right
    is_peak = curvature < 0
    return np.where(is_peak, 0.5 * (left - right) / np.where(is_peak, curvature, 1.0), 0.0).clip(-0.5, 0.5)
