"""Rays through pixels, their hits, and blend statistics, which the ray tracers of Gaussians share.

All floats are float64: a thin Gaussian far away leaves float32 no digit of its distance. P rays, N Gaussians, H hits.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.reference.pinhole import pinhole_rays, with_principal_point
from minisplat_ref.types import BlendStats, Bools, Camera, Floats, Ints


class Rays(NamedTuple):
    """Half-lines, or parts of them: ``O + t d`` for near < t < far."""

    origins: Floats
    """[P, 3] world frame."""
    directions: Floats
    """[P, 3] of any length but zero; depths are in units of it."""
    near: Floats
    """[P]."""
    far: Floats
    """[P]."""


class Hits(NamedTuple):
    """The blended hits of rays, ray after ray, nearest first."""

    offsets: Ints
    """[P + 1] ray r has the hits offsets[r]:offsets[r + 1]."""
    ray_ids: Ints
    """[H]."""
    gaussian_ids: Ints
    """[H]."""
    unclamped: Floats
    """[H] alpha before the clamp."""
    depths: Floats
    """[H] t."""
    weights: Floats
    """[H] ``w = alpha T``."""
    transmittances: Floats
    """[P] behind the last hit."""


class BlendedRays(NamedTuple):
    """The colours of rays, and the values that their gradient needs."""

    image: Floats
    """[P, 3] background included."""
    depths: Floats
    """[P] accumulated, ``sum w t``."""
    transmittances: Floats
    """[P] behind the last hit."""
    n_hits: Ints
    """[P] number of blended hits."""
    is_seen: Bools
    """[N] whether any ray has blended the Gaussian."""
    kept: Any = None
    """The hits in a form of the tracer's own; ``None`` if there was no room for them."""


class RayGradient(NamedTuple):
    """Gradient of the loss with respect to everything that :class:`BlendedRays` depends on."""

    means: Floats
    """[N, 3]."""
    shapes: Floats
    """[N, ...] with respect to the shapes that the extension makes of quaternions and scales."""
    opacities: Floats
    """[N]."""
    colors: Floats
    """[N, 3]."""
    background: Floats
    """[3]."""
    origins: Floats
    """[P, 3]."""
    directions: Floats
    """[P, 3]."""


class Tracer(NamedTuple):
    """The functions of tracing any rays through one population, by a backend."""

    list_hits: Callable[[Rays, Conventions], Hits]
    """``list_hits(rays, conventions)``: the blended hits of each ray."""
    blend: Callable[[Floats, Rays, Floats, Conventions], BlendedRays]
    """``blend(colors, rays, background, conventions)``: the blended values of each ray."""


class ImageTracer(NamedTuple):
    """The functions of tracing the rays of :func:`pixel_rays` of one camera through one population, by a backend."""

    list_hits: Callable[[Rays, Conventions], Hits]
    """As of :class:`Tracer`."""
    blend: Callable[[Floats, Rays, Floats, Conventions], BlendedRays]
    """As of :class:`Tracer`."""
    blend_vjp: Callable[..., RayGradient]
    """``blend_vjp(colors, rays, background, conventions, blended, v_blended)``: the gradient of that, with derivatives
    with respect to the image [P, 3], the depths [P] and the transmittances [P]."""


def pixel_rays(camera: Camera, conventions: Conventions) -> Rays:
    """Return the rays [H W] through the centres of all pixels, row by row, with directions whose camera z is 1.

    So t is the camera z of a point on the ray, and the near and far planes of ``conventions`` bound it.
    """
    camera = with_principal_point(camera, conventions).astype(np.float64)
    across, down = (slopes @ camera.cam_from_world_R for slopes in _slopes(camera))
    directions = (across + camera.cam_from_world_R[2] + down[:, None]).reshape(-1, 3)
    origins = np.broadcast_to(camera.center, directions.shape)
    limits = (np.full(len(directions), plane) for plane in (conventions.near_plane, conventions.far_plane))
    return Rays(np.ascontiguousarray(origins), directions, *limits)


def pixel_rays_vjp(
    camera: Camera, conventions: Conventions, v_origins: Floats, v_directions: Floats
) -> tuple[Floats, Floats]:
    """Gradient of :func:`pixel_rays`.

    With ``d = R^T r`` and ``O = -R^T t``::

        v_R = sum_p r_p v_d_p^T - t v_O^T,   v_t = -R v_O,   v_O = sum_p v_O_p

    The slopes of r depend on the column or on the row, so derivatives are summed over rows or columns first.

    Parameters
    ----------
    camera, conventions
        As for :func:`pixel_rays`.
    v_origins, v_directions : ndarray of shape (P, 3)
        Derivatives with respect to the rays.

    Returns
    -------
    v_R : ndarray of shape (3, 3)
    v_t : ndarray of shape (3,)
    """
    camera = with_principal_point(camera, conventions).astype(np.float64)
    R, t = camera.cam_from_world_R, camera.cam_from_world_t
    v_O = v_origins.sum(axis=0)
    across, down = _slopes(camera)
    by_pixel = v_directions.reshape(camera.height, camera.width, 3)
    by_column, by_row = by_pixel.sum(axis=0), by_pixel.sum(axis=1)
    v_R = across.T @ by_column + down.T @ by_row - np.outer(t, v_O)
    v_R[2] += by_row.sum(axis=0)
    return v_R, -R @ v_O


def blend_stats(hits: Hits, size: tuple[int, int], n: int) -> BlendStats:
    """Return the contribution of each of n Gaussians to an image.

    Parameters
    ----------
    hits : Hits
        Hits of the image's rays, row by row.
    size : tuple of 2 ints
        Height and width.
    n : int
        Number of Gaussians.
    """
    ids, rays, weights = hits.gaussian_ids, hits.ray_ids, hits.weights
    largest, dominant_ids = np.zeros(n), np.full(size[0] * size[1], -1, np.int32)
    np.maximum.at(largest, ids, weights)
    heaviest_last = np.lexsort((-np.arange(len(ids)), weights, rays))  # of equals the front-most comes last
    dominant_ids[rays[heaviest_last]] = ids[heaviest_last]
    counts = np.bincount(dominant_ids[dominant_ids >= 0], minlength=n)
    return BlendStats(
        np.bincount(ids, weights, n).astype(np.float64),
        largest,
        np.bincount(ids, minlength=n).astype(np.int32),
        counts.astype(np.int32),
        dominant_ids.reshape(size),
    )


def _slopes(camera: Camera) -> tuple[Floats, Floats]:
    """Return (x, 0, 0) [W, 3] and (0, y, 0) [H, 3]: with (0, 0, 1) they add up to rays in the camera frame."""
    across = pinhole_rays(np.arange(camera.width) + 0.5, camera.cy, camera)
    down = pinhole_rays(camera.cx, np.arange(camera.height) + 0.5, camera)
    return across * [1, 0, 0], down * [0, 1, 0]
