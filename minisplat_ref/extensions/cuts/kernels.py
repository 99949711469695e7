"""Gaussians with cuts on lanes: a response for the plain kernels.

A record holds the polygons' vertices and the inverse squared length of each piece, so that a pixel takes one loop over
the edges, which counts crossings by the sign of a product and keeps the nearest point with its piece.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from minisplat_ref.cpu.compositing.exponential import exp_fast, exp_wide
from minisplat_ref.cpu.compositing.responses import CONIC_GRADIENTS, MEAN_X, OPACITY, KernelResponse, conic_response
from minisplat_ref.extensions.cuts.response import LENGTH_MIN, N_EDGES, N_POINTS, CutFootprints, vertices_of
from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.jit.lanes import broadcast, maximum, minimum, reduce_any, select, sqrt
from minisplat_ref.jit.literals import HALF, ONE, THREE, ZERO
from minisplat_ref.mechanisms.payload.footprints import boxes_of
from minisplat_ref.types import Floats

POINTS = CONIC_GRADIENTS  # gradients of the control points; the kernels do not read these columns
N_VERTICES = 2 * (N_EDGES + 1)  # columns of a curve
N_INVERSES = N_EDGES + 2
_N_EDGES, _EDGE = np.float32(N_EDGES), np.float32(1 / N_EDGES)  # exact
_FAR = np.float32(1e30)  # px^2


class Columns(NamedTuple):
    """The columns of a record with M curves, after those of the conic and of the control points' gradients."""

    shift: int
    """Gradient of the mask with respect to the centre's pixel, x and y; these are the last gradients."""
    depth: int
    width: int
    """px."""
    inverse_width: int
    alpha_min: int
    """Below which nothing is seen."""
    vertices: int
    """Of the curves one after the other, x and y."""
    inverses: int
    """Inverse squared lengths of the edges, then of the two rays, curve by curve."""
    n: int

    @property
    def n_gradients(self) -> int:
        """Columns at the start that are gradients."""
        return self.depth


def columns_of(n_curves: int) -> Columns:
    """Return the columns for a number of curves."""
    shift = POINTS + 2 * N_POINTS * n_curves
    vertices = shift + 6
    inverses = vertices + N_VERTICES * n_curves
    return Columns(
        shift, shift + 2, shift + 3, shift + 4, shift + 5, vertices, inverses, inverses + N_INVERSES * n_curves
    )


@functools.cache
def make_cut_response(exp: Callable, n_curves: int) -> KernelResponse:
    """Return the response for an exponential of :mod:`minisplat_ref.cpu.compositing.exponential`, and M curves."""
    conic, columns = conic_response(exp), columns_of(n_curves)
    flat_hit, flat_hit_vjp = conic.hit, conic.hit_vjp
    depth_at, width_at, inverse_width_at = columns.depth, columns.width, columns.inverse_width
    alpha_min_at = columns.alpha_min
    vertices_at, inverses_at = columns.vertices, columns.inverses
    of_points = _points_gradient(n_curves)

    @scalar
    def nearer(nearest, away, f, piece):
        """Return the nearer of two points: d - q with its square, f, and the piece that it is on."""
        x, y, square, f_of, of = nearest
        new = away[0] * away[0] + away[1] * away[1]
        is_nearer = new < square
        return (
            select(is_nearer, away[0], x),
            select(is_nearer, away[1], y),
            select(is_nearer, new, square),
            select(is_nearer, f, f_of),
            select(is_nearer, piece, of),
        )

    @scalar
    def sign(a):
        """Return +1 for lanes above 0, and -1 for others."""
        nothing = a * ZERO
        return select(a > ZERO, nothing + ONE, nothing - ONE)

    @scalar
    def along(records, n, dx, dy, k, end):
        """Return the distance of a pixel beyond an end of curve k along its ray, in units of the end's distance."""
        at = vertices_at + N_VERTICES * k + 2 * N_EDGES * end
        beyond = (dx - records[n, at]) * records[n, at] + (dy - records[n, at + 1]) * records[n, at + 1]
        return beyond * records[n, inverses_at + N_INVERSES * k + N_EDGES + end]

    @scalar
    def walk_curve(records, n, dx, dy, k, side, nearest):
        """Return the side after the crossings of curve k, and the nearest point if it is on that curve."""
        nothing = broadcast(records.dtype.type(0))
        first_vertex, first_piece = vertices_at + N_VERTICES * k, N_INVERSES * k
        o_x, o_y = records[n, first_vertex], records[n, first_vertex + 1]
        first = sign(dx * o_y - dy * o_x)
        for i in range(N_EDGES):
            e_x, e_y = records[n, first_vertex + 2 * i + 2], records[n, first_vertex + 2 * i + 3]
            u_x, u_y, r_x, r_y = e_x - o_x, e_y - o_y, dx - o_x, dy - o_y
            f = (r_x * u_x + r_y * u_y) * records[n, inverses_at + first_piece + i]
            f = minimum(maximum(f, ZERO), ONE)
            piece = nothing + records.dtype.type(first_piece + i)
            nearest = nearer(nearest, (r_x - f * u_x, r_y - f * u_y), f, piece)
            last, origin = sign(dx * e_y - dy * e_x), select(u_y * o_x - u_x * o_y > ZERO, ONE, -ONE)
            crossed = first * last + origin * sign(u_x * r_y - u_y * r_x)
            side = select(crossed < -ONE, -side, side)  # both products are -1
            o_x, o_y, first = e_x, e_y, last
        # The two rays, along which the ends B move away from the centre.
        f, piece = maximum(along(records, n, dx, dy, k, 0), ZERO), nothing + records.dtype.type(first_piece + N_EDGES)
        away = dx - (ONE + f) * records[n, first_vertex], dy - (ONE + f) * records[n, first_vertex + 1]
        nearest = nearer(nearest, away, f, piece)
        f, end = maximum(along(records, n, dx, dy, k, 1), ZERO), first_vertex + 2 * N_EDGES
        away = dx - (ONE + f) * records[n, end], dy - (ONE + f) * records[n, end + 1]
        return side, nearer(nearest, away, f, piece + ONE)

    @scalar
    def side_and_nearest(records, n, dx, dy, n_walked):
        """Return +1 where an even number of edges is crossed, else -1, and the nearest point to the pixel at d."""
        nothing = broadcast(records.dtype.type(0))
        nearest = (nothing, nothing, nothing + _FAR, nothing, nothing)
        side = nothing + ONE
        for k in range(n_walked):
            side, nearest = walk_curve(records, n, dx, dy, k, side, nearest)
        return side, nearest

    @scalar
    def masked(records, n, side, distance):
        """Return the mask: a logistic curve of the distance, or a step where the width is 0."""
        e = exp(-distance * records[n, inverse_width_at])
        soft = select(side > ZERO, ONE / (ONE + e), e / (ONE + e))
        nothing = broadcast(records.dtype.type(0))
        hard = select((side > ZERO) & (distance > ZERO), nothing + ONE, nothing)
        return select(records[n, width_at] > ZERO, soft, hard)

    @scalar
    def hit(records, n, x, y):
        """Return the hit; where no pixel reaches the smallest alpha without the cuts, none is evaluated."""
        flat, _, (e, dy, falloff) = flat_hit(records, n, x, y)
        dx = x - records[n, MEAN_X]
        n_walked = n_curves if reduce_any(flat >= records[n, alpha_min_at]) else 0
        side, nearest = side_and_nearest(records, n, dx, -dy, n_walked)
        mask = masked(records, n, side, sqrt(nearest[2]))
        return flat * mask, records[n, depth_at], (mask, side, nearest, (e, dy, falloff))

    @scalar
    def hit_vjp(records, n, place, v_mean, v_shape, v_place):
        """Add ``v_z = mask (1 - mask) v_mask / w`` along the unit vector from the nearest point, by its weights."""
        mask, side, (x, y, square, f, piece), flat = place
        v_flat = flat_hit_vjp(records, n, flat, mask * v_mean, mask * v_shape, v_place)
        v_mask = v_shape * records[n, OPACITY] * flat[2]
        inverse = select(square > ZERO, ONE / sqrt(select(square > ZERO, square, ONE)), ZERO)
        v_z = side * mask * (ONE - mask) * v_mask * records[n, inverse_width_at] * inverse
        v_x, v_y = -v_z * x, -v_z * y
        return v_flat + of_points(piece, f, (v_x, v_y)) + (v_x, v_y)

    return KernelResponse(
        functools.partial(_records, conic.records),
        functools.partial(_records_vjp, conic.records_vjp),
        boxes_of,
        hit,
        hit_vjp,
        columns.n_gradients,
    )


@scalar
def inverse_square(x, y):
    """Return the inverse squared length of a vector, or that of the smallest length."""
    return 1.0 / max(x * x + y * y, LENGTH_MIN)


@scalar
def bernstein(t):
    """Return the weights of the control points of a cubic at t: see :func:`.response.bernstein`."""
    s = ONE - t
    return s * s * s, THREE * s * s * t, THREE * s * t * t, t * t * t


@scalar
def weights_of(piece, f):
    """Return the weights of the control points for a point on a piece of their curve.

    Vertices are multiples of 1/8 along a cubic, whose weights are exact in float32.
    """
    g, beyond = ONE - f, ONE + f
    is_edge, is_first = piece < _N_EDGES, piece < _N_EDGES + HALF
    a, b = bernstein(piece * _EDGE), bernstein((piece + ONE) * _EDGE)
    return (
        select(is_edge, g * a[0] + f * b[0], select(is_first, beyond, ZERO)),
        select(is_edge, g * a[1] + f * b[1], ZERO),
        select(is_edge, g * a[2] + f * b[2], ZERO),
        select(is_edge, g * a[3] + f * b[3], select(is_first, ZERO, beyond)),
    )


def _points_gradient(n_curves: int, first: int = 0) -> Callable:
    """Return a function that gives the gradient of all control points, which is 0 for those of other curves."""
    first_piece, next_piece = np.float32(N_INVERSES * first), np.float32(N_INVERSES * (first + 1))

    @scalar
    def own(piece, f, v):
        w_0, w_1, w_2, w_3 = weights_of(piece - first_piece, f)
        return w_0 * v[0], w_0 * v[1], w_1 * v[0], w_1 * v[1], w_2 * v[0], w_2 * v[1], w_3 * v[0], w_3 * v[1]

    if n_curves == 1:
        return own
    of_others = _points_gradient(n_curves, first + 1) if first + 1 < n_curves else scalar(lambda piece, f, v: ())

    @scalar
    def own_and_others(piece, f, v):
        is_own = (piece >= first_piece) & (piece < next_piece)
        v_x, v_y = select(is_own, v[0], ZERO), select(is_own, v[1], ZERO)
        return own(piece, f, (v_x, v_y)) + of_others(piece, f, v)

    return own_and_others


def response_for(n_curves: int, dtype: np.dtype) -> KernelResponse:
    """Return the response for M curves and arrays of a dtype: float32 data use the polynomial exponential."""
    return make_cut_response(exp_fast if dtype == np.float32 else exp_wide, n_curves)


@kernel()
def _write_curves(vertices, vertices_at, inverses_at, records):
    """Write the vertices of all curves, and the inverse squared lengths of their pieces."""
    for n in prange(len(vertices)):
        for k in range(vertices.shape[1]):
            at, pieces_at, last = vertices_at + N_VERTICES * k, inverses_at + N_INVERSES * k, vertices[n, k, N_EDGES]
            for i in range(N_EDGES + 1):
                records[n, at + 2 * i], records[n, at + 2 * i + 1] = vertices[n, k, i, 0], vertices[n, k, i, 1]
            for i in range(N_EDGES):
                u_x = vertices[n, k, i + 1, 0] - vertices[n, k, i, 0]
                u_y = vertices[n, k, i + 1, 1] - vertices[n, k, i, 1]
                records[n, pieces_at + i] = inverse_square(u_x, u_y)
            records[n, pieces_at + N_EDGES] = inverse_square(vertices[n, k, 0, 0], vertices[n, k, 0, 1])
            records[n, pieces_at + N_EDGES + 1] = inverse_square(last[0], last[1])


def _records(conic_records: Callable, footprints: CutFootprints, dtype: np.dtype) -> Floats:
    points, widths = footprints.points.astype(np.float64), footprints.widths
    n, n_curves = len(points), points.shape[1] // N_POINTS
    columns = columns_of(n_curves)
    records = np.zeros((n, columns.n), dtype)
    records[:, :CONIC_GRADIENTS] = conic_records(footprints.projection, dtype)[:, :CONIC_GRADIENTS]
    records[:, columns.depth], records[:, columns.width] = footprints.projection.depths, widths
    records[:, columns.alpha_min] = footprints.alpha_min
    records[:, columns.inverse_width] = np.where(widths > 0, 1 / np.where(widths > 0, widths, 1), 0)
    vertices = vertices_of(points.reshape(n, n_curves, N_POINTS, 2))
    _write_curves(vertices, columns.vertices, columns.inverses, records)
    return records


def _records_vjp(conic_records_vjp: Callable, footprints: CutFootprints, v_records: Floats) -> tuple[Floats, ...]:
    """Return the gradient with respect to the footprints' ``FIELDS``."""
    v_means2d, v_conics, v_opacities = conic_records_vjp(footprints.projection, v_records)
    dtype, shift = footprints.means2d.dtype, columns_of(footprints.points.shape[1] // N_POINTS).shift
    v_points = v_records[:, POINTS:shift].reshape(footprints.points.shape).astype(dtype)
    return v_means2d + v_records[:, shift : shift + 2].astype(dtype), v_conics, v_opacities, v_points
