"""Responses for the plain kernels: a primitive's alpha at a pixel, as formulas on lanes over a row of numbers.

The reference describes a response as functions of whole arrays (``reference.hits``); here each is a ``scalar`` function
of one primitive and eight pixels. A kernel never sees the primitive itself: it reads the row that ``records`` made of
it, and returns the gradient with respect to the first numbers of that row, which ``records_vjp`` converts to one with
respect to the primitive. The record also has the camera's terms of a ray: the direction of a pixel's ray is
linear in (x, y, 1).

The conic, a flat ellipse in the image, is the first response and that of 3DGS. Its record holds the conic as factors:
with e = dx + slope dy, sigma = (a e^2 + pivot dy^2) / 2.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import LIST_ORDER
from minisplat_ref.cpu.compositing.pixel_rows import hit_ray_row, hit_row
from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.literals import TWO
from minisplat_ref.scalar.compositing import conic_vjp_of_moments, factors, halve_factor, mahalanobis
from minisplat_ref.types import Floats, Ints, Projection


@scalar
def constant_color(colors, n, k, place):
    """Return channel k of a primitive that has the same colours [D] in all pixels."""
    return colors[n, k]


@scalar
def constant_color_vjp(colors, n, k, place, v):
    """Return the derivative with respect to the channel's one coefficient; there is none for the place."""
    return (v,), ()


class KernelResponse(NamedTuple):
    """A response for the kernels. The first three functions are NumPy over all primitives, the others lanes of one hit.

    A ``place`` is a tuple of lanes with whatever ``shade`` and the derivatives need of a hit: offsets, the coordinates
    (u, v) on a surfel, the depth. It has to be finite even where the primitive is missed.
    """

    records: Callable[[Any, np.dtype], Floats]
    """Maps primitives and a dtype to one row [F] for each."""
    records_vjp: Callable[[Any, Floats], tuple[Floats, ...]]
    """Maps primitives and float64 derivatives [N, n_gradients] to a derivative for each field that has one."""
    boxes: Callable[[Any], Ints]
    """[N, 4] int32 half-open pixels x0, y0, x1, y1: nothing is hit elsewhere."""
    hit: Callable
    """(records, n, x, y) -> alpha before the clamp, depth on the ray, place; x and y are the pixels' centres."""
    hit_vjp: Callable
    """(records, n, place, v_mean, v_shape, v_place) -> ``n_gradients`` lanes.

    ``v_mean`` and ``v_shape`` both are dL/dalpha: the first for what moves the primitive, the second for all else,
    because conventions may stop either at the clamp. ``v_place`` [n_places * 8] is dL/dplace, from ``shade``.
    """
    n_gradients: int
    """Numbers at the start of a record that have a derivative."""
    shade: Callable = constant_color
    """(colors, n, k, place) -> channel k of the hit."""
    shade_vjp: Callable = constant_color_vjp
    """(colors, n, k, place, v) -> lanes for the coefficients of the channel, and for the start of the place."""
    n_coefficients: int = 1
    """Of each channel: those of channel k are ``colors[n, k * n_coefficients :]``."""
    n_places: int = 0
    """Numbers at the start of a place that colours depend on."""
    rays: Callable[[Any, np.dtype], Floats] | None = None
    """Maps primitives and a dtype to the pixels' directions [3 H, W + 7]: then the ``x`` of ``hit`` is the three
    components of a ray. By default hits depend on the pixels' centres alone."""
    buffer_size: int = LIST_ORDER
    """Size of each pixel's k-buffer: when it is full, the pixel takes the nearest of the hits in it.

    ``LIST_ORDER`` = 1 takes hits in the order of the list, ``EXACT_ORDER`` buffers any number.
    """

    @property
    def hit_row(self) -> Callable:
        """Function that calls ``hit`` for eight pixels of a line."""
        return hit_row if self.rays is None else hit_ray_row


# Columns of a conic's record; the depth has no derivative.
MEAN_X, MEAN_Y, HALF_A, SLOPE, HALF_PIVOT, OPACITY, DEPTH = range(7)
CONIC_GRADIENTS = DEPTH  # records that extend a conic's begin with these columns


@functools.cache
def conic_response(exp: Callable) -> KernelResponse:
    """Return the response of projected Gaussians for one of :mod:`minisplat_ref.cpu.compositing.exponential`."""

    @scalar
    def conic_hit(records, n, x, y):
        dx, dy = records[n, MEAN_X] - x, records[n, MEAN_Y] - y
        e = dx + records[n, SLOPE] * dy
        falloff = exp(-mahalanobis(e, records[n, HALF_A], records[n, HALF_PIVOT] * dy * dy))
        return records[n, OPACITY] * falloff, records[n, DEPTH], (e, dy, falloff)

    @scalar
    def conic_hit_vjp(records, n, place, v_mean, v_shape, v_place):
        """With q = dL/dsigma = -alpha v: dsigma/de = a e, and de = (dx + slope dy), (dslope) dy."""
        e, dy, falloff = place
        a, slope, pivot = TWO * records[n, HALF_A], records[n, SLOPE], TWO * records[n, HALF_PIVOT]
        q_mean, q_shape = -records[n, OPACITY] * falloff * v_mean, -records[n, OPACITY] * falloff * v_shape
        v_e = a * e
        v_dy = pivot * dy + slope * v_e
        return q_mean * v_e, q_mean * v_dy, q_shape * e * e, q_shape * v_e * dy, q_shape * dy * dy, falloff * v_shape

    return KernelResponse(_conic_records, _conic_records_vjp, _conic_boxes, conic_hit, conic_hit_vjp, CONIC_GRADIENTS)


def _conic_factors(projection: Projection) -> tuple[Floats, Floats, Floats]:
    """Return a, slope and pivot of every footprint in float64; those of a circle where it is culled."""
    is_culled = projection.radii[:, 0] == 0
    a, b, c = projection.conics.T
    return factors(a + is_culled, b, c + is_culled)  # conics of culled Gaussians are 0


def _conic_records(projection: Projection, dtype: np.dtype) -> Floats:
    a, slope, pivot = _conic_factors(projection)
    records = np.empty((len(a), DEPTH + 1), dtype)
    records[:, MEAN_X], records[:, MEAN_Y] = projection.means2d.T
    # Rounding can make a factor negative: then only the pixel at the centre is hit.
    records[:, HALF_A], records[:, HALF_PIVOT] = halve_factor(a), halve_factor(pivot)
    records[:, SLOPE], records[:, OPACITY], records[:, DEPTH] = slope, projection.opacities, projection.depths
    return records


def _conic_records_vjp(projection: Projection, v_records: Floats) -> tuple[Floats, ...]:
    """Return the gradient with respect to means2d, conics and opacities."""
    a, slope, _ = _conic_factors(projection)
    ee, ey, yy = v_records[:, HALF_A], v_records[:, SLOPE] / a, v_records[:, HALF_PIVOT]
    v_conics = np.column_stack(conic_vjp_of_moments(slope, ee, ey, yy))
    dtype = projection.means2d.dtype
    return v_records[:, :HALF_A].astype(dtype), v_conics, v_records[:, OPACITY].astype(dtype)


def _conic_boxes(projection: Projection) -> Ints:
    return projection.boxes
