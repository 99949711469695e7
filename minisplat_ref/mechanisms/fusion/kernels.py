"""The fusion of a depth map into a volume, compiled: the twin of :mod:`minisplat_ref.mechanisms.fusion.reference`."""

import math

import numpy as np

from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.mechanisms.fusion.volume import BOUND, DepthMap, Grid, Volume
from minisplat_ref.types import Camera


def fuse(volume: Volume, grid: Grid, camera: Camera, view: DepthMap, truncation: float) -> None:
    """Add a view to a volume, in place; arguments as for the reference."""
    numbers = [*grid.origin, grid.voxel, truncation]
    contraction = [0.0] * 4 if grid.contraction is None else [*grid.contraction.center, grid.contraction.radius]
    _fuse(
        volume,
        np.array(numbers),
        np.array(contraction),
        np.ascontiguousarray(view.depth, np.float64),
        np.ascontiguousarray(view.image, np.float64),
        np.column_stack([camera.cam_from_world_R, camera.cam_from_world_t]).astype(np.float64),
        np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
    )


@scalar
def _row(pose, i, x, y, z):
    """Return a coordinate of a point in the camera frame."""
    return pose[i, 0] * x + pose[i, 1] * y + pose[i, 2] * z + pose[i, 3]


@scalar
def _clip(x, low, high):
    """Return x, at least ``low`` and at most ``high``."""
    return min(max(x, low), high)


@kernel()
def _fuse(volume, numbers, contraction, depth, image, pose, intrinsics):
    distances, weights, colors, n_near = volume
    n_x, n_y, n_z = distances.shape
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    voxel, truncation, radius = numbers[3], numbers[4], contraction[3]
    for i in prange(n_x):
        for j in range(n_y):
            for k in range(n_z):
                x, y, z = numbers[0] + voxel * i, numbers[1] + voxel * j, numbers[2] + voxel * k
                t = truncation
                if radius > 0.0:
                    length = math.sqrt(x * x + y * y + z * z)
                    if length >= BOUND:
                        continue
                    factor = radius
                    if length > 1.0:
                        factor = radius / (length * (BOUND - length))
                        t = truncation / (BOUND - length)
                    x, y, z = contraction[0] + factor * x, contraction[1] + factor * y, contraction[2] + factor * z
                z_camera = _row(pose, 2, x, y, z)
                if z_camera <= 0.0:
                    continue
                u = fx * _row(pose, 0, x, y, z) / z_camera + cx
                v = fy * _row(pose, 1, x, y, z) / z_camera + cy
                if not (0.0 <= u < width and 0.0 <= v < height):
                    continue

                left, top = _clip(u - 0.5, 0.0, width - 1.0), _clip(v - 0.5, 0.0, height - 1.0)
                x0, y0 = int(left), int(top)
                x1, y1 = min(x0 + 1, width - 1), min(y0 + 1, height - 1)
                a, b = left - x0, top - y0
                z00, z01, z10, z11 = depth[y0, x0], depth[y0, x1], depth[y1, x0], depth[y1, x1]
                nearest, farthest = min(z00, z01, z10, z11), max(z00, z01, z10, z11)
                is_smooth = nearest > 0.0 and farthest - nearest <= t
                shown = depth[int(v), int(u)]
                if is_smooth:
                    upper, lower = (1.0 - a) / z00 + a / z01, (1.0 - a) / z10 + a / z11
                    shown = 1.0 / ((1.0 - b) * upper + b * lower)
                s = shown - z_camera
                if not (shown > 0.0 and s >= -t):
                    continue

                w = weights[i, j, k]
                distances[i, j, k] = (w * distances[i, j, k] + min(s / t, 1.0)) / (w + 1.0)
                weights[i, j, k] = w + 1.0
                if s < t:
                    n_near[i, j, k] += 1.0
                    for c in range(3):
                        color = image[int(v), int(u), c]
                        if is_smooth:
                            upper = (1.0 - a) * image[y0, x0, c] + a * image[y0, x1, c]
                            lower = (1.0 - a) * image[y1, x0, c] + a * image[y1, x1, c]
                            color = (1.0 - b) * upper + b * lower
                        colors[i, j, k, c] += (color - colors[i, j, k, c]) / n_near[i, j, k]
