"""Gaussians with cuts on lanes: a response for the plain kernels.

A record holds the polygon's vertices and the inverse squared length of each piece, so that a pixel takes one loop over
the edges, which counts crossings by the sign of a product and keeps the nearest point with its weights.
"""

import functools
from collections.abc import Callable

import numpy as np

from minisplat_ref.cpu.compositing.exponential import choose_exponential
from minisplat_ref.cpu.compositing.responses import CONIC_GRADIENTS, MEAN_X, OPACITY, KernelResponse, conic_response
from minisplat_ref.extensions.cuts.curve import LENGTH_MIN, N_EDGES, N_POINTS, VERTICES
from minisplat_ref.extensions.cuts.response import CutFootprints
from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import broadcast, maximum, minimum, select, sqrt
from minisplat_ref.jit.literals import ONE, ZERO
from minisplat_ref.mechanisms.payload.footprints import boxes_of
from minisplat_ref.types import Floats

POINTS = CONIC_GRADIENTS  # gradients of the control points; the kernels do not read these columns
SHIFT = POINTS + 2 * N_POINTS  # gradient of the mask with respect to the centre's pixel
N_GRADIENTS = SHIFT + 2
DEPTH, WIDTH_PX, INVERSE_WIDTH = range(N_GRADIENTS, N_GRADIENTS + 3)
V = INVERSE_WIDTH + 1  # vertices, x and y
INVERSES = V + 2 * (N_EDGES + 1)  # inverse squared lengths of the edges, then of the two rays
N_COLUMNS = INVERSES + N_EDGES + 2
_WEIGHTS = VERTICES.astype(np.float32)  # exact
_FAR = np.float32(1e30)  # px^2


@functools.cache
def make_cut_response(exp: Callable) -> KernelResponse:
    """Return the response of cut Gaussians with an exponential of :mod:`minisplat_ref.cpu.compositing.exponential`."""
    conic = conic_response(exp)
    flat_hit, flat_hit_vjp = conic.hit, conic.hit_vjp

    @scalar
    def nearer(nearest, away, weights):
        """Return the nearer of two points of the curve: d - q with its square, and the control points' weights."""
        x, y, square, w_0, w_1, w_2, w_3 = nearest
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
        )

    @scalar
    def side_and_nearest(records, n, dx, dy):
        """Return +1 where an even number of edges is crossed, else -1, and the nearest point to the pixel at d."""
        nothing = broadcast(records.dtype.type(0))
        nearest = (nothing, nothing, nothing + _FAR, nothing, nothing, nothing, nothing)
        side = nothing + ONE
        for i in range(N_EDGES):
            o_x, o_y, e_x, e_y = (
                records[n, V + 2 * i],
                records[n, V + 2 * i + 1],
                records[n, V + 2 * i + 2],
                records[n, V + 2 * i + 3],
            )
            u_x, u_y, r_x, r_y = e_x - o_x, e_y - o_y, dx - o_x, dy - o_y
            f = minimum(maximum((r_x * u_x + r_y * u_y) * records[n, INVERSES + i], ZERO), ONE)
            g = ONE - f
            weights = (
                g * _WEIGHTS[i, 0] + f * _WEIGHTS[i + 1, 0],
                g * _WEIGHTS[i, 1] + f * _WEIGHTS[i + 1, 1],
                g * _WEIGHTS[i, 2] + f * _WEIGHTS[i + 1, 2],
                g * _WEIGHTS[i, 3] + f * _WEIGHTS[i + 1, 3],
            )
            nearest = nearer(nearest, (r_x - f * u_x, r_y - f * u_y), weights)
            first = select(dx * o_y - dy * o_x > ZERO, nothing + ONE, nothing - ONE)
            last = select(dx * e_y - dy * e_x > ZERO, nothing + ONE, nothing - ONE)
            beyond = select(u_x * r_y - u_y * r_x > ZERO, nothing + ONE, nothing - ONE)
            origin = select(u_y * o_x - u_x * o_y > ZERO, ONE, -ONE)
            side = select((first * last < ZERO) & (beyond * origin < ZERO), -side, side)
        # The two rays, along which the ends B move away from the centre.
        f = maximum(_along(records, n, dx, dy, 0), ZERO)
        away = dx - (ONE + f) * records[n, V], dy - (ONE + f) * records[n, V + 1]
        nearest = nearer(nearest, away, (ONE + f, nothing, nothing, nothing))
        f = maximum(_along(records, n, dx, dy, 1), ZERO)
        away = dx - (ONE + f) * records[n, V + 2 * N_EDGES], dy - (ONE + f) * records[n, V + 2 * N_EDGES + 1]
        return side, nearer(nearest, away, (nothing, nothing, nothing, ONE + f))

    @scalar
    def masked(records, n, side, distance):
        """Return the mask: a logistic curve of the distance, or a step where the width is 0."""
        e = exp(-distance * records[n, INVERSE_WIDTH])
        soft = select(side > ZERO, ONE / (ONE + e), e / (ONE + e))
        nothing = broadcast(records.dtype.type(0))
        hard = select((side > ZERO) & (distance > ZERO), nothing + ONE, nothing)
        return select(records[n, WIDTH_PX] > ZERO, soft, hard)

    @scalar
    def hit(records, n, x, y):
        flat, _, (e, dy, falloff) = flat_hit(records, n, x, y)
        dx = x - records[n, MEAN_X]
        side, nearest = side_and_nearest(records, n, dx, -dy)
        mask = masked(records, n, side, sqrt(nearest[2]))
        return flat * mask, records[n, DEPTH], (mask, side, nearest, (e, dy, falloff))

    @scalar
    def hit_vjp(records, n, place, v_mean, v_shape, v_place):
        """Add ``v_z = mask (1 - mask) v_mask / w`` along the unit vector from the nearest point, by its weights."""
        mask, side, (x, y, square, w_0, w_1, w_2, w_3), flat = place
        v_flat = flat_hit_vjp(records, n, flat, mask * v_mean, mask * v_shape, v_place)
        v_mask = v_shape * records[n, OPACITY] * flat[2]
        inverse = select(square > ZERO, ONE / sqrt(select(square > ZERO, square, ONE)), ZERO)
        v_z = side * mask * (ONE - mask) * v_mask * records[n, INVERSE_WIDTH] * inverse
        v_x, v_y = -v_z * x, -v_z * y
        v_points = (w_0 * v_x, w_0 * v_y, w_1 * v_x, w_1 * v_y, w_2 * v_x, w_2 * v_y, w_3 * v_x, w_3 * v_y)
        return v_flat + v_points + (v_x, v_y)

    return KernelResponse(
        functools.partial(_records, conic.records),
        functools.partial(_records_vjp, conic.records_vjp),
        boxes_of,
        hit,
        hit_vjp,
        N_GRADIENTS,
    )


@scalar
def _along(records, n, dx, dy, end):
    """Return how far beyond the curve's end a pixel lies along one of the rays, in units of the end's distance."""
    k = V + 2 * N_EDGES * end
    along = (dx - records[n, k]) * records[n, k] + (dy - records[n, k + 1]) * records[n, k + 1]
    return along * records[n, INVERSES + N_EDGES + end]


def response_for(dtype: np.dtype) -> KernelResponse:
    """Return the response for arrays of a dtype: float32 data use the polynomial exponential."""
    return make_cut_response(choose_exponential(dtype))


def _records(conic_records: Callable, footprints: CutFootprints, dtype: np.dtype) -> Floats:
    vertices = np.einsum("ij,njk->nik", VERTICES, footprints.points.astype(np.float64))  # [N, N_EDGES + 1, 2]
    pieces = np.concatenate([np.diff(vertices, axis=1), vertices[:, [0, -1]]], axis=1)
    widths, n = footprints.widths, len(footprints.widths)
    records = np.zeros((n, N_COLUMNS), dtype)
    records[:, :CONIC_GRADIENTS] = conic_records(footprints.projection, dtype)[:, :CONIC_GRADIENTS]
    records[:, DEPTH], records[:, WIDTH_PX] = footprints.projection.depths, widths
    records[:, INVERSE_WIDTH] = np.where(widths > 0, 1 / np.where(widths > 0, widths, 1), 0)
    records[:, V:INVERSES] = vertices.reshape(n, 2 * (N_EDGES + 1))
    records[:, INVERSES:] = 1 / np.maximum(np.sum(pieces**2, axis=2), LENGTH_MIN)
    return records


def _records_vjp(conic_records_vjp: Callable, footprints: CutFootprints, v_records: Floats) -> tuple[Floats, ...]:
    """Return the gradient with respect to the footprints' ``FIELDS``."""
    v_means2d, v_conics, v_opacities = conic_records_vjp(footprints.projection, v_records)
    dtype = footprints.means2d.dtype
    v_points = v_records[:, POINTS:SHIFT].reshape(-1, N_POINTS, 2).astype(dtype)
    return v_means2d + v_records[:, SHIFT:N_GRADIENTS].astype(dtype), v_conics, v_opacities, v_points
