"""The true surface of a synthetic scene, and the Chamfer distance of Gaussians from it.

Of a folder that ``minisplat-ref synthetic`` has written, the depth of every pixel is known. The training views' pixels
show points of the true surface, which are dense where many views look, or from near by.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from minisplat_ref.datasets.synthetic.files import load_depths
from minisplat_ref.datasets.synthetic.tracer import pixel_rays
from minisplat_ref.io.scene import rescale_camera
from minisplat_ref.types import Camera, Floats, Scene

POINTS_MAX = 200_000  # of the true surface; a few centimetres apart in a room, and searched in a fraction of a second
# A Gaussian of less than this opacity lets nine tenths of the light by even at its centre: it is hardly a surface.
# Right after an opacity reset (to 0.01) there is none above it, and no distance.
OPACITY_MIN = 0.1
# Extents around the cameras. Beyond, points are sparse on either side and the sky has no surface, so that a few
# distances would outweigh all others.
NEAR = 3.0


class Surface(NamedTuple):
    """Points of the true surface near the cameras."""

    cloud: cKDTree
    """Of at most POINTS_MAX points, world frame."""
    centre: Floats
    """[3] mean of the training cameras' centres."""
    extent: float
    """That of the scene, world units."""


def true_surface(folder: Path, scene: Scene) -> Surface | None:
    """Return the surface that the training views show; None where the folder does not hold true depths.

    Parameters
    ----------
    folder : Path
        What the scene was loaded from.
    scene : Scene
        At any size of its photographs.

    Raises
    ------
    InputError
        The folder holds true depths, and one of them is damaged.
    """
    depths = load_depths(folder, [view.name for view in scene.train_views])
    if depths is None:
        return None
    cameras = [
        rescale_camera(view.camera, width=depth.shape[1], height=depth.shape[0])
        for view, depth in zip(scene.train_views, depths, strict=True)
    ]
    depths = [depth / scene.frame.unit for depth in depths]
    return nearest_surface(unproject_views(cameras, depths), cameras, scene.extent)


def nearest_surface(points: Floats, cameras: Sequence[Camera], extent: float) -> Surface | None:
    """Return the surface near the cameras, of points [P, 3]; None if nothing is."""
    centre = np.mean([camera.center for camera in cameras], axis=0)  # [3]
    points = points[_is_near(points, centre, extent)]
    if len(points) > POINTS_MAX:
        points = np.random.default_rng(0).choice(points, POINTS_MAX, replace=False)
    return Surface(cKDTree(points), centre, extent) if len(points) else None


def unproject_views(cameras: Sequence[Camera], depths: Sequence[Floats]) -> Floats:
    """Return the points [P, 3] of the world that pixels of depth [H, W] show; the depth is 0 at the sky."""
    points = []
    for camera, depth in zip(cameras, depths, strict=True):
        rays = pixel_rays(camera, 0.5, 0.5, np.arange(camera.height))  # [H * W, 3] of camera z = 1
        z = depth.ravel()[:, None]  # [H * W, 1]
        points.append((camera.center + z * rays)[z[:, 0] > 0])
    return np.concatenate(points)


def surface_distance(gaussians: Any, surface: Surface) -> float | None:
    """Return the Chamfer distance between the centres of Gaussians and the true surface, in extents of the scene.

    Of the Gaussians those near the cameras count that have an opacity of at least OPACITY_MIN; None if there is none.
    """
    means = gaussians.means.astype(np.float64)  # [N, 3]
    counts = _is_near(means, surface.centre, surface.extent)
    if hasattr(gaussians, "opacity_logits"):  # an extension's population may have none
        counts &= gaussians.opacity_logits >= np.log(OPACITY_MIN / (1 - OPACITY_MIN))
    return chamfer(means[counts], surface.cloud) / surface.extent if counts.any() else None


def _is_near(points: Floats, centre: Floats, extent: float) -> Any:
    return np.linalg.norm(points - centre, axis=1) <= NEAR * extent  # [P]


def chamfer(points: Floats, cloud: cKDTree) -> float:
    """Return the mean distance of points [P, 3] to the cloud plus that of the cloud to the points, world units."""
    there, back = cloud.query(points)[0], cKDTree(points).query(cloud.data)[0]
    return float(there.mean() + back.mean())
