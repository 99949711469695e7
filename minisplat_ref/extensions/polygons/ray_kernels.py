"""One ray and one polygon as kernels read them: the formulas of :mod:`.model`.

A polygon is tested as a whole: one plane, and the half-planes of its n edges, whose normals follow from each other by a
rotation of ``2 pi / n``. Its triangles, eight times as many rows for an octagon, are needed once a mesh was edited
(:mod:`.kernels`), when no plane is left.
"""

import numpy as np

from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import maximum, select
from minisplat_ref.mechanisms.rays.tile_kernels import RayResponse
from minisplat_ref.mechanisms.rays.traversal import OPACITY
from minisplat_ref.scalar.projection import cross, dot
from minisplat_ref.types import Floats

N_SIDES, INNER = 1, 2  # columns of a record beside the opacity: n, and r cos(pi / n), from the centre to an edge
FIRST, TURN = 3, 5  # cosine and sine of pi / n, of the first edge's normal, and of 2 pi / n
CENTRE, SPAN_A, SPAN_B, U, V, NORMAL = 7, 10, 13, 16, 19, 22  # U = S_a / |S_a|^2, V = S_b / |S_b|^2, n = S_a x S_b
N_COLUMNS = 25


def make_records(means: Floats, spans: Floats, radii: Floats, opacities: Floats, n_sides: int) -> Floats:
    """Return the records [N, N_COLUMNS] of polygons of one number of sides, not finite without spans [N, 3, 2]."""
    S_a, S_b, n = spans[:, :, 0], spans[:, :, 1], n_sides
    records = np.empty((len(means), N_COLUMNS))
    records[:, OPACITY] = opacities
    records[:, N_SIDES] = n
    records[:, INNER] = radii * np.cos(np.pi / n)
    records[:, FIRST:CENTRE] = [np.cos(np.pi / n), np.sin(np.pi / n), np.cos(2 * np.pi / n), np.sin(2 * np.pi / n)]
    records[:, CENTRE:SPAN_A] = means
    records[:, SPAN_A:SPAN_B] = S_a
    records[:, SPAN_B:U] = S_b
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        squares = np.sum(spans**2, axis=1)  # [N, 2]
        records[:, U:V] = S_a / squares[:, :1]
        records[:, V:NORMAL] = S_b / squares[:, 1:]
        records[:, NORMAL:] = np.cross(S_a, S_b)
    return records


@scalar
def vector(records, row, column):
    """Return three columns of a record."""
    return records[row, column], records[row, column + 1], records[row, column + 2]


@scalar
def intersect(records, row, ray):
    """Return t, x from the centre to the hit, u and v of one ray or of eight."""
    o, d, n = (ray[0], ray[1], ray[2]), (ray[3], ray[4], ray[5]), vector(records, row, NORMAL)
    m = records[row, CENTRE] - o[0], records[row, CENTRE + 1] - o[1], records[row, CENTRE + 2] - o[2]
    t = dot(m, n) / dot(d, n)
    x = t * d[0] - m[0], t * d[1] - m[1], t * d[2] - m[2]
    return t, x, dot(x, vector(records, row, U)), dot(x, vector(records, row, V))


@scalar
def meet(records, row, ray):
    """Return t and ``q = u^2 + v^2`` of eight rays; q is infinite beyond an edge."""
    t, _, u, v = intersect(records, row, ray)
    cosine, sine = records[row, FIRST], records[row, FIRST + 1]
    outermost = u * cosine + v * sine
    for _ in range(int(records[row, N_SIDES]) - 1):
        cosine, sine = (
            cosine * records[row, TURN] - sine * records[row, TURN + 1],
            sine * records[row, TURN] + cosine * records[row, TURN + 1],
        )
        outermost = maximum(outermost, u * cosine + v * sine)
    return t, select(outermost <= records[row, INNER], u * u + v * v, np.inf)


@scalar
def meet_vjp(records, row, ray, unclamped, v_unclamped, v_t):
    """Return the gradient with respect to the centre, the direction and both spans [6]; see the reference's chain."""
    t, x, u, v = intersect(records, row, ray)
    d, n = (ray[3], ray[4], ray[5]), vector(records, row, NORMAL)
    S_a, S_b, U_a, V_b = (
        vector(records, row, SPAN_A),
        vector(records, row, SPAN_B),
        vector(records, row, U),
        vector(records, row, V),
    )
    v_u, v_v = -unclamped * u * v_unclamped, -unclamped * v * v_unclamped
    v_x = v_u * U_a[0] + v_v * V_b[0], v_u * U_a[1] + v_v * V_b[1], v_u * U_a[2] + v_v * V_b[2]
    w = (v_t + dot(v_x, d)) / dot(n, d)
    v_m = w * n[0] - v_x[0], w * n[1] - v_x[1], w * n[2] - v_x[2]
    v_n = -w * x[0], -w * x[1], -w * x[2]
    p, q = v_u / dot(S_a, S_a), v_v / dot(S_b, S_b)
    of_a, of_b = cross(S_b, v_n), cross(v_n, S_a)
    v_spans = (
        p * (x[0] - 2.0 * u * S_a[0]) + of_a[0],
        p * (x[1] - 2.0 * u * S_a[1]) + of_a[1],
        p * (x[2] - 2.0 * u * S_a[2]) + of_a[2],
        q * (x[0] - 2.0 * v * S_b[0]) + of_b[0],
        q * (x[1] - 2.0 * v * S_b[1]) + of_b[1],
        q * (x[2] - 2.0 * v * S_b[2]) + of_b[2],
    )
    return v_m, (-t * v_m[0], -t * v_m[1], -t * v_m[2]), v_spans


def _as_spans(v: Floats) -> Floats:
    """Return the gradient of spans as [N, 3, 2]."""
    return np.swapaxes(v.reshape(-1, 2, 3), 1, 2)


POLYGON = RayResponse(meet, meet_vjp, 6, _as_spans)
"""A flat Gaussian in its polygon."""
