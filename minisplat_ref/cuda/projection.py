"""Projection of all Gaussians of a view, forward and backward: a thread for each Gaussian.

The arithmetic is float64 whatever the data, as on the CPU and for its reasons; results are rounded when they are
stored, except conics. The gradient with respect to the pose is a sum over Gaussians: each block sums its threads' parts
in order, and the blocks' sums are added in order.
"""

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.projection import pack_constants, pack_pose
from minisplat_ref.cuda.arrays import beside, empty, to_device, to_host
from minisplat_ref.cuda.target import ROW_THREADS, cuda, device_function, gpu_kernel, launch_rows, n_row_blocks
from minisplat_ref.jit.literals import ZERO
from minisplat_ref.scalar.extent import Extent, inria_box, is_seen, support_box
from minisplat_ref.scalar.projection import (
    Pose,
    axes,
    axes_vjp,
    compensation_vjp,
    conic,
    conic_vjp,
    dot,
    matmul3,
    project_gaussian,
    project_gaussian_vjp,
    to_camera,
    transpose3,
)
from minisplat_ref.types import Camera, Floats, PrimitiveGradient, Primitives, Projection, ProjectionGradient

N_POSE = 12  # numbers of a pose: three rows of R and t


def pass_pose(camera: Camera) -> Pose:
    """Return the pose as tuples of numbers, which are passed to a kernel without a copy to the device."""
    R, centre = pack_pose(camera)
    return Pose(tuple(map(tuple, R)), tuple(centre))  # type: ignore[arg-type]


def pack_extent(camera: Camera, conventions: Conventions, dtype: np.dtype) -> Extent:
    """Return the size of the image and how far a Gaussian reaches in it."""
    return Extent(dtype.type(conventions.alpha_min), conventions.has_full_support, camera.width, camera.height)


@device_function
def wide_triple(table, n):
    """Return the first three numbers of a row as float64."""
    return np.float64(table[n, 0]), np.float64(table[n, 1]), np.float64(table[n, 2])


@device_function
def wide_quaternion(quats, n):
    """Return a row of quaternions as float64."""
    return np.float64(quats[n, 0]), np.float64(quats[n, 1]), np.float64(quats[n, 2]), np.float64(quats[n, 3])


@device_function
def store_triple(table, n, values):
    """Write the first three numbers of a row."""
    table[n, 0] = values[0]
    table[n, 1] = values[1]
    table[n, 2] = values[2]


@device_function
def project_one(mean, quat, scale, opacity, pose, constants, extent):
    """Return whether a Gaussian is seen, its depth, footprint, conic, opacity there and reach (radii, box)."""
    p = to_camera(pose.R, pose.centre, mean[0], mean[1], mean[2])
    footprint = project_gaussian(p, matmul3(pose.R, axes(quat, scale)), constants)
    dimmed = opacity * footprint.compensation
    abc = conic(footprint)
    if extent.has_full_support:
        reach = support_box(footprint, dimmed, extent.alpha_min, extent.width, extent.height)
    else:
        reach = inria_box(footprint, extent.width, extent.height)
    seen = is_seen(p[2], dimmed, footprint, abc, reach, extent.alpha_min, constants)
    return seen, p[2], footprint, abc, dimmed, reach


@gpu_kernel
def project_rows(
    primitives,  # Primitives
    pose,  # Pose
    constants,
    extent,
    out,  # Projection
):
    """Project one Gaussian."""
    n = cuda.grid(1)
    if n >= primitives.opacities.shape[0]:
        return
    mean, quat = wide_triple(primitives.means, n), wide_quaternion(primitives.quats, n)
    scale, opacity = wide_triple(primitives.scales, n), np.float64(primitives.opacities[n])
    seen, depth, footprint, abc, dimmed, reach = project_one(mean, quat, scale, opacity, pose, constants, extent)
    if seen:
        out.means2d[n, 0], out.means2d[n, 1] = footprint.x, footprint.y
        out.depths[n] = depth
        store_triple(out.conics, n, abc)
        out.opacities[n] = dimmed
        out.radii[n, 0], out.radii[n, 1] = int(reach[0]), int(reach[1])
        for i in range(4):
            out.boxes[n, i] = int(reach[2 + i])
    else:
        out.means2d[n, 0], out.means2d[n, 1] = ZERO, ZERO
        out.depths[n] = ZERO
        store_triple(out.conics, n, (ZERO, ZERO, ZERO))
        out.opacities[n] = ZERO
        out.radii[n, 0], out.radii[n, 1] = 0, 0
        for i in range(4):
            out.boxes[n, i] = 0


def project(
    means: Floats, quats: Floats, scales: Floats, opacities: Floats, camera: Camera, conventions: Conventions
) -> Projection:
    """Project every Gaussian into the image; see ``reference.projection.project``."""
    n, dtype = len(means), means.dtype
    out = Projection(
        empty((n, 2), dtype),
        empty(n, dtype),
        empty((n, 3), np.float64),
        empty(n, dtype),
        empty((n, 2), np.int32),
        empty((n, 4), np.int32),
    )
    rules = pack_constants(camera, conventions), pack_extent(camera, conventions, dtype)
    launch_rows(project_rows, n, to_device(Primitives(means, quats, scales, opacities)), pass_pose(camera), *rules, out)
    return beside(means, out)


@device_function
def store_pose_row(parts, thread, first, v_p, v_V, mean, M):
    """Write the gradient with respect to a row of R, and then of t: p = R x + t and V = R M."""
    parts[thread, first] = v_p * mean[0] + dot(v_V, M[0])
    parts[thread, first + 1] = v_p * mean[1] + dot(v_V, M[1])
    parts[thread, first + 2] = v_p * mean[2] + dot(v_V, M[2])
    parts[thread, first + 3] = v_p


@device_function
def sum_parts(parts, n_parts, sums):
    """Sum the threads' ``parts`` [threads, n_parts] of a block in order; all of its threads call it."""
    cuda.syncthreads()
    k = cuda.threadIdx.x
    if k < n_parts:
        total = parts[0, k]
        for i in range(1, ROW_THREADS):
            total += parts[i, k]
        sums[cuda.blockIdx.x, k] = total


@device_function
def project_one_vjp(mean, quat, scale, opacity, pose, constants, v):
    """Chain the gradient of one footprint.

    Parameters
    ----------
    mean, quat, scale, opacity : tuples of float64, and float64
    pose : Pose
    constants : ProjectionConstants
    v : tuple
        Gradient with respect to centre (x, y), depth, conic (a, b, c) and opacity.

    Returns
    -------
    gradient with respect to mean, quat, scale, opacity, camera coordinates and V, and M
        V = R M projects the axes M of the Gaussian.
    """
    (v_x, v_y), v_z, v_conic, v_opacity = v
    p = to_camera(pose.R, pose.centre, mean[0], mean[1], mean[2])
    M = axes(quat, scale)
    V = matmul3(pose.R, M)
    footprint = project_gaussian(p, V, constants)
    from_conic = conic_vjp(footprint, v_conic)
    from_blur = compensation_vjp(footprint, v_opacity * opacity, constants)
    v_cov = (from_conic[0] + from_blur[0], from_conic[1] + from_blur[1], from_conic[2] + from_blur[2])
    v_p, v_V = project_gaussian_vjp(p, V, constants, footprint, v_x, v_y, v_z, v_cov)
    R_transposed = transpose3(pose.R)
    v_quat, v_scale = axes_vjp(quat, scale, matmul3(R_transposed, v_V))
    v_mean = dot(R_transposed[0], v_p), dot(R_transposed[1], v_p), dot(R_transposed[2], v_p)
    return v_mean, v_quat, v_scale, v_opacity * footprint.compensation, v_p, v_V, M


@gpu_kernel
def project_rows_vjp(
    primitives,  # Primitives
    radii,  # [N, 2]
    pose,  # Pose
    constants,
    v,  # ProjectionGradient
    out,  # (means, quats, scales, opacities) of the gradient
    v_poses,  # [blocks, 12]
):
    """Chain the gradient of one Gaussian."""
    parts = cuda.shared.array((ROW_THREADS, N_POSE), np.float64)
    n, thread = cuda.grid(1), cuda.threadIdx.x
    for k in range(N_POSE):
        parts[thread, k] = ZERO
    n_rows = primitives.opacities.shape[0]
    if n < n_rows and radii[n, 0] == 0:
        store_triple(out.means, n, (ZERO, ZERO, ZERO))
        store_triple(out.scales, n, (ZERO, ZERO, ZERO))
        store_triple(out.quats, n, (ZERO, ZERO, ZERO))
        out.quats[n, 3] = ZERO
        out.opacities[n] = ZERO
    elif n < n_rows:
        mean, quat = wide_triple(primitives.means, n), wide_quaternion(primitives.quats, n)
        scale, opacity = wide_triple(primitives.scales, n), np.float64(primitives.opacities[n])
        v_center = np.float64(v.means2d[n, 0]), np.float64(v.means2d[n, 1])
        v_footprint = v_center, np.float64(v.depths[n]), wide_triple(v.conics, n), np.float64(v.opacities[n])
        v_mean, v_quat, v_scale, v_opacity, v_p, v_V, M = project_one_vjp(
            mean, quat, scale, opacity, pose, constants, v_footprint
        )
        store_triple(out.means, n, v_mean)
        store_triple(out.scales, n, v_scale)
        store_triple(out.quats, n, v_quat)
        out.quats[n, 3] = v_quat[3]
        out.opacities[n] = v_opacity
        store_pose_row(parts, thread, 0, v_p[0], v_V[0], mean, M)
        store_pose_row(parts, thread, 4, v_p[1], v_V[1], mean, M)
        store_pose_row(parts, thread, 8, v_p[2], v_V[2], mean, M)
    sum_parts(parts, N_POSE, v_poses)


def project_vjp(
    means: Floats,
    quats: Floats,
    scales: Floats,
    opacities: Floats,
    camera: Camera,
    conventions: Conventions,
    projection: Projection,
    v_projection: ProjectionGradient,
) -> PrimitiveGradient:
    """Chain the gradient of a projection to its inputs; see ``reference.projection.project_vjp``."""
    n, dtype = len(means), means.dtype
    out = Primitives(empty((n, 3), dtype), empty((n, 4), dtype), empty((n, 3), dtype), empty(n, dtype))
    v_poses = empty((n_row_blocks(n), N_POSE), np.float64)
    launch_rows(
        project_rows_vjp,
        n,
        to_device(Primitives(means, quats, scales, opacities)),
        to_device(projection.radii),
        pass_pose(camera),
        pack_constants(camera, conventions),
        to_device(v_projection),
        out,
        v_poses,
    )
    v_pose = np.sum(to_host(v_poses), axis=0).reshape(3, 4).astype(dtype)
    v = beside(means, out)
    return PrimitiveGradient(v.means, v.quats, v.scales, v.opacities, v_pose[:, :3].copy(), v_pose[:, 3].copy())
