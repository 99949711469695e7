"""Projection of all Gaussians of a view, forward and backward: the loops over ``scalar/projection.py``.

The body of a parallel loop is its own function: Numba 0.68 loses writes to a NamedTuple's arrays directly under
``prange``. Every Gaussian has one writer. Only the camera gradient is a sum over Gaussians: a fixed number of chunks,
whatever the number of threads, each sum their part in float64, and the parts are added in order.

Eight Gaussians are processed together. Branches become masks: culled Gaussians are computed too, and stored as zeros.

The arithmetic is float64 whatever the data: in float32 a mean far from the world's origin would lose its position, a
needle its thin axis, and the square of f / z could overflow. Results are rounded when they are stored, except conics:
see :class:`Projection`.
"""

import numpy as np

from minisplat_ref.constants import COMPENSATION_FLOOR, JACOBIAN_CLAMP, Conventions
from minisplat_ref.cpu.gaussian_rows import (
    DOUBLE,
    add_pose_row,
    clear_culled,
    contiguous,
    eight_rows,
    gather_wide,
    list_visible,
    load_rows,
    quaternion,
    scatter_triple,
    scatter_visible,
    sum_parts,
    triple,
)
from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.jit.lanes import WIDTH, iota, scatter
from minisplat_ref.jit.literals import ZERO
from minisplat_ref.scalar.extent import Extent, inria_box, is_seen, support_box
from minisplat_ref.scalar.projection import (
    Pose,
    ProjectionConstants,
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

N_CHUNKS = 64  # parts of the camera-gradient sum; fixed, so that its rounding does not depend on the thread count


def pack_pose(camera: Camera) -> Pose:
    """Return R and the point that R x + t maps to the origin, float64.

    The point is the camera centre. It is solved for rather than computed as -R^T t, so that R (x - point) equals
    R x + t even where R is not quite a rotation: the gradient treats its nine entries as free.
    """
    R = np.ascontiguousarray(camera.cam_from_world_R, np.float64)
    return Pose(R, -np.linalg.solve(R, np.asarray(camera.cam_from_world_t, np.float64)))


def pack_constants(camera: Camera, conventions: Conventions) -> ProjectionConstants:
    """Return camera intrinsics and conventions as float64 scalars."""
    cx, cy = camera.cx, camera.cy
    if not conventions.uses_principal_point:
        cx, cy = camera.width / 2, camera.height / 2
    tan_x, tan_y = camera.width / (2 * camera.fx), camera.height / (2 * camera.fy)
    margin = JACOBIAN_CLAMP - 1
    if conventions.clamp_is_symmetric:
        limits = (-JACOBIAN_CLAMP * tan_x, JACOBIAN_CLAMP * tan_x, -JACOBIAN_CLAMP * tan_y, JACOBIAN_CLAMP * tan_y)
    else:
        limits = (
            -(cx / camera.fx + margin * tan_x),
            (camera.width - cx) / camera.fx + margin * tan_x,
            -(cy / camera.fy + margin * tan_y),
            (camera.height - cy) / camera.fy + margin * tan_y,
        )
    numbers = (camera.fx, camera.fy, cx, cy, *limits, conventions.near_plane, conventions.far_plane)
    scalars = [np.float64(number) for number in (*numbers, conventions.eps2d, COMPENSATION_FLOOR)]
    return ProjectionConstants._make([*scalars, conventions.is_antialiased])


@scalar
def _project_eight(rows, primitives, pose, constants, extent, out):
    R = matrix_rows(pose.R)
    x, y, z = triple(primitives.means, rows)
    p = to_camera(R, pose.centre, x, y, z)
    M = axes(quaternion(primitives.quats, rows), triple(primitives.scales, rows))
    footprint = project_gaussian(p, matmul3(R, M), constants)
    opacity = gather_wide(primitives.opacities, rows, 0) * footprint.compensation
    a, b, c = conic(footprint)
    if extent.has_full_support:
        rx, ry, x0, y0, x1, y1 = support_box(footprint, opacity, extent.alpha_min, extent.width, extent.height)
    else:
        rx, ry, x0, y0, x1, y1 = inria_box(footprint, extent.width, extent.height)
    reach = rx, ry, x0, y0, x1, y1
    is_drawn = is_seen(p[2], opacity, footprint, (a, b, c), reach, extent.alpha_min, constants)
    scatter_visible(is_drawn, out.means2d, rows, 0, footprint.x)
    scatter_visible(is_drawn, out.means2d, rows, 1, footprint.y)
    scatter_visible(is_drawn, out.depths, rows, 0, p[2])
    scatter_visible(is_drawn, out.conics, rows, 0, a)
    scatter_visible(is_drawn, out.conics, rows, 1, b)
    scatter_visible(is_drawn, out.conics, rows, 2, c)
    scatter_visible(is_drawn, out.opacities, rows, 0, opacity)
    scatter_visible(is_drawn, out.radii, rows, 0, rx)
    scatter_visible(is_drawn, out.radii, rows, 1, ry)
    scatter_visible(is_drawn, out.boxes, rows, 0, x0)
    scatter_visible(is_drawn, out.boxes, rows, 1, y0)
    scatter_visible(is_drawn, out.boxes, rows, 2, x1)
    scatter_visible(is_drawn, out.boxes, rows, 3, y1)


@kernel()
def _project(
    primitives,  # Primitives
    pose,  # Pose
    constants,
    extent,
    out,  # Projection
):
    n_gaussians = primitives.opacities.shape[0]
    for block in prange((n_gaussians + WIDTH - 1) // WIDTH):
        _project_eight(eight_rows(block * WIDTH, n_gaussians), primitives, pose, constants, extent, out)


def project(
    means: Floats, quats: Floats, scales: Floats, opacities: Floats, camera: Camera, conventions: Conventions
) -> Projection:
    """Project every Gaussian into the image; see ``reference.projection.project``."""
    n, dtype = len(means), means.dtype
    out = Projection(
        np.empty((n, 2), dtype),
        np.empty(n, dtype),
        np.empty((n, 3), np.float64),
        np.empty(n, dtype),
        np.empty((n, 2), np.int32),
        np.empty((n, 4), np.int32),
    )
    primitives = Primitives(*contiguous(means, quats, scales, opacities))
    alpha_min = dtype.type(conventions.alpha_min)
    extent = Extent(alpha_min, conventions.has_full_support, camera.width, camera.height)
    _project(primitives, pack_pose(camera), pack_constants(camera, conventions), extent, out)
    return out


@scalar
def _project_eight_vjp(rows, is_counted, primitives, pose, constants, v, out, v_pose):
    R, centre = pose
    x, y, z = triple(primitives.means, rows)
    p = to_camera(R, centre, x, y, z)
    quat, scale = quaternion(primitives.quats, rows), triple(primitives.scales, rows)
    M = axes(quat, scale)
    V = matmul3(R, M)
    footprint = project_gaussian(p, V, constants)
    v_opacity = gather_wide(v.opacities, rows, 0)
    from_conic = conic_vjp(footprint, triple(v.conics, rows))
    from_blur = compensation_vjp(footprint, v_opacity * gather_wide(primitives.opacities, rows, 0), constants)
    v_cov = (from_conic[0] + from_blur[0], from_conic[1] + from_blur[1], from_conic[2] + from_blur[2])
    v_x, v_y, v_z = gather_wide(v.means2d, rows, 0), gather_wide(v.means2d, rows, 1), gather_wide(v.depths, rows, 0)
    v_p, v_V = project_gaussian_vjp(p, V, constants, footprint, v_x, v_y, v_z, v_cov)
    R_transposed = transpose3(R)
    v_quat, v_scale = axes_vjp(quat, scale, matmul3(R_transposed, v_V))
    scatter_triple(out.means, rows, (dot(R_transposed[0], v_p), dot(R_transposed[1], v_p), dot(R_transposed[2], v_p)))
    scatter_triple(out.scales, rows, v_scale)
    scatter_triple(out.quats, rows, v_quat)
    scatter(out.quats, rows, 3, v_quat[3])
    scatter(out.opacities, rows, 0, v_opacity * footprint.compensation)
    add_pose_row(v_pose, 0, is_counted, v_p[0], v_V[0], (x, y, z), M)
    add_pose_row(v_pose, 4, is_counted, v_p[1], v_V[1], (x, y, z), M)
    add_pose_row(v_pose, 8, is_counted, v_p[2], v_V[2], (x, y, z), M)


@scalar
def _project_chunk_vjp(chunk, primitives, radii, pose, constants, v, out, v_poses):
    n_chunks, n_gaussians = v_poses.shape[0], radii.shape[0]
    first, end = n_gaussians * chunk // n_chunks, n_gaussians * (chunk + 1) // n_chunks
    clear_culled(radii, first, end, out)
    visible = np.empty(end - first + WIDTH, np.int64)
    count = list_visible(radii, first, end, visible)
    in_rows = Pose(matrix_rows(pose.R), pose.centre)  # read once
    v_poses[chunk] = ZERO
    for i in range(0, count, WIDTH):
        is_counted = iota(DOUBLE) < count - i
        _project_eight_vjp(load_rows(visible, i), is_counted, primitives, in_rows, constants, v, out, v_poses[chunk])


@kernel()
def _project_vjp(
    primitives,  # Primitives
    radii,  # [N, 2]
    pose,  # Pose
    constants,
    v,  # ProjectionGradient
    out,  # PrimitiveGradient
):
    v_poses = np.empty((N_CHUNKS, 12 * WIDTH), np.float64)
    for chunk in prange(N_CHUNKS):
        _project_chunk_vjp(chunk, primitives, radii, pose, constants, v, out, v_poses)
    return sum_parts(v_poses)


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
    dtype = means.dtype
    out = PrimitiveGradient(
        np.empty(means.shape, means.dtype),
        np.empty(quats.shape, quats.dtype),
        np.empty(scales.shape, scales.dtype),
        np.empty(opacities.shape, opacities.dtype),
        np.empty((3, 3), dtype),
        np.empty(3, dtype),
    )
    primitives, pose, constants = (
        Primitives(*contiguous(means, quats, scales, opacities)),
        pack_pose(camera),
        pack_constants(camera, conventions),
    )
    v_pose = _project_vjp(primitives, projection.radii, pose, constants, v_projection, out).reshape(3, 4)
    out.cam_from_world_R[:] = v_pose[:, :3]
    out.cam_from_world_t[:] = v_pose[:, 3]
    return out
