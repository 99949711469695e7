"""One ray and one 3D Gaussian as kernels read them, and the maps of all Gaussians: the formulas of :mod:`.model`.

The loops are those of ``mechanisms.rays.tile_kernels`` for the rays of an image, and of ``mechanisms.rays.traversal``
and ``mechanisms.rays.kernels`` for any others.
"""

import numpy as np

from minisplat_ref.cpu.gaussian_rows import contiguous, eight_rows, matrix, quaternion, triple
from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.jit.lanes import WIDTH, libm_exp, scatter, select
from minisplat_ref.mechanisms.rays.tile_kernels import RayResponse
from minisplat_ref.scalar.covariance import normalize, normalize_vjp, rotation, rotation_vjp
from minisplat_ref.types import Floats

REACH, MEAN, MAP = 1, 2, 5  # columns of a record beside the opacity
N_COLUMNS = 14


@scalar
def whiten_ray(records, row, ray):
    """Return ``p = M (mu - O)`` and ``v = M d`` of one ray or of eight."""
    ox, oy, oz, dx, dy, dz = ray
    ux, uy, uz = records[row, MEAN] - ox, records[row, MEAN + 1] - oy, records[row, MEAN + 2] - oz
    p0 = records[row, MAP] * ux + records[row, MAP + 1] * uy + records[row, MAP + 2] * uz
    p1 = records[row, MAP + 3] * ux + records[row, MAP + 4] * uy + records[row, MAP + 5] * uz
    p2 = records[row, MAP + 6] * ux + records[row, MAP + 7] * uy + records[row, MAP + 8] * uz
    v0 = records[row, MAP] * dx + records[row, MAP + 1] * dy + records[row, MAP + 2] * dz
    v1 = records[row, MAP + 3] * dx + records[row, MAP + 4] * dy + records[row, MAP + 5] * dz
    v2 = records[row, MAP + 6] * dx + records[row, MAP + 7] * dy + records[row, MAP + 8] * dz
    return p0, p1, p2, v0, v1, v2


@scalar
def nearest_point(p0, p1, p2, v0, v1, v2):
    """Return t and ``e = p - t v``."""
    t = (v0 * p0 + v1 * p1 + v2 * p2) / (v0 * v0 + v1 * v1 + v2 * v2)
    return t, p0 - t * v0, p1 - t * v1, p2 - t * v2


@scalar
def meet(records, row, ray):
    """Return t and q of eight rays; q is infinite where alpha is below its minimum, and where it is not a number."""
    t, e0, e1, e2 = nearest_point(*whiten_ray(records, row, ray))
    q = e0 * e0 + e1 * e1 + e2 * e2
    return t, select(q <= records[row, REACH], q, np.inf)


@scalar
def back(records, row, v):
    """Return ``M^T v``."""
    return (
        records[row, MAP] * v[0] + records[row, MAP + 3] * v[1] + records[row, MAP + 6] * v[2],
        records[row, MAP + 1] * v[0] + records[row, MAP + 4] * v[1] + records[row, MAP + 7] * v[2],
        records[row, MAP + 2] * v[0] + records[row, MAP + 5] * v[1] + records[row, MAP + 8] * v[2],
    )


@scalar
def meet_vjp(records, row, ray, unclamped, v_unclamped, v_t):
    """Return the gradient with respect to mean, direction and map [9]; see the reference's ``meet_vjp``."""
    p0, p1, p2, v0, v1, v2 = whiten_ray(records, row, ray)
    t, e0, e1, e2 = nearest_point(p0, p1, p2, v0, v1, v2)
    k = -unclamped * v_unclamped  # 2 v_q
    j = v_t / (v0 * v0 + v1 * v1 + v2 * v2)
    of_p = k * e0 + j * v0, k * e1 + j * v1, k * e2 + j * v2
    of_v = (
        j * (p0 - 2.0 * t * v0) - t * k * e0,
        j * (p1 - 2.0 * t * v1) - t * k * e1,
        j * (p2 - 2.0 * t * v2) - t * k * e2,
    )
    x, y, z = records[row, MEAN] - ray[0], records[row, MEAN + 1] - ray[1], records[row, MEAN + 2] - ray[2]
    of_map = (
        of_p[0] * x + of_v[0] * ray[3],
        of_p[0] * y + of_v[0] * ray[4],
        of_p[0] * z + of_v[0] * ray[5],
        of_p[1] * x + of_v[1] * ray[3],
        of_p[1] * y + of_v[1] * ray[4],
        of_p[1] * z + of_v[1] * ray[5],
        of_p[2] * x + of_v[2] * ray[3],
        of_p[2] * y + of_v[2] * ray[4],
        of_p[2] * z + of_v[2] * ray[5],
    )
    return back(records, row, of_p), back(records, row, of_v), of_map


def _as_maps(v: Floats) -> Floats:
    """Return the gradient of maps as [N, 3, 3]."""
    return v.reshape(-1, 3, 3)


RESPONSE = RayResponse(meet, meet_vjp, 9, _as_maps)
"""A 3D Gaussian where its density on the ray is greatest."""


# --- maps of all Gaussians ---


def whitening_maps(quats: Floats, log_scales: Floats) -> Floats:
    """Return the maps [N, 3, 3] of quaternions [N, 4] and logarithms of scales [N, 3]: see :func:`.model.whiten`."""
    maps = np.empty((len(quats), 3, 3))
    _map_all(*contiguous(quats, log_scales), maps)
    return maps


def whitening_maps_vjp(quats: Floats, log_scales: Floats, maps: Floats, v_maps: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`whitening_maps`: see :func:`.model.whiten_vjp`."""
    v_quats, v_log_scales = np.empty((len(quats), 4)), np.empty((len(quats), 3))
    _map_all_vjp(*contiguous(quats, log_scales, maps, v_maps), (v_quats, v_log_scales))
    return v_quats, v_log_scales


@scalar
def size(v):
    """Return the sum of the magnitudes of three numbers."""
    return abs(v[0]) + abs(v[1]) + abs(v[2])


@scalar
def map_row_vjp(is_met, M_i, v_M_i, log_s):
    """Return ``v_log_s_i = -M_i . v_M_i`` and column i of v_R, ``v_M_i / s_i``; zeros where no ray meets a Gaussian."""
    inverse = libm_exp(-log_s)
    along = M_i[0] * v_M_i[0] + M_i[1] * v_M_i[1] + M_i[2] * v_M_i[2]
    of_R = (
        select(is_met, inverse * v_M_i[0], 0.0),
        select(is_met, inverse * v_M_i[1], 0.0),
        select(is_met, inverse * v_M_i[2], 0.0),
    )
    return select(is_met, -along, 0.0), of_R


@kernel()
def _map_all(quats, log_scales, maps):
    n = len(quats)
    for part in prange((n + WIDTH - 1) // WIDTH):
        rows = eight_rows(part * WIDTH, n)
        w, x, y, z, _ = normalize(*quaternion(quats, rows))
        R, s = rotation(w, x, y, z), triple(log_scales, rows)
        for i in range(3):
            inverse = libm_exp(-s[i])
            for j in range(3):
                scatter(maps, rows, 3 * i + j, inverse * R[j][i])


@kernel()
def _map_all_vjp(quats, log_scales, maps, v_maps, v):
    n = len(quats)
    for part in prange((n + WIDTH - 1) // WIDTH):
        v_quats, v_log_scales = v
        rows = eight_rows(part * WIDTH, n)
        w, x, y, z, inverse_length = normalize(*quaternion(quats, rows))
        M, v_M, s = matrix(maps, rows), matrix(v_maps, rows), triple(log_scales, rows)
        is_met = size(v_M[0]) + size(v_M[1]) + size(v_M[2]) > 0.0
        v_s_0, of_0 = map_row_vjp(is_met, M[0], v_M[0], s[0])
        v_s_1, of_1 = map_row_vjp(is_met, M[1], v_M[1], s[1])
        v_s_2, of_2 = map_row_vjp(is_met, M[2], v_M[2], s[2])
        v_R = (of_0[0], of_1[0], of_2[0]), (of_0[1], of_1[1], of_2[1]), (of_0[2], of_1[2], of_2[2])
        v_unit = rotation_vjp(w, x, y, z, v_R)
        v_q = normalize_vjp((w, x, y, z), inverse_length, v_unit)
        for k in range(4):
            scatter(v_quats, rows, k, v_q[k])
        scatter(v_log_scales, rows, 0, v_s_0)
        scatter(v_log_scales, rows, 1, v_s_1)
        scatter(v_log_scales, rows, 2, v_s_2)
