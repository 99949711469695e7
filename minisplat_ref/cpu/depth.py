"""Surface point of every pixel, forward and backward: the loops over ``scalar/depth.py``.

The backward pass groups the pixels by their Gaussian first, so that each Gaussian has one writer.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.cpu.projection import pack_pose
from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.jit.literals import HALF, ZERO
from minisplat_ref.scalar.covariance import normalize, normalize_vjp, rotation_vjp
from minisplat_ref.scalar.depth import densest_depth, densest_depth_vjp, gaussian_axes, pixel_ray
from minisplat_ref.scalar.projection import dot, matrix_rows, transpose3
from minisplat_ref.types import Camera, Floats, Ints, SurfacePoints


class Ellipsoids(NamedTuple):
    """The fields of Gaussians on which surface points depend."""

    means: Floats
    """[N, 3] world frame."""
    quats: Floats
    """[N, 4] wxyz."""
    scales: Floats
    """[N, 3] standard deviations, world units."""


class PixelLists(NamedTuple):
    """The pixels of each Gaussian."""

    pixels: Ints
    """[P] flat indices, grouped by Gaussian."""
    offsets: Ints
    """[N + 1] Gaussian n owns pixels[offsets[n]:offsets[n + 1]]."""


@scalar
def _wide(quat):
    """Return the four numbers in float64."""
    return np.float64(quat[0]), np.float64(quat[1]), np.float64(quat[2]), np.float64(quat[3])


@scalar
def _offset(means, n, centre):
    return means[n, 0] - centre[0], means[n, 1] - centre[1], means[n, 2] - centre[2]


@scalar
def _scale(scales, n):
    """Return three float64: the square of a float32 below 1e-19 would be 0."""
    return np.float64(scales[n, 0]), np.float64(scales[n, 1]), np.float64(scales[n, 2])


@kernel()
def _surface_points(
    ellipsoids,  # Ellipsoids
    pose,  # Pose
    intrinsics,  # [4] fx, fy, cx, cy
    dominant_ids,  # [H, W]
    points,  # [H, W, 3]
    depths,  # [H, W]
):
    means, quats, scales = ellipsoids
    centre = pose.centre
    for y in prange(dominant_ids.shape[0]):
        R = matrix_rows(pose.R)
        for x in range(dominant_ids.shape[1]):
            n = dominant_ids[y, x]
            if n < 0:
                continue
            d = pixel_ray(R, x + HALF, y + HALF, intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3])
            t = densest_depth(gaussian_axes(_wide(quats[n])), _scale(scales, n), _offset(means, n, centre), d)
            if t > 0:
                depths[y, x] = t
                for i in range(3):
                    points[y, x, i] = centre[i] + t * d[i]


def pack_intrinsics(camera: Camera) -> Floats:
    """Return fx, fy, cx and cy as an array [4]."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float64)


def surface_points(means: Floats, quats: Floats, scales: Floats, camera: Camera, dominant_ids: Ints) -> SurfacePoints:
    """Densest point of each pixel's dominant Gaussian; see ``reference.depth.surface_points``."""
    out = SurfacePoints(np.zeros((*dominant_ids.shape, 3), means.dtype), np.zeros(dominant_ids.shape, means.dtype))
    ellipsoids = Ellipsoids(means, quats, scales)
    _surface_points(ellipsoids, pack_pose(camera), pack_intrinsics(camera), dominant_ids, out.points, out.depths)
    return out


@scalar
def _gaussian_vjp(n, pixels, ellipsoids, pose, intrinsics, depths, v_surface, v):
    """Write the gradient with respect to one Gaussian, the sum over its pixels."""
    R = matrix_rows(pose.R)
    quat = _wide(ellipsoids.quats[n])
    axes, scale, u = gaussian_axes(quat), _scale(ellipsoids.scales, n), _offset(ellipsoids.means, n, pose.centre)
    v_points, v_depths = v_surface
    v_mean, v_scale, v_axes = v.means[n], v.scales[n], np.zeros((3, 3))
    for pixel in pixels:
        y, x = pixel // depths.shape[1], pixel % depths.shape[1]
        t = depths[y, x]
        if t <= ZERO:
            continue
        d = pixel_ray(R, x + HALF, y + HALF, intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3])
        v_t = v_depths[y, x] + dot(v_points[y, x], d)
        precision = ZERO * t
        for k in range(3):
            precision += (dot(axes[k], d) / scale[k]) ** 2
        for k in range(3):
            v_axis, v_s, v_p = densest_depth_vjp(axes[k], scale[k], t, precision, v_t, u, d)
            v_scale[k] += v_s
            for i in range(3):
                v_axes[k, i] += v_axis[i]
                v_mean[i] += v_p * axes[k][i]
    w, x, y, z, inverse_length = normalize(*quat)
    v_unit = rotation_vjp(w, x, y, z, transpose3(matrix_rows(v_axes)))
    v_quat = normalize_vjp((w, x, y, z), inverse_length, v_unit)
    for i in range(4):
        v.quats[n, i] = v_quat[i]


@kernel()
def _surface_points_vjp(
    ellipsoids,  # Ellipsoids
    pose,  # Pose
    intrinsics,  # [4] fx, fy, cx, cy
    lists,  # PixelLists
    depths,  # [H, W]
    v_surface,  # SurfacePoints
    v,  # Ellipsoids, zeros
):
    pixels, offsets = lists
    for n in prange(offsets.size - 1):
        if offsets[n] < offsets[n + 1]:
            own = pixels[offsets[n] : offsets[n + 1]]
            _gaussian_vjp(n, own, ellipsoids, pose, intrinsics, depths, v_surface, v)


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
    ids = dominant_ids.ravel()
    pixels = np.argsort(ids, kind="stable")[np.count_nonzero(ids < 0) :]
    offsets = np.concatenate([[0], np.cumsum(np.bincount(ids[ids >= 0], minlength=len(means)))])
    depths = surface_points(means, quats, scales, camera, dominant_ids).depths
    v = Ellipsoids(*(np.zeros(array.shape, array.dtype) for array in (means, quats, scales)))
    _surface_points_vjp(
        Ellipsoids(means, quats, scales),
        pack_pose(camera),
        pack_intrinsics(camera),
        PixelLists(pixels, offsets),
        depths,
        SurfacePoints(v_points, v_depths),
        v,
    )
    return v
