"""Surface point of every pixel, forward and backward: a thread for each pixel, and for each Gaussian.

The arithmetic is float64, as on the CPU. The backward pass groups the pixels by their Gaussian first, on the host, so
that each Gaussian has one writer.
"""

from typing import Any

import numpy as np

from minisplat_ref.cpu.depth import Ellipsoids, PixelLists, pack_intrinsics
from minisplat_ref.cuda.arrays import beside, empty, to_device, to_host
from minisplat_ref.cuda.projection import pass_pose, store_triple, wide_quaternion, wide_triple
from minisplat_ref.cuda.target import cuda, device_function, gpu_kernel, launch_rows
from minisplat_ref.jit.literals import HALF, ZERO
from minisplat_ref.scalar.covariance import normalize, normalize_vjp, rotation_vjp
from minisplat_ref.scalar.depth import densest_depth, densest_depth_vjp, gaussian_axes, pixel_ray
from minisplat_ref.scalar.projection import dot, transpose3
from minisplat_ref.types import Camera, Floats, Ints, SurfacePoints


@device_function
def offset(means, n, centre):
    """Return a mean relative to the camera's centre."""
    mean = wide_triple(means, n)
    return mean[0] - centre[0], mean[1] - centre[1], mean[2] - centre[2]


@device_function
def ray(R, intrinsics, x, y):
    """Return the direction of the ray through the centre of a pixel."""
    return pixel_ray(R, x + HALF, y + HALF, intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3])


@gpu_kernel
def write_points(
    ellipsoids,  # Ellipsoids
    pose,  # Pose
    intrinsics,  # [4] fx, fy, cx, cy
    dominant_ids,  # [H, W]
    out,  # SurfacePoints
):
    """Write the point of one pixel."""
    means, quats, scales = ellipsoids
    points, depths = out
    i, width = cuda.grid(1), dominant_ids.shape[1]
    if i >= dominant_ids.shape[0] * width:
        return
    y = i // width
    x = i - y * width
    n, t = dominant_ids[y, x], np.float64(0)
    d = ray(pose.R, intrinsics, x, y)
    if n >= 0:
        axes = gaussian_axes(wide_quaternion(quats, n))
        t = densest_depth(axes, wide_triple(scales, n), offset(means, n, pose.centre), d)
    is_seen = t > ZERO
    depths[y, x] = t if is_seen else ZERO
    for k in range(3):
        points[y, x, k] = pose.centre[k] + t * d[k] if is_seen else ZERO


@device_function
def add_scaled(sums, k, factor, vector):
    """Add a multiple of a vector to row ``k`` of ``sums``."""
    for i in range(3):
        sums[k, i] += factor * vector[i]


@gpu_kernel
def write_points_vjp(
    ellipsoids,  # Ellipsoids
    pose,  # Pose
    intrinsics,  # [4] fx, fy, cx, cy
    lists,  # PixelLists
    depths,  # [H, W]
    v_surface,  # SurfacePoints
    v,  # Ellipsoids
):
    """Write the gradient with respect to one Gaussian, the sum over its pixels."""
    pixels, offsets = lists
    v_points, v_depths = v_surface
    n = cuda.grid(1)
    if n >= offsets.shape[0] - 1:
        return
    R, width = pose.R, depths.shape[1]
    quat, scale = wide_quaternion(ellipsoids.quats, n), wide_triple(ellipsoids.scales, n)
    axes, u = gaussian_axes(quat), offset(ellipsoids.means, n, pose.centre)
    sums = cuda.local.array((5, 3), np.float64)  # of the three axes, the mean and the scales
    for k in range(5):
        for i in range(3):
            sums[k, i] = ZERO
    for place in range(offsets[n], offsets[n + 1]):
        pixel = pixels[place]
        y = pixel // width
        x = pixel - y * width
        t = np.float64(depths[y, x])
        if t > ZERO:
            d = ray(R, intrinsics, x, y)
            v_t = np.float64(v_depths[y, x]) + dot((v_points[y, x, 0], v_points[y, x, 1], v_points[y, x, 2]), d)
            precision = np.float64(0)
            for k in range(3):
                precision += (dot(axes[k], d) / scale[k]) ** 2
            for k in range(3):
                v_axis, v_s, v_p = densest_depth_vjp(axes[k], scale[k], t, precision, v_t, u, d)
                add_scaled(sums, k, np.float64(1), v_axis)
                add_scaled(sums, 3, v_p, axes[k])
                sums[4, k] += v_s
    w, qx, qy, qz, inverse_length = normalize(quat[0], quat[1], quat[2], quat[3])
    v_axes = (
        (sums[0, 0], sums[0, 1], sums[0, 2]),
        (sums[1, 0], sums[1, 1], sums[1, 2]),
        (sums[2, 0], sums[2, 1], sums[2, 2]),
    )
    v_quat = normalize_vjp((w, qx, qy, qz), inverse_length, rotation_vjp(w, qx, qy, qz, transpose3(v_axes)))
    store_triple(v.quats, n, v_quat)
    v.quats[n, 3] = v_quat[3]
    store_triple(v.means, n, sums[3])
    store_triple(v.scales, n, sums[4])


def surface_points(means: Floats, quats: Floats, scales: Floats, camera: Camera, dominant_ids: Ints) -> SurfacePoints:
    """Densest point of each pixel's dominant Gaussian; see ``reference.depth.surface_points``."""
    shape = dominant_ids.shape
    out = SurfacePoints(empty((*shape, 3), means.dtype), empty(shape, means.dtype))
    launch_rows(write_points, shape[0] * shape[1], *_scene(means, quats, scales, camera), to_device(dominant_ids), out)
    return beside(means, out)


def surface_points_vjp(
    means: Floats,
    quats: Floats,
    scales: Floats,
    camera: Camera,
    dominant_ids: Ints,
    v_points: Floats,
    v_depths: Floats,
) -> tuple[Floats, Floats, Floats]:
    """Chain the gradient of the surface points to the Gaussians; see ``reference.depth.surface_points_vjp``."""
    n, scene = len(means), _scene(means, quats, scales, camera)
    on_device = scene[0]
    depths = surface_points(on_device.means, on_device.quats, on_device.scales, camera, dominant_ids).depths
    ids = to_host(dominant_ids).ravel()
    pixels = np.argsort(ids, kind="stable")[np.count_nonzero(ids < 0) :]
    offsets = np.append(0, np.cumsum(np.bincount(ids[ids >= 0], minlength=n)))
    lists, v_surface = to_device(PixelLists(pixels, offsets)), to_device(SurfacePoints(v_points, v_depths))
    v = Ellipsoids(*(empty(array.shape, array.dtype) for array in (means, quats, scales)))
    launch_rows(write_points_vjp, n, *scene, lists, depths, v_surface, v)
    return beside(means, v)


def _scene(means: Floats, quats: Floats, scales: Floats, camera: Camera) -> tuple[Any, Any, Any]:
    """Return the Gaussians, the pose and the intrinsics as kernels read them."""
    return to_device(Ellipsoids(means, quats, scales)), pass_pose(camera), tuple(pack_intrinsics(camera))
