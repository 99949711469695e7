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
    axes,
    axes_vjp,
    compensation_vjp,
    conic,
    conic_vjp,
    dot,
    matmul3,
    matrix_rows,
    project_gaussian,
    project_gaussian_vjp,
    to_camera,
    transpose3,
)
from minisplat_ref.types import Camera, Floats, PrimitiveGradient, Primitives, Projection, ProjectionGradient

N_POSE = 12  # numbers of a pose: three rows of R and t


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
    R = matrix_rows(pose.R)
    x, y, z = wide_triple(primitives.means, n)
    p = to_camera(R, pose.centre, x, y, z)
    M = axes(wide_quaternion(primitives.quats, n), wide_triple(primitives.scales, n))
    footprint = project_gaussian(p, matmul3(R, M), constants)
    opacity = np.float64(primitives.opacities[n]) * footprint.compensation
    abc = conic(footprint)
    if extent.has_full_support:
        reach = support_box(footprint, opacity, extent.alpha_min, extent.width, extent.height)
    else:
        reach = inria_box(footprint, extent.width, extent.height)
    if is_seen(p[2], opacity, footprint, abc, reach, extent.alpha_min, constants):
        out.means2d[n, 0], out.means2d[n, 1] = footprint.x, footprint.y
        out.depths[n] = p[2]
        store_triple(out.conics, n, abc)
        out.opacities[n] = opacity
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
    alpha_min = dtype.type(conventions.alpha_min)
    extent = Extent(alpha_min, conventions.has_full_support, camera.width, camera.height)
    primitives, pose = to_device(Primitives(means, quats, scales, opacities)), to_device(pack_pose(camera))
    launch_rows(project_rows, n, primitives, pose, pack_constants(camera, conventions), extent, out)
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
        R = matrix_rows(pose.R)
        mean = wide_triple(primitives.means, n)
        p = to_camera(R, pose.centre, mean[0], mean[1], mean[2])
        quat, scale = wide_quaternion(primitives.quats, n), wide_triple(primitives.scales, n)
        M = axes(quat, scale)
        V = matmul3(R, M)
        footprint = project_gaussian(p, V, constants)
        v_opacity = np.float64(v.opacities[n])
        from_conic = conic_vjp(footprint, wide_triple(v.conics, n))
        from_blur = compensation_vjp(footprint, v_opacity * np.float64(primitives.opacities[n]), constants)
        v_cov = (from_conic[0] + from_blur[0], from_conic[1] + from_blur[1], from_conic[2] + from_blur[2])
        v_x, v_y, v_z = np.float64(v.means2d[n, 0]), np.float64(v.means2d[n, 1]), np.float64(v.depths[n])
        v_p, v_V = project_gaussian_vjp(p, V, constants, footprint, v_x, v_y, v_z, v_cov)
        R_transposed = transpose3(R)
        v_quat, v_scale = axes_vjp(quat, scale, matmul3(R_transposed, v_V))
        store_triple(out.means, n, (dot(R_transposed[0], v_p), dot(R_transposed[1], v_p), dot(R_transposed[2], v_p)))
        store_triple(out.scales, n, v_scale)
        store_triple(out.quats, n, v_quat)
        out.quats[n, 3] = v_quat[3]
        out.opacities[n] = v_opacity * footprint.compensation
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
        to_device(pack_pose(camera)),
        pack_constants(camera, conventions),
        to_device(v_projection),
        out,
        v_poses,
    )
    v_pose = np.sum(to_host(v_poses), axis=0).reshape(3, 4).astype(dtype)
    v = beside(means, out)
    return PrimitiveGradient(v.means, v.quats, v.scales, v.opacities, v_pose[:, :3].copy(), v_pose[:, 3].copy())
