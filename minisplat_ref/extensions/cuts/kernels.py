"""Gaussians with cuts on lanes: a response for the plain kernels.

A record holds the polygons' vertices and the inverse squared length of each piece, so that a pixel takes one loop over
the edges, which counts crossings by the sign of a product and keeps the nearest point with its curve and weights.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from minisplat_ref.cpu.compositing.exponential import choose_exponential
from minisplat_ref.cpu.compositing.responses import CONIC_GRADIENTS, MEAN_X, OPACITY, KernelResponse, conic_response
from minisplat_ref.extensions.cuts.response import LENGTH_MIN, N_EDGES, N_POINTS, VERTICES, CutFootprints
from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import broadcast, maximum, minimum, select, sqrt
from minisplat_ref.jit.literals import HALF, ONE, ZERO
from minisplat_ref.mechanisms.payload.footprints import boxes_of
from minisplat_ref.types import Floats

POINTS = CONIC_GRADIENTS  # gradients of the control points; the kernels do not read these columns
N_VERTICES = 2 * (N_EDGES + 1)  # columns of a curve
N_INVERSES = N_EDGES + 2
_WEIGHTS = VERTICES.astype(np.float32)  # exact
_FAR = np.float32(1e30)  # px^2


class Columns(NamedTuple):
    """The columns of a record with M curves, after those of the conic and of the control points' gradients."""

    shift: int
    """Gradient of the mask with respect to the centre's pixel, x and y; these are the last gradients."""
    depth: int
    width: int
    """px."""
    inverse_width: int
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
    vertices = shift + 5
    inverses = vertices + N_VERTICES * n_curves
    return Columns(shift, shift + 2, shift + 3, shift + 4, vertices, inverses, inverses + N_INVERSES * n_curves)


@functools.cache
def make_cut_response(exp: Callable, n_curves: int) -> KernelResponse:
    """Return the response for an exponential of :mod:`minisplat_ref.cpu.compositing.exponential`, and M curves."""
    conic, columns = conic_response(exp), columns_of(n_curves)
    flat_hit, flat_hit_vjp = conic.hit, conic.hit_vjp
    depth_at, width_at, inverse_width_at = columns.depth, columns.width, columns.inverse_width
    vertices_at, inverses_at = columns.vertices, columns.inverses
    spread = _spread(n_curves)

    @scalar
    def nearer(nearest, away, weights, curve):
        """Return the nearer of two points: d - q with its square, and the curve with its control points' weights."""
        x, y, square, w_0, w_1, w_2, w_3, of = nearest
        new = away[0] * away[0] + away[1] * away[1]
        is_nearer = new < square
        return (
            select(is_nearer, away[0], x),
            select(is_nearer, away[1], y),
            select(is_nearer, new, square),
            select(is_nearer, weights[0], w_0),
            select(is_nearer, weights[1], w_1),
            select(is_nearer, weights[2], w_2),
            select(is_nearer, weights[3], w_3),
            select(is_nearer, curve, of),
        )

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
        curve, first_vertex = nothing + records.dtype.type(k), vertices_at + N_VERTICES * k
        for i in range(N_EDGES):
            o_x, o_y, e_x, e_y = (
                records[n, first_vertex + 2 * i],
                records[n, first_vertex + 2 * i + 1],
                records[n, first_vertex + 2 * i + 2],
                records[n, first_vertex + 2 * i + 3],
            )
            u_x, u_y, r_x, r_y = e_x - o_x, e_y - o_y, dx - o_x, dy - o_y
            f = (r_x * u_x + r_y * u_y) * records[n, inverses_at + N_INVERSES * k + i]
            f = minimum(maximum(f, ZERO), ONE)
            g = ONE - f
            weights = (
                g * _WEIGHTS[i, 0] + f * _WEIGHTS[i + 1, 0],
                g * _WEIGHTS[i, 1] + f * _WEIGHTS[i + 1, 1],
                g * _WEIGHTS[i, 2] + f * _WEIGHTS[i + 1, 2],
                g * _WEIGHTS[i, 3] + f * _WEIGHTS[i + 1, 3],
            )
            nearest = nearer(nearest, (r_x - f * u_x, r_y - f * u_y), weights, curve)
            first = select(dx * o_y - dy * o_x > ZERO, nothing + ONE, nothing - ONE)
            last = select(dx * e_y - dy * e_x > ZERO, nothing + ONE, nothing - ONE)
            beyond = select(u_x * r_y - u_y * r_x > ZERO, nothing + ONE, nothing - ONE)
            origin = select(u_y * o_x - u_x * o_y > ZERO, ONE, -ONE)
            side = select((first * last < ZERO) & (beyond * origin < ZERO), -side, side)
        # The two rays, along which the ends B move away from the centre.
        f = maximum(along(records, n, dx, dy, k, 0), ZERO)
        away = dx - (ONE + f) * records[n, first_vertex], dy - (ONE + f) * records[n, first_vertex + 1]
        nearest = nearer(nearest, away, (ONE + f, nothing, nothing, nothing), curve)
        f, end = maximum(along(records, n, dx, dy, k, 1), ZERO), first_vertex + 2 * N_EDGES
        away = dx - (ONE + f) * records[n, end], dy - (ONE + f) * records[n, end + 1]
        return side, nearer(nearest, away, (nothing, nothing, nothing, ONE + f), curve)

    @scalar
    def side_and_nearest(records, n, dx, dy):
        """Return +1 where an even number of edges is crossed, else -1, and the nearest point to the pixel at d."""
        nothing = broadcast(records.dtype.type(0))
        nearest = (nothing, nothing, nothing + _FAR, nothing, nothing, nothing, nothing, nothing)
        side = nothing + ONE
        for k in range(n_curves):
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
        flat, _, (e, dy, falloff) = flat_hit(records, n, x, y)
        dx = x - records[n, MEAN_X]
        side, nearest = side_and_nearest(records, n, dx, -dy)
        mask = masked(records, n, side, sqrt(nearest[2]))
        return flat * mask, records[n, depth_at], (mask, side, nearest, (e, dy, falloff))

    @scalar
    def hit_vjp(records, n, place, v_mean, v_shape, v_place):
        """Add ``v_z = mask (1 - mask) v_mask / w`` along the unit vector from the nearest point, by its weights."""
        mask, side, (x, y, square, w_0, w_1, w_2, w_3, curve), flat = place
        v_flat = flat_hit_vjp(records, n, flat, mask * v_mean, mask * v_shape, v_place)
        v_mask = v_shape * records[n, OPACITY] * flat[2]
        inverse = select(square > ZERO, ONE / sqrt(select(square > ZERO, square, ONE)), ZERO)
        v_z = side * mask * (ONE - mask) * v_mask * records[n, inverse_width_at] * inverse
        v_x, v_y = -v_z * x, -v_z * y
        v_points = (w_0 * v_x, w_0 * v_y, w_1 * v_x, w_1 * v_y, w_2 * v_x, w_2 * v_y, w_3 * v_x, w_3 * v_y)
        return v_flat + spread(curve, v_points) + (v_x, v_y)

    return KernelResponse(
        functools.partial(_records, conic.records),
        functools.partial(_records_vjp, conic.records_vjp),
        boxes_of,
        hit,
        hit_vjp,
        columns.n_gradients,
    )


def _spread(n_curves: int, first: int = 0) -> Callable:
    """Return a function that puts eight lanes of gradients in the columns of their curve, and zeros in the others."""
    number = np.float32(first)

    @scalar
    def own(curve, v):
        is_own = abs(curve - number) < HALF
        return (
            select(is_own, v[0], ZERO),
            select(is_own, v[1], ZERO),
            select(is_own, v[2], ZERO),
            select(is_own, v[3], ZERO),
            select(is_own, v[4], ZERO),
            select(is_own, v[5], ZERO),
            select(is_own, v[6], ZERO),
            select(is_own, v[7], ZERO),
        )

    if first + 1 == n_curves:
        return own
    of_others = _spread(n_curves, first + 1)

    @scalar
    def own_and_others(curve, v):
        return own(curve, v) + of_others(curve, v)

    return own_and_others


def response_for(n_curves: int, dtype: np.dtype) -> KernelResponse:
    """Return the response for M curves and arrays of a dtype: float32 data use the polynomial exponential."""
    return make_cut_response(choose_exponential(dtype), n_curves)


def _records(conic_records: Callable, footprints: CutFootprints, dtype: np.dtype) -> Floats:
    points, widths = footprints.points.astype(np.float64), footprints.widths
    n, n_curves = len(points), points.shape[1] // N_POINTS
    columns = columns_of(n_curves)
    vertices = np.einsum("ij,nmjk->nmik", VERTICES, points.reshape(n, n_curves, N_POINTS, 2))  # [N, M, N_EDGES + 1, 2]
    pieces = np.concatenate([np.diff(vertices, axis=2), vertices[:, :, [0, -1]]], axis=2)
    records = np.zeros((n, columns.n), dtype)
    records[:, :CONIC_GRADIENTS] = conic_records(footprints.projection, dtype)[:, :CONIC_GRADIENTS]
    records[:, columns.depth], records[:, columns.width] = footprints.projection.depths, widths
    records[:, columns.inverse_width] = np.where(widths > 0, 1 / np.where(widths > 0, widths, 1), 0)
    records[:, columns.vertices : columns.inverses] = vertices.reshape(n, columns.inverses - columns.vertices)
    records[:, columns.inverses :] = 1 / np.maximum(np.sum(pieces**2, axis=3), LENGTH_MIN).reshape(
        n, columns.n - columns.inverses
    )
    return records


def _records_vjp(conic_records_vjp: Callable, footprints: CutFootprints, v_records: Floats) -> tuple[Floats, ...]:
    """Return the gradient with respect to the footprints' ``FIELDS``."""
    v_means2d, v_conics, v_opacities = conic_records_vjp(footprints.projection, v_records)
    dtype, shift = footprints.means2d.dtype, columns_of(footprints.points.shape[1] // N_POINTS).shift
    v_points = v_records[:, POINTS:shift].reshape(footprints.points.shape).astype(dtype)
    return v_means2d + v_records[:, shift : shift + 2].astype(dtype), v_conics, v_opacities, v_points
