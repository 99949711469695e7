"""Synthetic scenes, stage 8: the points that structure from motion would have found.

Feature detectors respond where the image changes, so points are drawn in proportion to the image gradient: many on
textures and edges, hardly any on bare walls, none at the sky. A point counts if at least two training views see it.
Positions, colours and visibility come from the ray tracer and are exact; noise is added on request.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.datasets.synthetic.geometry import first_hits
from minisplat_ref.datasets.synthetic.tracer import (
    LIT_UP_TO,
    TracedView,
    World,
    pixel_rays,
    points_along,
    radiance,
)
from minisplat_ref.io.srgb import encode_srgb
from minisplat_ref.types import Bools, Camera, Floats, Ints

N_VIEWS_MIN = 2  # a point is triangulated from at least two views
OVERSAMPLING = 1.3  # candidates drawn per wanted point: some are seen only once
GRADIENT_MIN = 2.0  # grey levels per pixel; less is shading of a bare surface, where feature detectors do not respond
BARE_WEIGHT = 0.005  # of a pixel below that; others have their gradient's excess. The odd wrong match on a wall


class SparsePoints(NamedTuple):
    """A sparse reconstruction."""

    points: Floats
    """[P, 3] float64, world frame."""
    colors: NDArray[np.uint8]
    """[P, 3] sRGB."""
    visibility: Bools
    """[V, P] whether a training view sees a point."""


def sample_points(
    world: World,
    cameras: Sequence[Camera],
    traced: Sequence[TracedView],
    n_points: int,
    noise: float,
    rng: np.random.Generator,
) -> SparsePoints:
    """Draw points on the visible surfaces.

    Parameters
    ----------
    world : World
        The scene.
    cameras : sequence of V Camera
        Training cameras.
    traced : sequence of V TracedView
        What they see.
    n_points : int
        Largest number to return; fewer if the views share too few surfaces.
    noise : float
        Standard deviation of the error of each coordinate, world units.
    rng : numpy.random.Generator
        Draws pixels and noise.

    Returns
    -------
    SparsePoints
        Each seen by at least two of the cameras.
    """
    weights = np.stack([_feature_weights(view) for view in traced]).ravel()  # [V H W]
    pixels = np.flatnonzero(weights)
    # Each of several exponential variates is the smallest with probability proportional to its rate, so sorting them
    # draws without replacement.
    pixels = pixels[np.argsort(rng.exponential(size=len(pixels)) / weights[pixels])]
    batches = [SparsePoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros((len(cameras), 0), bool))]
    n_missing = n_points
    while n_missing > 0 and len(pixels):
        n_drawn = int(OVERSAMPLING * n_missing) + 1
        points, colors = _lift(world, cameras, traced, pixels[:n_drawn])
        visibility = np.stack([_sees(world, camera, points) for camera in cameras])  # [V, n_drawn]
        shared = np.flatnonzero(visibility.sum(axis=0) >= N_VIEWS_MIN)[:n_missing]
        batches.append(SparsePoints(points[shared], colors[shared], visibility[:, shared]))
        pixels = pixels[n_drawn:]
        n_missing -= len(shared)
    points = np.concatenate([batch.points for batch in batches])
    return SparsePoints(
        points=points + noise * rng.standard_normal(points.shape),
        colors=np.concatenate([batch.colors for batch in batches]),
        visibility=np.concatenate([batch.visibility for batch in batches], axis=1),
    )


def project_points(camera: Camera, points: Floats) -> tuple[Floats, Floats]:
    """[n, 2] pixels and [n] camera z of world points [n, 3]."""
    in_camera = points @ camera.cam_from_world_R.T + camera.cam_from_world_t  # [n, 3]
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    return focal * in_camera[:, :2] / in_camera[:, 2:] + centre, in_camera[:, 2]


def _feature_weights(view: TracedView) -> Floats:
    """Return the likelihood [H, W] that a feature detector responds at a pixel; 0 at the sky."""
    grey = view.image.mean(axis=2)
    gradient = np.hypot(*np.gradient(grey))
    return np.where(view.depth > 0, np.maximum(gradient - GRADIENT_MIN, 0.0) + BARE_WEIGHT, 0.0)


def _lift(
    world: World, cameras: Sequence[Camera], traced: Sequence[TracedView], pixels: Ints
) -> tuple[Floats, NDArray[np.uint8]]:
    """Surface points [n, 3] behind pixel centres and their colours [n, 3]; pixels index the views' stacked images."""
    height, width = traced[0].depth.shape
    view_ids, in_view = np.divmod(pixels, height * width)  # [n] each
    origins = np.stack([camera.center for camera in cameras])[view_ids]  # [n, 3]
    directions = np.zeros((len(pixels), 3))
    for index, camera in enumerate(cameras):
        mine = view_ids == index
        directions[mine] = pixel_rays(camera, 0.5, 0.5, np.arange(height))[in_view[mine]]
    hits = first_hits(world.primitives, origins, directions)
    colors = np.zeros_like(directions)
    n_lights = len(world.light_positions)
    for light in range(n_lights):
        light_ids = np.full(len(pixels), light)
        colors += np.clip(radiance(world, origins, directions, hits, light_ids), 0.0, 1.0) / n_lights
    return points_along(origins, directions, hits), np.round(255.0 * encode_srgb(colors)).astype(np.uint8)


def _sees(world: World, camera: Camera, points: Floats) -> Bools:
    """[n] whether a point lies inside the image and nothing hides it."""
    pixels, depths = project_points(camera, points)
    is_inside = (depths > 0) & np.all((pixels >= 0) & (pixels <= [camera.width, camera.height]), axis=1)
    origin = camera.center
    is_inside[is_inside] = first_hits(world.primitives, origin, points[is_inside] - origin).distances > LIT_UP_TO
    return is_inside
