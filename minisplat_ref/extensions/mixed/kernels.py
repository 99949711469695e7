"""Hulls on lanes: a response for the plain kernels.

A record begins with the conic's, whose factors whiten: ``e = dx + slope dy`` and dy are, but for their lengths, the
whitened coordinates. It continues with the vertices from the centre, and for each edge u with ``g = Q u / (u . Q u)``,
so that the nearest point of a line through o along u is found by one product, ``f = -(o . g)``.

Surfaces have the same records with their planes in them, and the depth of :mod:`.response` at every pixel.
"""

import functools
from collections.abc import Callable

import numpy as np

from minisplat_ref.cpu.compositing.exponential import choose_exponential
from minisplat_ref.cpu.compositing.responses import (
    CONIC_GRADIENTS,
    HALF_A,
    HALF_PIVOT,
    MEAN_X,
    MEAN_Y,
    OPACITY,
    SLOPE,
    KernelResponse,
    conic_response,
)
from minisplat_ref.extensions.mixed.response import FLAT, RATIO_MIN, HullFootprints, SurfaceFootprints
from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import broadcast, load, maximum, minimum, select
from minisplat_ref.jit.literals import ONE, TWO, ZERO
from minisplat_ref.mechanisms.payload.footprints import boxes_of
from minisplat_ref.mechanisms.surfels.kernels import channels_of, depth_shades
from minisplat_ref.mechanisms.surfels.response import Layout
from minisplat_ref.scalar.compositing import mahalanobis
from minisplat_ref.types import Floats

V_1, V_2, V_3 = range(CONIC_GRADIENTS, CONIC_GRADIENTS + 6, 2)  # vertices from the centre
N_GRADIENTS = V_3 + 2
# Of surfaces: w, the inverse depth of the mean, and s.
INVERSE_DEPTH, TILT_X, TILT_Y = range(N_GRADIENTS, N_GRADIENTS + 3)
N_SURFACE_GRADIENTS = TILT_Y + 1
# ORIENTATION: sign of the triangle's area, 0 if it is flat
DEPTH, COUNT, ORIENTATION, PIVOT = range(N_SURFACE_GRADIENTS, N_SURFACE_GRADIENTS + 4)
G_12, G_23, G_31 = range(PIVOT + 1, PIVOT + 7, 2)
N_COLUMNS = G_31 + 2
_RATIO_MIN = np.float32(RATIO_MIN)


@functools.cache
def hull_response(exp: Callable) -> KernelResponse:
    """Return the response of hulls, with an exponential of :mod:`minisplat_ref.cpu.compositing.exponential`."""
    conic = conic_response(exp)

    @scalar
    def from_pixel(records, n, d_x, d_y, vertex):
        """Return a vertex from the pixel from which the centre is at d."""
        return d_x + records[n, vertex], d_y + records[n, vertex + 1]

    @scalar
    def on_edge(records, n, o, end, g):
        """Return the nearest point of an edge from its pixel, sigma there, and the fraction of the edge before it."""
        u = end[0] - o[0], end[1] - o[1]
        f = minimum(maximum(-(o[0] * records[n, g] + o[1] * records[n, g + 1]), ZERO), ONE)
        d_x, d_y = o[0] + f * u[0], o[1] + f * u[1]
        e = d_x + records[n, SLOPE] * d_y
        return d_x, d_y, mahalanobis(e, records[n, HALF_A], records[n, HALF_PIVOT] * d_y * d_y), f

    @scalar
    def on_triangle(records, n, d_x, d_y):
        """Return the nearest point of a triangle from its pixel, sigma there, and the weights of the vertices."""
        nothing = broadcast(records.dtype.type(0))
        o_1 = from_pixel(records, n, d_x, d_y, V_1)
        o_2 = from_pixel(records, n, d_x, d_y, V_2)
        o_3 = from_pixel(records, n, d_x, d_y, V_3)
        d_x, d_y, sigma, f = on_edge(records, n, o_1, o_2, G_12)
        w_1, w_2, w_3 = ONE - f, f, nothing
        x, y, new, f = on_edge(records, n, o_2, o_3, G_23)
        is_nearer = new < sigma
        d_x, d_y, sigma = select(is_nearer, x, d_x), select(is_nearer, y, d_y), select(is_nearer, new, sigma)
        w_1, w_2, w_3 = select(is_nearer, ZERO, w_1), select(is_nearer, ONE - f, w_2), select(is_nearer, f, w_3)
        x, y, new, f = on_edge(records, n, o_3, o_1, G_31)
        is_nearer = new < sigma
        d_x, d_y, sigma = select(is_nearer, x, d_x), select(is_nearer, y, d_y), select(is_nearer, new, sigma)
        w_1, w_2, w_3 = select(is_nearer, f, w_1), select(is_nearer, ZERO, w_2), select(is_nearer, ONE - f, w_3)
        orientation = records[n, ORIENTATION]
        from_inside = minimum(
            minimum(orientation * side(o_1, o_2), orientation * side(o_2, o_3)), orientation * side(o_3, o_1)
        )
        inside = from_inside > ZERO
        d_x, d_y, sigma = select(inside, ZERO, d_x), select(inside, ZERO, d_y), select(inside, ZERO, sigma)
        return d_x, d_y, sigma, select(inside, ZERO, w_1), select(inside, ZERO, w_2), select(inside, ZERO, w_3)

    @scalar
    def hit(records, n, x, y):
        nothing = broadcast(records.dtype.type(0))
        d_x, d_y = records[n, MEAN_X] - x, records[n, MEAN_Y] - y + nothing
        w_1, w_2, w_3 = nothing + ONE, nothing, nothing
        if records[n, COUNT] == ONE:
            e = d_x + records[n, SLOPE] * d_y
            sigma = mahalanobis(e, records[n, HALF_A], records[n, HALF_PIVOT] * d_y * d_y)
        elif records[n, COUNT] == TWO:
            o_1, o_2 = from_pixel(records, n, d_x, d_y, V_1), from_pixel(records, n, d_x, d_y, V_2)
            d_x, d_y, sigma, w_2 = on_edge(records, n, o_1, o_2, G_12)
            w_1 = ONE - w_2
        else:
            d_x, d_y, sigma, w_1, w_2, w_3 = on_triangle(records, n, d_x, d_y)
        falloff = exp(-sigma)
        return records[n, OPACITY] * falloff, records[n, DEPTH], (d_x, d_y, falloff, w_1, w_2, w_3)

    @scalar
    def hit_vjp(records, n, place, v_mean, v_shape, v_place):
        """With q = dL/dsigma = -alpha v: that of a conic around the nearest point, v_d distributed by the weights."""
        d_x, d_y, falloff, w_1, w_2, w_3 = place
        a, slope, pivot = TWO * records[n, HALF_A], records[n, SLOPE], TWO * records[n, HALF_PIVOT]
        alpha = records[n, OPACITY] * falloff
        e, q_shape = d_x + slope * d_y, -alpha * v_shape
        ae = a * e
        v_x, v_y = -alpha * v_mean * ae, -alpha * v_mean * (pivot * d_y + slope * ae)
        return (
            v_x,
            v_y,
            q_shape * e * e,
            q_shape * ae * d_y,
            q_shape * d_y * d_y,
            falloff * v_shape,
            w_1 * v_x,
            w_1 * v_y,
            w_2 * v_x,
            w_2 * v_y,
            w_3 * v_x,
            w_3 * v_y,
        )

    return KernelResponse(
        functools.partial(_records, conic.records),
        functools.partial(_records_vjp, conic.records_vjp),
        boxes_of,
        hit,
        hit_vjp,
        N_GRADIENTS,
    )


@functools.cache
def _surface_response(exp: Callable, layout: tuple[int, int]) -> KernelResponse:
    """Return the response of hulls with a depth at every pixel."""
    hull = hull_response(exp)
    hull_hit, hull_hit_vjp = hull.hit, hull.hit_vjp

    @scalar
    def hit(records, n, x, y):
        alpha, _, on_hull = hull_hit(records, n, x, y)
        nothing = broadcast(records.dtype.type(0))
        d_x, d_y = records[n, MEAN_X] - x, records[n, MEAN_Y] - y + nothing
        r = ONE - (records[n, TILT_X] * d_x + records[n, TILT_Y] * d_y)
        depth = ONE / (records[n, INVERSE_DEPTH] * maximum(r, _RATIO_MIN))
        return alpha, depth, (depth, d_x, d_y, r, on_hull, records[n, PIVOT])

    @scalar
    def hit_vjp(records, n, place, v_mean, v_shape, v_place):
        """With ``q = 1 / z = w r``: ``v_q = -z^2 v_z``; see :func:`.response.hit_surface_vjp`."""
        depth, d_x, d_y, r, on_hull, _ = place
        v = hull_hit_vjp(records, n, on_hull, v_mean, v_shape, v_place)
        v_q = -depth * depth * load(v_place, 0)
        v_r = select(r < _RATIO_MIN, ZERO, records[n, INVERSE_DEPTH] * v_q)
        return (
            v[0] - records[n, TILT_X] * v_r,
            v[1] - records[n, TILT_Y] * v_r,
            *v[2:],
            maximum(r, _RATIO_MIN) * v_q,
            -v_r * d_x,
            -v_r * d_y,
        )

    return KernelResponse(
        functools.partial(_surface_records, hull.records),
        functools.partial(_surface_records_vjp, hull.records_vjp),
        boxes_of,
        hit,
        hit_vjp,
        N_SURFACE_GRADIENTS,
        *depth_shades(layout),
        n_places=1,
    )


@scalar
def side(a, b):
    """Return the cross product of a and b: its sign is the side of the edge from a to b on which the origin lies."""
    return a[0] * b[1] - a[1] * b[0]


def make_response(dtype: np.dtype) -> KernelResponse:
    """Return the response for arrays of a dtype: float32 data use the polynomial exponential."""
    return hull_response(choose_exponential(dtype))


def make_surface_response(layout: Layout, dtype: np.dtype) -> KernelResponse:
    """Return the response of surfaces with the channels of a layout."""
    return _surface_response(choose_exponential(dtype), channels_of(layout))


def _records(conic_records: Callable, footprints: HullFootprints, dtype: np.dtype) -> Floats:
    projection, vertices, n_vertices = footprints.projection, footprints.vertices, footprints.n_vertices
    records = np.zeros((len(n_vertices), N_COLUMNS), dtype)
    records[:, :CONIC_GRADIENTS] = conic_records(projection, dtype)[:, :CONIC_GRADIENTS]
    records[:, V_1:N_GRADIENTS], records[:, DEPTH] = vertices.reshape(-1, 6), projection.depths
    records[:, COUNT] = n_vertices
    rows = np.flatnonzero(n_vertices > 1)
    v_x, v_y = np.moveaxis(vertices[rows].astype(np.float64), 2, 0)  # [H, 3] each
    x, y = np.roll(v_x, -1, axis=1) - v_x, np.roll(v_y, -1, axis=1) - v_y  # of the edges
    a, b, c = projection.conics[rows].astype(np.float64).T[:, :, None]
    Q_x, Q_y = a * x + b * y, b * x + c * y
    lengths = x * Q_x + y * Q_y  # squared
    inverses = np.where(lengths > 0, 1 / np.where(lengths > 0, lengths, 1), 0)
    records[rows, G_12:N_COLUMNS:2], records[rows, G_12 + 1 : N_COLUMNS : 2] = Q_x * inverses, Q_y * inverses
    area = y[:, 0] * x[:, 2] - x[:, 0] * y[:, 2]  # twice
    is_flat = np.abs(area) <= FLAT * np.max(x * x + y * y, axis=1)
    records[rows, ORIENTATION] = np.where(is_flat, 0, np.sign(area))
    return records


def _records_vjp(conic_records_vjp: Callable, footprints: HullFootprints, v_records: Floats) -> tuple[Floats, ...]:
    """Gradient with respect to the footprints' ``FIELDS``."""
    v_vertices = v_records[:, V_1:N_GRADIENTS].reshape(-1, 3, 2).astype(footprints.vertices.dtype)
    return *conic_records_vjp(footprints.projection, v_records), v_vertices


def _surface_records(hull_records: Callable, footprints: SurfaceFootprints, dtype: np.dtype) -> Floats:
    records: Floats = hull_records(footprints, dtype)
    records[:, INVERSE_DEPTH:N_SURFACE_GRADIENTS], records[:, PIVOT] = footprints.planes, footprints.pivot
    return records


def _surface_records_vjp(
    hull_records_vjp: Callable, footprints: SurfaceFootprints, v_records: Floats
) -> tuple[Floats, ...]:
    """Gradient with respect to the footprints' ``FIELDS``."""
    v_planes = v_records[:, INVERSE_DEPTH:N_SURFACE_GRADIENTS].astype(footprints.planes.dtype)
    return *hull_records_vjp(footprints, v_records), v_planes
