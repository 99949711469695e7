"""Sampling intervals of cameras, and images at other samplings.

At scale z an image has z times as many pixels per side. A smaller photograph is the mean over blocks of pixels, as a
sensor with larger pixels would have measured it.
"""

from collections.abc import Sequence

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.types import Camera, Floats, Scene

MARGIN = 0.15  # fraction of the image's size by which a centre may lie outside and still count as seen
NEAR = 0.2  # world units: a camera does not see points nearer than this


def sampling_intervals(means: Floats, cameras: Sequence[Camera]) -> Floats:
    """Return the least distance ``z / f`` between two pixels' rays at each centre, over the cameras that see it.

    Parameters
    ----------
    means : ndarray of shape (N, 3)
        Centres, world frame.
    cameras : sequence of Camera
        f is the larger of a camera's two focal lengths.

    Returns
    -------
    ndarray of shape (N,), float64
        World units. A centre that no camera sees gets the largest of the others, or 0 if no camera sees any.
    """
    intervals = np.full(len(means), np.inf)
    for camera in cameras:
        x, y, z = (means @ camera.cam_from_world_R.T + camera.cam_from_world_t).T.astype(np.float64)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        is_seen = (z > NEAR) & (np.abs(u - camera.width / 2) < (0.5 + MARGIN) * camera.width)
        is_seen &= np.abs(v - camera.height / 2) < (0.5 + MARGIN) * camera.height
        intervals[is_seen] = np.minimum(intervals[is_seen], z[is_seen] / max(camera.fx, camera.fy))
    is_seen = np.isfinite(intervals)
    intervals[~is_seen] = intervals[is_seen].max(initial=0.0)
    return intervals


def zoom_camera(camera: Camera, scale: float) -> Camera:
    """Return the camera with ``scale`` times as many pixels per side, rounded down; the edge pixels are cut off.

    The focal length is exactly ``scale`` times the old one, so that a block of old pixels is exactly one new pixel.
    """
    width, height = int(camera.width * scale), int(camera.height * scale)
    return camera._replace(
        fx=camera.fx * scale,
        fy=camera.fy * scale,
        cx=camera.cx * scale,
        cy=camera.cy * scale,
        width=width,
        height=height,
    )


def block_means(image: Floats, n: int) -> Floats:
    """Return the means [H // n, W // n, D] over blocks of n x n pixels; the remainder at the edges is cut off."""
    height, width = image.shape[0] // n, image.shape[1] // n
    blocks = image[: height * n, : width * n].reshape(height, n, width, n, -1)
    means: Floats = blocks.mean(axis=(1, 3))
    return means


def shrink_photographs(scene: Scene, n: int) -> Scene:
    """Return the scene with photographs of 1/n of the size, by :func:`block_means`.

    Raises
    ------
    InputError
        A photograph has fewer than 16 n pixels a side.
    """
    if n == 1:
        return scene
    views = []
    for view in scene.train_views:
        photograph = view.load()
        camera = zoom_camera(photograph.camera, 1 / n)
        if min(camera.width, camera.height) < 16:
            raise InputError(f"photograph {view.name} at 1/{n} of its size has fewer than 16 pixels: lower --downscale")
        image = np.rint(block_means(photograph.image.astype(np.float64), n)).astype(np.uint8)
        views.append(photograph._replace(camera=camera, image=image, mask=None))
    return scene._replace(train_views=tuple(views))
