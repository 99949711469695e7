"""The fusion of a depth map into a volume, in NumPy; :mod:`minisplat_ref.mechanisms.fusion.volume` has the equations.

Between the centres of pixels the inverse of the depth is interpolated, since ``1 / z`` of a plane is linear in the
image: so the surface of a plane is exact at any angle. Where the four depths around a place differ by more than the
truncation there is an edge of an object, and the nearest pixel counts alone.
"""

import numpy as np

from minisplat_ref.mechanisms.fusion.volume import BOUND, DepthMap, Grid, Volume
from minisplat_ref.reference.pinhole import pinhole
from minisplat_ref.types import Camera, Floats

SLABS = 4  # of x at a time


def fuse(volume: Volume, grid: Grid, camera: Camera, view: DepthMap, truncation: float) -> None:
    """Add a view to a volume, in place.

    Parameters
    ----------
    volume : Volume
    grid : Grid
        Where its voxels are.
    camera : Camera
        In the world of the grid.
    view : DepthMap
    truncation : float
        t, world units, where nothing is contracted.
    """
    for first in range(0, grid.shape[0], SLABS):
        _fuse_slabs(volume, grid, camera, view, truncation, slice(first, first + SLABS))


def _fuse_slabs(volume: Volume, grid: Grid, camera: Camera, view: DepthMap, truncation: float, slabs: slice) -> None:
    places = grid.places(slabs)
    t = np.broadcast_to(truncation, places.shape[:-1])
    is_inside = np.ones(places.shape[:-1], bool)
    if grid.contraction is not None:
        length = np.linalg.norm(places, axis=-1)
        is_inside = length < BOUND
        with np.errstate(divide="ignore"):
            t = np.where(length <= 1, truncation, truncation / np.maximum(BOUND - length, 0))
    points = np.where(is_inside[..., None], grid.to_world(places), 0)
    in_camera = points @ camera.cam_from_world_R.T + camera.cam_from_world_t
    depths = in_camera[..., 2]
    is_before = is_inside & (depths > 0)
    pixels = pinhole(in_camera[is_before], camera)
    shown, colors = _sample(view, pixels, t[is_before])
    s = shown - depths[is_before]
    is_valid = (shown > 0) & (s >= -t[is_before])
    at = tuple(index[is_valid] for index in np.nonzero(is_before))
    s, t_valid, colors = s[is_valid], t[is_before][is_valid], colors[is_valid]
    distances, weights, means, n_near = (field[slabs] for field in volume)
    w = weights[at]
    distances[at] = (w * distances[at] + np.minimum(s / t_valid, 1)) / (w + 1)
    weights[at] = w + 1
    is_near = s < t_valid
    near = tuple(index[is_near] for index in at)
    n_near[near] += 1
    means[near] += (colors[is_near] - means[near]) / n_near[near][:, None]


def _sample(view: DepthMap, pixels: Floats, t: Floats) -> tuple[Floats, Floats]:
    """Return depths [P] and colours [P, 3] at image positions [P, 2]; 0 outside and where no surface is shown."""
    height, width = view.depth.shape
    u, v = pixels.T
    is_in_image = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    u, v = np.where(is_in_image, u, 0.0), np.where(is_in_image, v, 0.0)
    x, y = np.clip(u - 0.5, 0, width - 1), np.clip(v - 0.5, 0, height - 1)
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    a, b = x - x0, y - y0
    corners = [(y0, x0), (y0, x1), (y1, x0), (y1, x1)]
    shares = [(1 - b) * (1 - a), (1 - b) * a, b * (1 - a), b * a]
    four = np.array([view.depth[corner] for corner in corners])  # [4, P]
    is_smooth = (four.min(axis=0) > 0) & (np.ptp(four, axis=0) <= t)
    inverse = sum(share / np.where(is_smooth, z, 1) for share, z in zip(shares, four, strict=True))
    mixed = sum(share[:, None] * view.image[corner] for share, corner in zip(shares, corners, strict=True))
    nearest = np.floor(v).astype(int), np.floor(u).astype(int)
    depth = np.where(is_smooth, 1 / inverse, view.depth[nearest])
    color = np.where(is_smooth[:, None], mixed, view.image[nearest])
    return np.where(is_in_image, depth, 0.0), color
