"""Losses of a depth map, forward and backward: the loops over ``formulas.py``.

All three terms depend on ratios of depths alone, so the backward pass collects derivatives with respect to the
logarithm of the depth, log z = log(sum w z) - log(alpha). There a pixel gathers from its neighbours, so each number has
one writer.
"""

import math
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import DEPTH_ALPHA_MIN
from minisplat_ref.cpu.projection import pack_pose
from minisplat_ref.extensions.geometry.formulas import edge_weight, huber, huber_vjp, pixel_normal, pixel_normal_vjp
from minisplat_ref.extensions.geometry.weights import EDGE_SHARPNESS, SFM_DEPTH_TOLERANCE, GeometricWeights
from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.jit.literals import HALF, ONE, ZERO
from minisplat_ref.scalar.projection import dot, matrix_rows, to_camera
from minisplat_ref.types import Bools, Camera, Floats, Ints


class GeometricTape(NamedTuple):
    """The values that the forward pass keeps for the gradient of the geometric loss."""

    accumulated_depth: Floats
    alpha: Floats
    depth: Floats
    """[H, W] 0 where there is none."""
    intrinsics: Floats
    """[4] fx, fy, cx, cy."""
    edges: Floats
    """[2, H, W] weight between a pixel and its right and its lower neighbour; 0 where one of them has no depth."""
    normals: Floats
    """[H, W, 3] 0 where there is none."""
    counts: Ints
    """[2] numbers of pairs of depths and of pairs of normals."""
    point_pixels: Ints
    """[n] flat index of the pixel that a point falls on."""
    point_slopes: Floats
    """[n] derivative of each point's cost with respect to the pixel's log depth."""
    weights: GeometricWeights


# --- pairs of pixels ---


@kernel()
def _weigh_edges(depth, photograph, sharpness, edges):
    height, width = depth.shape
    for y in prange(height):
        for x in range(width):
            if depth[y, x] <= ZERO:
                continue
            if x + 1 < width and depth[y, x + 1] > ZERO:
                edges[0, y, x] = edge_weight(photograph[y, x], photograph[y, x + 1], sharpness)
            if y + 1 < height and depth[y + 1, x] > ZERO:
                edges[1, y, x] = edge_weight(photograph[y, x], photograph[y + 1, x], sharpness)


@kernel()
def _depth_steps(depth, edges, sums):
    height, width = depth.shape
    for y in prange(height):
        for x in range(width):
            if x + 1 < width and depth[y, x] > ZERO and depth[y, x + 1] > ZERO:
                sums[y, 0] += edges[0, y, x] * abs(math.log(depth[y, x + 1] / depth[y, x]))
                sums[y, 1] += ONE
            if y + 1 < height and depth[y, x] > ZERO and depth[y + 1, x] > ZERO:
                sums[y, 0] += edges[1, y, x] * abs(math.log(depth[y + 1, x] / depth[y, x]))
                sums[y, 1] += ONE


@scalar
def _pair_derivative(weight, z, z_other):
    """Return the derivative of a pair's cost with respect to log z."""
    if z > z_other:
        return weight
    return -weight if z < z_other else ZERO * weight


@kernel()
def _depth_steps_vjp(depth, edges, v_pair, v_logs):
    height, width = depth.shape
    for y in prange(height):
        for x in range(width):
            z = depth[y, x]
            v = ZERO * z
            if x + 1 < width:
                v += _pair_derivative(edges[0, y, x], z, depth[y, x + 1])
            if x > 0:
                v += _pair_derivative(edges[0, y, x - 1], z, depth[y, x - 1])
            if y + 1 < height:
                v += _pair_derivative(edges[1, y, x], z, depth[y + 1, x])
            if y > 0:
                v += _pair_derivative(edges[1, y - 1, x], z, depth[y - 1, x])
            v_logs[y, x] += v_pair * v


# --- pairs of normals ---


@kernel()
def _normals(depth, intrinsics, normals):
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    for y in prange(height - 1):
        for x in range(width - 1):
            z, z_right, z_down = depth[y, x], depth[y, x + 1], depth[y + 1, x]
            if z > ZERO and z_right > ZERO and z_down > ZERO:
                s, t = (x + HALF - cx) / fx, (y + HALF - cy) / fy
                normal, _ = pixel_normal(z, z_right, z_down, s, t, fx, fy)
                for i in range(3):
                    normals[y, x, i] = normal[i]


@scalar
def _is_normal(normal):
    return dot(normal, normal) > HALF  # of length 1 or 0


@scalar
def _half_square(a, b):
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return HALF * (x * x + y * y + z * z)


@kernel()
def _normal_differences(normals, edges, sums):
    height, width, _ = normals.shape
    for y in prange(height):
        for x in range(width):
            normal = normals[y, x]
            if not _is_normal(normal):
                continue
            if x + 1 < width and _is_normal(normals[y, x + 1]):
                sums[y, 0] += edges[0, y, x] * edges[0, y, x + 1] * _half_square(normal, normals[y, x + 1])
                sums[y, 1] += ONE
            if y + 1 < height and _is_normal(normals[y + 1, x]):
                sums[y, 0] += edges[1, y, x] * edges[1, y + 1, x] * _half_square(normal, normals[y + 1, x])
                sums[y, 1] += ONE


@scalar
def _add_difference(v, weight, a, b):
    """Add the derivative of a pair's cost with respect to its first normal; a missing normal adds nothing."""
    if not _is_normal(b):
        return v
    return v[0] + weight * (a[0] - b[0]), v[1] + weight * (a[1] - b[1]), v[2] + weight * (a[2] - b[2])


@kernel()
def _normal_differences_vjp(depth, intrinsics, normals, edges, v_pair, v_steps):
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    for y in prange(height - 1):
        for x in range(width - 1):
            n = normals[y, x]
            if not _is_normal(n):
                continue
            # The last row and column have no normals, so neighbours to the right and below are always there.
            v = (ZERO * fx, ZERO * fx, ZERO * fx)
            v = _add_difference(v, v_pair * edges[0, y, x] * edges[0, y, x + 1], n, normals[y, x + 1])
            v = _add_difference(v, v_pair * edges[1, y, x] * edges[1, y + 1, x], n, normals[y + 1, x])
            if x > 0:
                v = _add_difference(v, v_pair * edges[0, y, x - 1] * edges[0, y, x], n, normals[y, x - 1])
            if y > 0:
                v = _add_difference(v, v_pair * edges[1, y - 1, x] * edges[1, y, x], n, normals[y - 1, x])
            s, t = (x + HALF - cx) / fx, (y + HALF - cy) / fy
            v_right, v_down = pixel_normal_vjp(depth[y, x], depth[y, x + 1], depth[y + 1, x], s, t, fx, fy, v)
            v_steps[0, y, x] = v_right
            v_steps[1, y, x] = v_down


# --- points ---


@kernel()
def _look_up(
    points,  # [P, 3]
    pose,  # Pose
    intrinsics,  # [4] fx, fy, cx, cy
    depth,  # [H, W]
    tolerance,
    pixels,  # [P]
    costs,  # [P]
    slopes,  # [P]
):
    height, width = depth.shape
    for i in prange(points.shape[0]):
        x, y, z = to_camera(matrix_rows(pose.R), pose.centre, points[i, 0], points[i, 1], points[i, 2])
        if not z > ZERO:
            continue
        u, v = intrinsics[0] * x / z + intrinsics[2], intrinsics[1] * y / z + intrinsics[3]
        if not (u >= ZERO and u < width and v >= ZERO and v < height):
            continue
        column, row = int(u), int(v)
        if depth[row, column] > ZERO:
            error = math.log(depth[row, column] / z)
            pixels[i] = row * width + column
            costs[i] = huber(error, tolerance)
            slopes[i] = huber_vjp(error, tolerance)


# --- the stage ---


def geometric_loss(
    accumulated_depth: Floats,
    alpha: Floats,
    photograph: Floats,
    camera: Camera,
    points: Floats,
    weights: GeometricWeights,
    mask: Bools | None = None,
) -> tuple[float, GeometricTape]:
    """Return the weighted sum of the terms; those of weight 0 are not computed. See ``reference.geometric_loss``."""
    dtype, (height, width) = accumulated_depth.dtype, accumulated_depth.shape
    counts_here = (alpha > DEPTH_ALPHA_MIN) & (accumulated_depth > 0)
    if mask is not None:
        counts_here &= mask
    depth = np.zeros((height, width), dtype)
    np.divide(accumulated_depth, alpha, out=depth, where=counts_here)
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    edges, normals = np.zeros((2, height, width), dtype), np.zeros((height, width, 3), dtype)
    sums = np.zeros((2, height, 2))  # for depths and for normals: sum of costs, number of pairs
    if weights.depth_smoothness or weights.normal_smoothness:
        photograph = np.ascontiguousarray(photograph, dtype)
        _weigh_edges(depth, photograph, dtype.type(EDGE_SHARPNESS), edges)
    if weights.depth_smoothness:
        _depth_steps(depth, edges, sums[0])
    if weights.normal_smoothness:
        _normals(depth, intrinsics.astype(dtype), normals)
        _normal_differences(normals, edges, sums[1])
    pixels, costs, slopes = _seen_points(depth, camera, intrinsics, points if weights.sfm_depth else points[:0])

    costs_of_differences, n_differences = np.moveaxis(sums.sum(axis=1), 1, 0)
    means = costs_of_differences / np.maximum(n_differences, 1)
    loss = weights.depth_smoothness * means[0] + weights.normal_smoothness * means[1]
    loss += weights.sfm_depth * costs.sum() / max(1, len(costs))
    counts = n_differences.astype(np.int64)
    intrinsics = intrinsics.astype(dtype)
    tape = GeometricTape(accumulated_depth, alpha, depth, intrinsics, edges, normals, counts, pixels, slopes, weights)
    return float(loss), tape


def _seen_points(depth: Floats, camera: Camera, intrinsics: Floats, points: Floats) -> tuple[Ints, Floats, Floats]:
    """Return pixel, cost and slope [n] of the points that fall on a pixel with depth, in float64 as their positions."""
    n = len(points)
    pixels, costs, slopes = np.full(n, -1), np.zeros(n), np.zeros(n)
    points = np.ascontiguousarray(points, np.float64)
    _look_up(points, pack_pose(camera), intrinsics, depth, SFM_DEPTH_TOLERANCE, pixels, costs, slopes)
    is_seen = pixels >= 0
    return pixels[is_seen], costs[is_seen], slopes[is_seen]


def geometric_loss_vjp(tape: GeometricTape, v_loss: float = 1.0) -> tuple[Floats, Floats]:
    """Return the gradient with respect to accumulated depth and opacity; see ``reference.geometric_loss_vjp``."""
    depth, weights, dtype = tape.depth, tape.weights, tape.depth.dtype
    v_logs = np.zeros(depth.shape, dtype)
    if weights.depth_smoothness:
        v_pair = dtype.type(v_loss * weights.depth_smoothness / max(1, tape.counts[0]))
        _depth_steps_vjp(depth, tape.edges, v_pair, v_logs)
    if weights.normal_smoothness:
        v_pair = dtype.type(v_loss * weights.normal_smoothness / max(1, tape.counts[1]))
        v_right, v_down = v_steps = np.zeros((2, *depth.shape), dtype)
        _normal_differences_vjp(depth, tape.intrinsics, tape.normals, tape.edges, v_pair, v_steps)
        v_logs -= v_right + v_down
        v_logs[:, 1:] += v_right[:, :-1]
        v_logs[1:] += v_down[:-1]
    if len(tape.point_pixels):
        v_point = v_loss * weights.sfm_depth / len(tape.point_pixels)
        v_seen = np.bincount(tape.point_pixels, weights=v_point * tape.point_slopes, minlength=depth.size)
        v_logs += v_seen.reshape(depth.shape).astype(dtype)
    v_accumulated_depth, v_alpha = np.zeros_like(depth), np.zeros_like(depth)
    np.divide(v_logs, tape.accumulated_depth, out=v_accumulated_depth, where=depth > 0)
    np.divide(-v_logs, tape.alpha, out=v_alpha, where=depth > 0)
    return v_accumulated_depth, v_alpha
