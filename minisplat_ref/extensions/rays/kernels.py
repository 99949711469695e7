"""One ray and one 3D Gaussian as kernels read them: the formulas of :mod:`.model`.

The loops are those of ``mechanisms.rays.tile_kernels`` for the rays of an image, and of ``mechanisms.rays.traversal``
and ``mechanisms.rays.kernels`` for any others.
"""

import numpy as np

from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import select
from minisplat_ref.mechanisms.rays.tile_kernels import RayResponse
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
