"""Projection of all surfels of a view, forward and backward: the loops over :mod:`.formulas`.

The functions have the names and the arguments of their counterparts in :mod:`.projection`, which states the equations.
As in :mod:`minisplat_ref.cpu.projection`, eight surfels are processed together, the arithmetic is float64 whatever the
data, and the sums of the camera's gradient have a fixed order.
"""

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
from minisplat_ref.jit.lanes import (
    WIDTH,
    broadcast,
    ceil,
    floor,
    iota,
    libm_log,
    maximum,
    minimum,
    scatter,
    select,
    sqrt,
)
from minisplat_ref.jit.literals import HALF, ONE, TWO, ZERO
from minisplat_ref.mechanisms.surfels.formulas import (
    add_triples,
    cut_disc_box,
    disc_box,
    disc_center_vjp,
    image_map,
    image_map_vjp,
    low_pass_square,
    side_of,
)
from minisplat_ref.mechanisms.surfels.projection import (
    EXTENT_MIN,
    GSPLAT_CUTOFF,
    LOW_PASS,
    RELEASED,
    SurfelGradient,
    SurfelRules,
    Surfels,
    choose_pivot,
)
from minisplat_ref.reference.pinhole import pose, with_principal_point
from minisplat_ref.scalar.extent import RADIUS_MAX
from minisplat_ref.scalar.projection import axes, axes_vjp, dot, matmul3, matrix_rows, transpose3
from minisplat_ref.types import Camera, Floats, Ints, PrimitiveGradient, Primitives


class _Frame(NamedTuple):
    """The constants of a view, float64."""

    R: Floats  # [3, 3]
    t: Floats  # [3]
    fx: float
    fy: float
    cx: float
    cy: float
    width: float
    height: float
    near: float
    far: float
    alpha_min: float
    low_pass_square: float  # e^2 of SurfelRules
    tile_size: float
    """0: the exact rule of extent, otherwise gsplat's."""
    radius_clip: float


class _Tables(NamedTuple):
    """The arrays of :class:`.projection.Surfels`."""

    transforms: Floats
    means2d: Floats
    opacities: Floats
    depths: Floats
    normals: Floats
    radii: Ints
    boxes: Ints


def _pack_frame(camera: Camera, conventions: Conventions, rules: SurfelRules, radius_clip: float) -> _Frame:
    camera = with_principal_point(camera, conventions)
    R, t = contiguous(*pose(camera, np.dtype(np.float64)))
    intrinsics = camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height
    limits = conventions.near_plane, conventions.far_plane, conventions.alpha_min
    options = rules.low_pass_cutoff**2, rules.tile_size, radius_clip
    return _Frame(R, t, *(np.float64(number) for number in (*intrinsics, *limits, *options)))


@scalar
def _see(rows, primitives, frame):
    """Return means, quaternions and scales of eight surfels, their centres and axes in the camera's frame, and T.

    The third scale is 1: the axes hold the unit normal.
    """
    R, t = matrix_rows(frame.R), frame.t
    mean, quat = triple(primitives.means, rows), quaternion(primitives.quats, rows)
    scale = gather_wide(primitives.scales, rows, 0), gather_wide(primitives.scales, rows, 1), broadcast(DOUBLE) + ONE
    M = axes(quat, scale)
    V = matmul3(R, M)
    x = dot(R[0], mean) + t[0], dot(R[1], mean) + t[1], dot(R[2], mean) + t[2]
    return mean, quat, scale, M, V, x, image_map(frame, V, x)


@scalar
def _clip(x, size):
    """Return a coordinate, or the nearest one in the image."""
    return minimum(maximum(x, ZERO), size)


@scalar
def _reach_of_alpha(T, low_pass, opacity, frame):
    """Return the radii and the first and end pixels on which alpha can be ``alpha_min``, and whether there are any."""
    square = TWO * libm_log(maximum(opacity / frame.alpha_min, ONE))
    box, around = disc_box(T, square), sqrt(square / LOW_PASS)
    h_x, h_y = sqrt(maximum(box.xx, ZERO)), sqrt(maximum(box.yy, ZERO))
    zero = broadcast(DOUBLE)
    left, top, right, bottom = zero, zero, zero + frame.width, zero + frame.height
    if frame.near > ZERO:  # a plane at z = 0 bounds no part
        left, top, right, bottom = cut_disc_box(T, square, frame.near)
    is_cut = T[2][2] - sqrt(square * (T[2][0] * T[2][0] + T[2][1] * T[2][1])) < frame.near
    x0 = floor(minimum(select(is_cut, _clip(left, frame.width), box.x - h_x), low_pass.x - around))
    y0 = floor(minimum(select(is_cut, _clip(top, frame.height), box.y - h_y), low_pass.y - around))
    x1 = ceil(maximum(select(is_cut, _clip(right, frame.width), box.x + h_x), low_pass.x + around))
    y1 = ceil(maximum(select(is_cut, _clip(bottom, frame.height), box.y + h_y), low_pass.y + around))
    return ceil(HALF * (x1 - x0)), ceil(HALF * (y1 - y0)), x0, y0, x1, y1, opacity >= frame.alpha_min


@scalar
def _reach_of_tiles(low_pass, frame):
    """Return the same by gsplat's rule: the tiles under the box of a disc of ``GSPLAT_CUTOFF``."""
    r_x = ceil(GSPLAT_CUTOFF * sqrt(maximum(low_pass.xx, EXTENT_MIN)))
    r_y = ceil(GSPLAT_CUTOFF * sqrt(maximum(low_pass.yy, EXTENT_MIN)))
    size = frame.tile_size
    is_right, is_below = low_pass.x + r_x > ZERO, low_pass.y + r_y > ZERO
    is_left, is_above = low_pass.x - r_x < frame.width, low_pass.y - r_y < frame.height
    x0, y0 = floor((low_pass.x - r_x) / size) * size, floor((low_pass.y - r_y) / size) * size
    x1, y1 = ceil((low_pass.x + r_x) / size) * size, ceil((low_pass.y + r_y) / size) * size
    is_reached = is_right & is_below & is_left & is_above & (maximum(r_x, r_y) > frame.radius_clip)
    return r_x, r_y, x0, y0, x1, y1, is_reached


@scalar
def _project_eight(rows, primitives, frame, out):
    _, _, _, _, V, x, T = _see(rows, primitives, frame)
    opacity = gather_wide(primitives.opacities, rows, 0)
    low_pass = disc_box(T, low_pass_square(T, frame.low_pass_square, frame.tile_size > ZERO))
    if frame.tile_size > ZERO:
        r_x, r_y, x0, y0, x1, y1, is_reached = _reach_of_tiles(low_pass, frame)
    else:
        r_x, r_y, x0, y0, x1, y1, is_reached = _reach_of_alpha(T, low_pass, opacity, frame)
    x0, x1, y0, y1 = _clip(x0, frame.width), _clip(x1, frame.width), _clip(y0, frame.height), _clip(y1, frame.height)
    side = side_of((V[0][2], V[1][2], V[2][2]), x)
    normal = side * V[0][2], side * V[1][2], side * V[2][2]
    finite = zero_if_finite(T[0]) + zero_if_finite(T[1]) + zero_if_finite(T[2]) + zero_if_finite(normal)
    finite = finite + zero_if_finite((low_pass.x, low_pass.y, opacity)) + zero_if_finite((r_x, r_y, low_pass.d))
    is_between = (frame.near < x[2]) & (x[2] < frame.far)
    is_drawn = is_between & is_reached & (finite >= ZERO) & (abs(low_pass.d) > ZERO) & (x0 < x1) & (y0 < y1)
    scatter_visible_triple(is_drawn, out.transforms, rows, 0, T[0])
    scatter_visible_triple(is_drawn, out.transforms, rows, 3, T[1])
    scatter_visible_triple(is_drawn, out.transforms, rows, 6, T[2])
    scatter_visible_triple(is_drawn, out.normals, rows, 0, normal)
    scatter_visible(is_drawn, out.means2d, rows, 0, low_pass.x)
    scatter_visible(is_drawn, out.means2d, rows, 1, low_pass.y)
    scatter_visible(is_drawn, out.opacities, rows, 0, opacity)
    scatter_visible(is_drawn, out.depths, rows, 0, x[2])
    scatter_visible(is_drawn, out.radii, rows, 0, minimum(r_x, RADIUS_MAX))
    scatter_visible(is_drawn, out.radii, rows, 1, minimum(r_y, RADIUS_MAX))
    scatter_visible_triple(is_drawn, out.boxes, rows, 0, (x0, y0, x1))
    scatter_visible(is_drawn, out.boxes, rows, 3, y1)


@kernel()
def _project(
    primitives,  # Primitives
    frame,  # _Frame
    out,  # _Tables
):
    n_surfels = primitives.opacities.shape[0]
    for block in prange((n_surfels + WIDTH - 1) // WIDTH):
        _project_eight(eight_rows(block * WIDTH, n_surfels), primitives, frame, out)


def project(
    primitives: Primitives,
    camera: Camera,
    conventions: Conventions,
    rules: SurfelRules = RELEASED,
    radius_clip: float = 0.0,
) -> Surfels:
    """Project surfels into the image; see :func:`.projection.project`."""
    n, frame = len(primitives.means), _pack_frame(camera, conventions, rules, radius_clip)
    floats = [np.empty((n, *shape)) for shape in ((3, 3), (2,), (), (), (3,))]
    out = _Tables._make([*floats, np.empty((n, 2), np.int32), np.empty((n, 4), np.int32)])
    _project(Primitives(*contiguous(*primitives)), frame, out)
    return Surfels(*out, rules, conventions.near_plane, choose_pivot(out.depths[out.radii[:, 0] > 0]))


@scalar
def _project_eight_vjp(rows, is_counted, primitives, frame, v, out, v_pose):
    mean, quat, scale, M, V, x, T = _see(rows, primitives, frame)
    square = low_pass_square(T, frame.low_pass_square, frame.tile_size > ZERO)
    v_c_x, v_c_y = gather_wide(v.means2d, rows, 0), gather_wide(v.means2d, rows, 1)
    of_center = disc_center_vjp(T, square, disc_box(T, square), v_c_x, v_c_y)
    v_u, v_v, v_w = matrix(v.transforms, rows)
    v_T = add_triples(v_u, of_center[0]), add_triples(v_v, of_center[1]), add_triples(v_w, of_center[2])
    v_A = image_map_vjp(frame, v_T)
    v_x = v_A[0][2], v_A[1][2], v_A[2][2] + gather_wide(v.depths, rows, 0)
    v_n, side = triple(v.normals, rows), side_of((V[0][2], V[1][2], V[2][2]), x)
    v_V = (
        (v_A[0][0], v_A[0][1], side * v_n[0]),
        (v_A[1][0], v_A[1][1], side * v_n[1]),
        (v_A[2][0], v_A[2][1], side * v_n[2]),
    )
    R_transposed = transpose3(matrix_rows(frame.R))
    v_quat, v_scale = axes_vjp(quat, scale, matmul3(R_transposed, v_V))
    scatter_triple(out.means, rows, (dot(R_transposed[0], v_x), dot(R_transposed[1], v_x), dot(R_transposed[2], v_x)))
    scatter_triple(out.scales, rows, (v_scale[0], v_scale[1], broadcast(DOUBLE)))
    scatter_triple(out.quats, rows, v_quat)
    scatter(out.quats, rows, 3, v_quat[3])
    scatter(out.opacities, rows, 0, gather_wide(v.opacities, rows, 0))
    add_pose_row(v_pose, 0, is_counted, v_x[0], v_V[0], mean, M)
    add_pose_row(v_pose, 4, is_counted, v_x[1], v_V[1], mean, M)
    add_pose_row(v_pose, 8, is_counted, v_x[2], v_V[2], mean, M)


@scalar
def _project_chunk_vjp(chunk, primitives, radii, frame, v, out, v_poses):
    n_chunks, n_surfels = v_poses.shape[0], radii.shape[0]
    first, end = n_surfels * chunk // n_chunks, n_surfels * (chunk + 1) // n_chunks
    clear_culled(radii, first, end, out)
    visible = np.empty(end - first + WIDTH, np.int64)
    count = list_visible(radii, first, end, visible)
    v_poses[chunk] = ZERO
    for i in range(0, count, WIDTH):
        is_counted = iota(DOUBLE) < count - i
        _project_eight_vjp(load_rows(visible, i), is_counted, primitives, frame, v, out, v_poses[chunk])


@kernel()
def _project_vjp(
    primitives,  # Primitives
    radii,  # [N, 2]
    frame,  # _Frame
    v,  # SurfelGradient
    out,  # PrimitiveGradient
):
    v_poses = np.empty((N_CHUNKS, 12 * WIDTH), np.float64)
    for chunk in prange(N_CHUNKS):
        _project_chunk_vjp(chunk, primitives, radii, frame, v, out, v_poses)
    return sum_parts(v_poses)


def project_vjp(
    primitives: Primitives, camera: Camera, conventions: Conventions, surfels: Surfels, v_surfels: SurfelGradient
) -> PrimitiveGradient:
    """Gradient of :func:`project`; see :func:`.projection.project_vjp`."""
    dtype, frame = primitives.means.dtype, _pack_frame(camera, conventions, surfels.rules, 0.0)
    fields = [np.empty(field.shape, field.dtype) for field in primitives]
    out = PrimitiveGradient._make([*fields, np.empty((3, 3), dtype), np.empty(3, dtype)])
    v = SurfelGradient(*(np.ascontiguousarray(field, np.float64) for field in v_surfels))
    v_pose = _project_vjp(Primitives(*contiguous(*primitives)), surfels.radii, frame, v, out).reshape(3, 4)
    out.cam_from_world_R[:] = v_pose[:, :3]
    out.cam_from_world_t[:] = v_pose[:, 3]
    return out
