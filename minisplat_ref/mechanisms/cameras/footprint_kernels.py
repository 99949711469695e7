"""Gaussians along the rays of a camera, forward and backward: the loops over :mod:`.formulas`.

The functions have the names and the arguments of their counterparts in :mod:`.ray_footprints`, which states the
equations. As in :mod:`minisplat_ref.cpu.projection`, eight Gaussians are processed together, the arithmetic is float64
whatever the data, and the sums of the camera's gradient have a fixed order.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.gaussian_rows import (
    DOUBLE,
    add_pose_row,
    clear_culled,
    contiguous,
    eight_rows,
    gather_wide,
    list_visible,
    load_rows,
    matrix,
    quaternion,
    scatter_triple,
    scatter_visible,
    scatter_visible_triple,
    sum_parts,
    triple,
    zero_if_finite,
)
from minisplat_ref.cpu.projection import N_CHUNKS
from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.jit.lanes import WIDTH, broadcast, iota, libm_log, maximum, minimum, scatter, select, sqrt
from minisplat_ref.jit.literals import ONE, TWO, ZERO
from minisplat_ref.mechanisms.cameras.formulas import Lens, depth_vjp, is_reached, lens_of, moments, pixel_vjp
from minisplat_ref.mechanisms.cameras.models import ray_table
from minisplat_ref.mechanisms.cameras.ray_footprints import (
    WHITENESS_MAX,
    FootprintGradient,
    LensFootprints,
    check_camera,
)
from minisplat_ref.mechanisms.cameras.unscented import SPREAD
from minisplat_ref.reference.pinhole import pose, with_principal_point
from minisplat_ref.scalar.extent import inria_box, support_box
from minisplat_ref.scalar.projection import axes, axes_vjp, dot, matmul3, matrix_rows, transpose3
from minisplat_ref.types import Camera, Floats, Ints, PrimitiveGradient, Primitives


class _View(NamedTuple):
    """The constants of a view, float64."""

    R: Floats  # [3, 3]
    t: Floats  # [3]
    k: Floats
    """Coefficients of the lens, and the limit at which it folds."""
    fx: float
    fy: float
    cx: float
    cy: float


class _Limits(NamedTuple):
    """The constants by which Gaussians are bounded and culled, float64."""

    cosine: float
    """Of the half angle of the cone that holds all rays."""
    sine: float
    width: float
    height: float
    near: float
    far: float
    eps2d: float
    alpha_min: float
    has_full_support: bool


class _Tables(NamedTuple):
    """The arrays of :class:`.ray_footprints.LensFootprints` that have a row for each Gaussian."""

    positions: Floats
    whitenings: Floats
    opacities: Floats
    depths: Floats
    means2d: Floats
    radii: Ints
    boxes: Ints


class _Gradient(NamedTuple):
    """A ``PrimitiveGradient`` without the camera's, and the derivatives by the means' pixels."""

    means: Floats
    quats: Floats
    scales: Floats
    opacities: Floats
    means2d: Floats


def _pack_view(camera: Camera) -> tuple[Lens, _View]:
    lens, k = lens_of(camera.optics)
    intrinsics = (np.float64(number) for number in (camera.fx, camera.fy, camera.cx, camera.cy))
    return lens, _View._make([*contiguous(*pose(camera, np.dtype(np.float64))), k, *intrinsics])


def _pack_limits(camera: Camera, rays: Floats, conventions: Conventions) -> _Limits:
    cosine = np.clip(rays[2::3].min(), -1, 1)
    planes = conventions.near_plane, conventions.far_plane, conventions.eps2d, conventions.alpha_min
    numbers = cosine, np.sqrt(1 - cosine * cosine), camera.width, camera.height, *planes
    return _Limits._make([*map(np.float64, numbers), conventions.has_full_support])


@scalar
def _along(x, axis, length):
    return x[0] + length * axis[0], x[1] + length * axis[1], x[2] + length * axis[2]


@scalar
def _divide(row, scale):
    return row[0] / scale, row[1] / scale, row[2] / scale


@scalar
def _turn(quats, rows, R):
    """Return the rotations of eight Gaussians, in the world and in the camera's frame."""
    one = broadcast(DOUBLE) + ONE
    R_g = axes(quaternion(quats, rows), (one, one, one))
    return R_g, matmul3(R, R_g)


@functools.cache
def _project_kernel(lens: Lens) -> Callable:
    """Compile the projection through a lens."""
    bend, has_distances = lens.bend, lens.has_distances

    @scalar
    def see(x, W, scale, view, eps2d, scratch):
        """Return the moments in the image, the mean's place, and whether it and all sigma points are seen."""
        centre, is_seen = bend(x, view.k, scratch)
        s_0, s_1, s_2 = SPREAD * scale[0], SPREAD * scale[1], SPREAD * scale[2]
        a, sees_a = bend(_along(x, W[0], s_0), view.k, scratch)
        b, sees_b = bend(_along(x, W[1], s_1), view.k, scratch)
        c, sees_c = bend(_along(x, W[2], s_2), view.k, scratch)
        d, sees_d = bend(_along(x, W[0], -s_0), view.k, scratch)
        e, sees_e = bend(_along(x, W[1], -s_1), view.k, scratch)
        f, sees_f = bend(_along(x, W[2], -s_2), view.k, scratch)
        is_whole = is_seen & sees_a & sees_b & sees_c & sees_d & sees_e & sees_f
        return moments(centre, (a, b, c, d, e, f), view, eps2d), centre, is_seen, is_whole

    @scalar
    def project_eight(rows, primitives, view, limits, scratch, out):
        mean, scale, R = triple(primitives.means, rows), triple(primitives.scales, rows), matrix_rows(view.R)
        opacity, t = gather_wide(primitives.opacities, rows, 0), view.t
        x = dot(R[0], mean) + t[0], dot(R[1], mean) + t[1], dot(R[2], mean) + t[2]
        _, V = _turn(primitives.quats, rows, R)
        W, width, height = transpose3(V), limits.width, limits.height
        footprint, centre, is_seen, is_whole = see(x, W, scale, view, limits.eps2d, scratch)
        if limits.has_full_support:
            r_x, r_y, x0, y0, x1, y1 = support_box(footprint, opacity, limits.alpha_min, width, height)
        else:
            r_x, r_y, x0, y0, x1, y1 = inria_box(footprint, width, height)
        r_x, r_y = select(is_whole, r_x, width), select(is_whole, r_y, height)
        x0, y0 = select(is_whole, x0, ZERO), select(is_whole, y0, ZERO)
        x1, y1 = select(is_whole, x1, width), select(is_whole, y1, height)
        distance, depth = sqrt(dot(x, x)), x[2]
        if has_distances:
            depth = distance
        thinnest, thickest = minimum(minimum(*scale[:2]), scale[2]), maximum(maximum(*scale[:2]), scale[2])
        reach = thickest * sqrt(TWO * libm_log(maximum(opacity / limits.alpha_min, ONE)))
        is_drawn = (limits.near < depth) & (depth < limits.far) & (opacity >= limits.alpha_min) & is_seen
        is_drawn = is_drawn & (distance < WHITENESS_MAX * thinnest)
        is_drawn = is_drawn & is_reached(x, distance, reach, limits.cosine, limits.sine)
        M_0, M_1, M_2 = _divide(W[0], scale[0]), _divide(W[1], scale[1]), _divide(W[2], scale[2])
        finite = zero_if_finite(x) + zero_if_finite(M_0) + zero_if_finite(M_1) + zero_if_finite(M_2)
        is_drawn = is_drawn & (finite >= ZERO) & (r_x > ZERO) & (r_y > ZERO) & (x0 < x1) & (y0 < y1)
        scatter_visible_triple(is_drawn, out.positions, rows, 0, x)
        scatter_visible_triple(is_drawn, out.whitenings, rows, 0, M_0)
        scatter_visible_triple(is_drawn, out.whitenings, rows, 3, M_1)
        scatter_visible_triple(is_drawn, out.whitenings, rows, 6, M_2)
        scatter_visible(is_drawn, out.opacities, rows, 0, opacity)
        scatter_visible(is_drawn, out.depths, rows, 0, depth)
        scatter_visible(is_drawn, out.means2d, rows, 0, centre[0] * view.fx + view.cx)
        scatter_visible(is_drawn, out.means2d, rows, 1, centre[1] * view.fy + view.cy)
        scatter_visible(is_drawn, out.radii, rows, 0, r_x)
        scatter_visible(is_drawn, out.radii, rows, 1, r_y)
        scatter_visible_triple(is_drawn, out.boxes, rows, 0, (x0, y0, x1))
        scatter_visible(is_drawn, out.boxes, rows, 3, y1)

    @kernel()
    def project_all(
        primitives,  # Primitives
        view,  # _View
        limits,  # _Limits
        out,  # _Tables
    ):
        n_gaussians = primitives.opacities.shape[0]
        for chunk in prange(N_CHUNKS):
            scratch = np.empty(2 * WIDTH, np.float64)
            first, end = n_gaussians * chunk // N_CHUNKS, n_gaussians * (chunk + 1) // N_CHUNKS
            for n in range(first, end, WIDTH):
                project_eight(eight_rows(n, end), primitives, view, limits, scratch, out)

    return project_all


def project(primitives: Primitives, camera: Camera, conventions: Conventions) -> LensFootprints:
    """Place Gaussians in the camera's frame; see :func:`.ray_footprints.project`."""
    check_camera(camera, conventions)
    camera = with_principal_point(camera, conventions)
    rays, n = ray_table(camera), len(primitives.means)
    lens, view = _pack_view(camera)
    floats = [np.empty((n, *shape)) for shape in ((3,), (3, 3), (), (), (2,))]
    out = _Tables._make([*floats, np.empty((n, 2), np.int32), np.empty((n, 4), np.int32)])
    _project_kernel(lens)(Primitives(*contiguous(*primitives)), view, _pack_limits(camera, rays, conventions), out)
    return LensFootprints(*out, rays, camera)


@functools.cache
def _project_vjp_kernel(lens: Lens) -> Callable:
    """Compile the gradient of the projection through a lens."""
    jacobian, has_distances = lens.jacobian, lens.has_distances

    @scalar
    def project_eight_vjp(eight, primitives, positions, view, v, out, v_pose, scratch):
        """Write the gradient of eight Gaussians, given as their rows and which of them are no copies."""
        rows, is_counted = eight
        mean, scale, R = triple(primitives.means, rows), triple(primitives.scales, rows), matrix_rows(view.R)
        R_g, V = _turn(primitives.quats, rows, R)
        x, v_response = triple(positions, rows), triple(v.positions, rows)
        of_depth = depth_vjp(x, gather_wide(v.depths, rows, 0), has_distances)
        v_x = v_response[0] + of_depth[0], v_response[1] + of_depth[1], v_response[2] + of_depth[2]
        v_M, W = matrix(v.whitenings, rows), transpose3(V)
        v_W = _divide(v_M[0], scale[0]), _divide(v_M[1], scale[1]), _divide(v_M[2], scale[2])
        v_scale = -dot(v_W[0], W[0]) / scale[0], -dot(v_W[1], W[1]) / scale[1], -dot(v_W[2], W[2]) / scale[2]
        v_V = transpose3(v_W)
        R_transposed, one = transpose3(R), broadcast(DOUBLE) + ONE
        v_quat, _ = axes_vjp(quaternion(primitives.quats, rows), (one, one, one), matmul3(R_transposed, v_V))
        v_mean = dot(R_transposed[0], v_x), dot(R_transposed[1], v_x), dot(R_transposed[2], v_x)
        v_pixel = pixel_vjp(jacobian(x, view.k, scratch), view.fx, view.fy, v_response)
        scatter_triple(out.means, rows, v_mean)
        scatter_triple(out.scales, rows, v_scale)
        scatter_triple(out.quats, rows, v_quat)
        scatter(out.quats, rows, 3, v_quat[3])
        scatter(out.opacities, rows, 0, gather_wide(v.opacities, rows, 0))
        scatter(out.means2d, rows, 0, v_pixel[0])
        scatter(out.means2d, rows, 1, v_pixel[1])
        add_pose_row(v_pose, 0, is_counted, v_x[0], v_V[0], mean, R_g)
        add_pose_row(v_pose, 4, is_counted, v_x[1], v_V[1], mean, R_g)
        add_pose_row(v_pose, 8, is_counted, v_x[2], v_V[2], mean, R_g)

    @scalar
    def project_chunk_vjp(chunk, primitives, footprints, view, v, out, v_poses):
        n_chunks, n_gaussians = v_poses.shape[0], footprints.radii.shape[0]
        first, end = n_gaussians * chunk // n_chunks, n_gaussians * (chunk + 1) // n_chunks
        clear_culled(footprints.radii, first, end, out)
        out.means2d[first:end] = ZERO
        visible, scratch = np.empty(end - first + WIDTH, np.int64), np.empty(2 * WIDTH, np.float64)
        count = list_visible(footprints.radii, first, end, visible)
        v_poses[chunk] = ZERO
        for i in range(0, count, WIDTH):
            eight = load_rows(visible, i), iota(DOUBLE) < count - i
            project_eight_vjp(eight, primitives, footprints.positions, view, v, out, v_poses[chunk], scratch)

    @kernel()
    def project_all_vjp(
        primitives,  # Primitives
        footprints,  # _Tables
        view,  # _View
        v,  # FootprintGradient
        out,  # _Gradient
    ):
        v_poses = np.empty((N_CHUNKS, 12 * WIDTH), np.float64)
        for chunk in prange(N_CHUNKS):
            project_chunk_vjp(chunk, primitives, footprints, view, v, out, v_poses)
        return sum_parts(v_poses)

    return project_all_vjp


def project_vjp(
    primitives: Primitives, footprints: LensFootprints, v_footprints: FootprintGradient
) -> tuple[PrimitiveGradient, Floats]:
    """Gradient of :func:`project`; see :func:`.ray_footprints.project_vjp`."""
    dtype, rows = primitives.means.dtype, len(footprints.radii)
    lens, view = _pack_view(footprints.camera)
    out = _Gradient._make([*(np.empty(field.shape, field.dtype) for field in primitives), np.empty((rows, 2), dtype)])
    v = FootprintGradient(*(np.ascontiguousarray(field, np.float64) for field in v_footprints))
    tables = _Tables._make(getattr(footprints, name) for name in _Tables._fields)
    v_pose = _project_vjp_kernel(lens)(Primitives(*contiguous(*primitives)), tables, view, v, out).reshape(3, 4)
    v_R, v_t = v_pose[:, :3].astype(dtype), v_pose[:, 3].astype(dtype)
    return PrimitiveGradient(out.means, out.quats, out.scales, out.opacities, v_R, v_t), out.means2d
