"""Projection of all Gaussians of a view, forward and backward: the loops over ``scalar/projection.py``.

The body of a parallel loop is a function of its own: Numba 0.68 loses writes to a NamedTuple's arrays that stand
directly under ``prange``. Every Gaussian has one writer. Only the camera gradient is a sum over Gaussians: a fixed
number of chunks, whatever the number of threads, each adds up its own part in float64, and the parts are added in
order.

The arithmetic is float64 whatever the data: it is scalar code, where a float64 costs what a float32 costs, and float32
would lose the position of a mean far from the world's origin, the overflow of f / z squared, and the thin axis of a
needle. Results are rounded when they are stored, except conics: see :class:`Projection`.
"""

import math

import numpy as np

from minisplat_ref.constants import COMPENSATION_FLOOR, JACOBIAN_CLAMP, Conventions
from minisplat_ref.scalar._jit import kernel, prange, scalar
from minisplat_ref.scalar.extent import inria_box, support_box
from minisplat_ref.scalar.projection import (
    Lens,
    axes,
    axes_vjp,
    compensation_vjp,
    conic,
    conic_vjp,
    dot,
    project_gaussian,
    project_gaussian_vjp,
    rotated,
    rows_of,
    to_camera,
    transposed,
)
from minisplat_ref.types import Camera, Floats, PrimitiveGradient, Projection, ProjectionGradient

N_CHUNKS = 64  # parts of the camera-gradient sum; fixed, so that its rounding does not depend on the thread count


def camera_centre(camera: Camera) -> Floats:
    """Camera centre -R^T t [3], float64."""
    return -np.asarray(camera.cam_from_world_R, np.float64).T @ np.asarray(camera.cam_from_world_t, np.float64)


def pose_of(camera: Camera) -> tuple[Floats, Floats]:
    """Return R [3, 3] and the point [3] that R x + t takes to the origin, float64.

    The point is the camera centre. It is solved for rather than taken as -R^T t, so that R (x - point) equals R x + t
    also where R is not quite a rotation: the gradient counts its nine entries as free.
    """
    R = np.asarray(camera.cam_from_world_R, np.float64)
    return R, -np.linalg.solve(R, np.asarray(camera.cam_from_world_t, np.float64))


def lens_of(camera: Camera, conventions: Conventions) -> Lens:
    """Camera intrinsics and conventions as float64 scalars."""
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
    return Lens._make([*scalars, conventions.is_antialiased])


@scalar
def wide(quat):
    """Return the four numbers in float64."""
    return np.float64(quat[0]), np.float64(quat[1]), np.float64(quat[2]), np.float64(quat[3])


@scalar
def _project_one(
    n, means, quats, scales, opacities, rotation, centre, lens, alpha_min, full_support, width, height, out
):
    R = rows_of(rotation)
    p = to_camera(R, centre, means[n, 0], means[n, 1], means[n, 2])
    if not (lens.near < p[2] < lens.far):
        return
    footprint = project_gaussian(p, rotated(R, axes(wide(quats[n]), scales[n])), lens)
    opacity = opacities[n] * footprint.compensation
    if not (opacity >= alpha_min and footprint.det > 0 and math.isfinite(footprint.det)):
        return
    a, b, c = conic(footprint)
    if not (math.isfinite(a) and math.isfinite(c)):
        return
    if not (math.isfinite(footprint.x) and math.isfinite(footprint.y)):
        return
    if full_support:
        rx, ry, x0, y0, x1, y1 = support_box(footprint, opacity, alpha_min, width, height)
    else:
        rx, ry, x0, y0, x1, y1 = inria_box(footprint, width, height)
    if x0 >= x1 or y0 >= y1:
        return
    out.means2d[n, 0] = footprint.x
    out.means2d[n, 1] = footprint.y
    out.depths[n] = p[2]
    out.conics[n, 0], out.conics[n, 1], out.conics[n, 2] = a, b, c
    out.opacities[n] = opacity
    out.radii[n, 0] = rx
    out.radii[n, 1] = ry
    out.boxes[n, 0] = x0
    out.boxes[n, 1] = y0
    out.boxes[n, 2] = x1
    out.boxes[n, 3] = y1


@kernel()
def _project(means, quats, scales, opacities, rotation, centre, lens, alpha_min, full_support, width, height, out):
    for n in prange(means.shape[0]):
        _project_one(
            n, means, quats, scales, opacities, rotation, centre, lens, alpha_min, full_support, width, height, out
        )


def project(
    means: Floats, quats: Floats, scales: Floats, opacities: Floats, camera: Camera, conventions: Conventions
) -> Projection:
    """Project every Gaussian into the image; see ``reference.projection.project``."""
    n, dtype = len(means), means.dtype
    out = Projection(
        np.zeros((n, 2), dtype),
        np.zeros(n, dtype),
        np.zeros((n, 3), np.float64),
        np.zeros(n, dtype),
        np.zeros((n, 2), np.int32),
        np.zeros((n, 4), np.int32),
    )
    rotation, centre = pose_of(camera)
    lens, alpha_min = lens_of(camera, conventions), dtype.type(conventions.alpha_min)
    full_support, width, height = conventions.has_full_support, camera.width, camera.height
    _project(means, quats, scales, opacities, rotation, centre, lens, alpha_min, full_support, width, height, out)
    return out


@scalar
def _project_one_vjp(n, means, quats, scales, opacities, R, centre, lens, v, out, v_pose):
    p = to_camera(R, centre, means[n, 0], means[n, 1], means[n, 2])
    quat = wide(quats[n])
    M = axes(quat, scales[n])
    V = rotated(R, M)
    footprint = project_gaussian(p, V, lens)
    from_conic = conic_vjp(footprint, v.conics[n])
    from_blur = compensation_vjp(footprint, v.opacities[n] * opacities[n], lens)
    v_cov = (from_conic[0] + from_blur[0], from_conic[1] + from_blur[1], from_conic[2] + from_blur[2])
    v_p, v_V = project_gaussian_vjp(p, V, lens, footprint, v.means2d[n, 0], v.means2d[n, 1], v.depths[n], v_cov)
    R_transposed = transposed(R)
    v_quat, v_scale = axes_vjp(quat, scales[n], rotated(R_transposed, v_V))
    for i in range(3):
        out.means[n, i] = dot(R_transposed[i], v_p)
        out.scales[n, i] = v_scale[i]
        v_pose[9 + i] += v_p[i]
        for j in range(3):  # p = R x + t and V = R M
            v_pose[3 * i + j] += v_p[i] * means[n, j] + dot(v_V[i], M[j])
    for i in range(4):
        out.quats[n, i] = v_quat[i]
    out.opacities[n] = v.opacities[n] * footprint.compensation


@kernel()
def _project_vjp(means, quats, scales, opacities, radii, rotation, centre, lens, v, out, v_poses):
    n_chunks = v_poses.shape[0]
    n_gaussians = means.shape[0]
    for chunk in prange(n_chunks):
        R = rows_of(rotation)
        for n in range(n_gaussians * chunk // n_chunks, n_gaussians * (chunk + 1) // n_chunks):
            if radii[n, 0] > 0:
                _project_one_vjp(n, means, quats, scales, opacities, R, centre, lens, v, out, v_poses[chunk])


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
    v_poses = np.zeros((N_CHUNKS, 12), np.float64)
    out = PrimitiveGradient(
        np.zeros(means.shape, means.dtype),
        np.zeros(quats.shape, quats.dtype),
        np.zeros(scales.shape, scales.dtype),
        np.zeros(opacities.shape, opacities.dtype),
        np.zeros((3, 3), dtype),
        np.zeros(3, dtype),
    )
    rotation, centre = pose_of(camera)
    lens = lens_of(camera, conventions)
    _project_vjp(means, quats, scales, opacities, projection.radii, rotation, centre, lens, v_projection, out, v_poses)
    total = v_poses.sum(axis=0)
    out.cam_from_world_R[:] = total[:9].reshape(3, 3)
    out.cam_from_world_t[:] = total[9:]
    return out
