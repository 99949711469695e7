"""Surfels on lanes: a response for the plain kernels, stated without the planes of the reference.

The map from the disc to the pixel, ``T (u, v, 1)^T = z (x, y, 1)^T``, is inverted once for each surfel instead of being
intersected with two planes for each pixel::

    (u, v, 1) / z = T^-1 (x, y, 1)^T

These are three linear functions of the pixel, U, V and W, and the depth of the hit is z = 1 / W. They are stored by
their values at a pixel near the centre and their slopes, so that differences of large numbers are taken in float64.
"""

import functools
from collections.abc import Callable

import numpy as np

from minisplat_ref.cpu.compositing.exponential import choose_exponential
from minisplat_ref.cpu.compositing.responses import KernelResponse
from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import load, minimum, select
from minisplat_ref.jit.literals import HALF, ONE, TWO, ZERO
from minisplat_ref.mechanisms.surfels.projection import LOW_PASS, Surfels
from minisplat_ref.mechanisms.surfels.response import Layout
from minisplat_ref.types import Floats, Ints

# Columns of a record; those before REF_X have a derivative.
U, V, W, CENTER_X, CENTER_Y, OPACITY, DEPTH = 0, 3, 6, 9, 10, 11, 12
N_GRADIENTS = DEPTH + 1
REF_X, REF_Y, NEAR, PIVOT, SIZE = range(N_GRADIENTS, N_GRADIENTS + 5)
_LOW_PASS = np.float32(LOW_PASS)
_RHO_MAX = np.float32(1e30)  # of a disc that the ray does not meet
PLANE_MAX = 1e12  # largest entry of T^-1: discs seen more edge-on than that are their low-pass alone


@functools.cache
def depth_shades(layout: tuple[int, int]) -> tuple[Callable, Callable]:
    """Return ``shade`` and ``shade_vjp`` for the channels of a layout, -1 where there is none.

    A place begins with the depth and ends with q_0.
    """
    depth_channel, q_channel = layout

    @scalar
    def shade(colors, n, k, place):
        depth, pivot = place[0], place[-1]
        color = ZERO * depth + colors[n, k]
        if k == depth_channel:
            color = color + depth
        elif k == q_channel:
            color = color + (ONE / depth - pivot)
        elif k == q_channel + 1 and q_channel >= 0:
            q = ONE / depth - pivot
            color = color + q * q
        return color

    @scalar
    def shade_vjp(colors, n, k, place, v):
        """With q = 1 / z - q_0: ``v_z = v_depth - (v_q + 2 q v_qq) / z^2``."""
        depth, pivot = place[0], place[-1]
        w = ONE / depth
        v_z = ZERO * v
        if k == depth_channel:
            v_z = v
        elif k == q_channel:
            v_z = -v * w * w
        elif k == q_channel + 1 and q_channel >= 0:
            v_z = -TWO * (w - pivot) * v * w * w
        return (v,), (v_z,)

    return shade, shade_vjp


def channels_of(layout: Layout) -> tuple[int, int]:
    """Return a layout for kernels: -1 where it has no channel."""
    depth, spread = (-1 if channel is None else channel for channel in layout)
    return depth, spread


@functools.cache
def _surfel_response(exp: Callable, layout: tuple[int, int], has_hit_depths: bool, drops_near_hits: bool):
    @scalar
    def depth_of(is_met, z, center):
        """Return the depth of a hit as lanes."""
        if has_hit_depths:
            z = select(is_met, z, center)
        else:
            z = select(is_met, ZERO * z + center, center)
        return z

    @scalar
    def linear(records, n, k, dx, dy):
        return records[n, k] * dx + records[n, k + 1] * dy + records[n, k + 2]

    @scalar
    def hit(records, n, x, y):
        dx, dy = x - records[n, REF_X], y - records[n, REF_Y]
        w = linear(records, n, W, dx, dy)
        is_crossed = abs(w) > ZERO
        z = ONE / select(is_crossed, w, ONE)
        u, v = linear(records, n, U, dx, dy) * z, linear(records, n, V, dx, dy) * z
        rho_disc = select(is_crossed, minimum(u * u + v * v, _RHO_MAX), _RHO_MAX)
        ox, oy = records[n, CENTER_X] - dx, records[n, CENTER_Y] - dy
        rho_low_pass = _LOW_PASS * (ox * ox + oy * oy)
        is_met = rho_disc <= rho_low_pass
        falloff = exp(-HALF * select(is_met, rho_disc, rho_low_pass))
        if drops_near_hits:
            is_far = (w > ZERO) & (z > records[n, NEAR])
            falloff = select(is_met, select(is_far, falloff, ZERO), falloff)
        depth = depth_of(is_met, z, records[n, DEPTH])
        # Zeros where the low-pass is hit.
        u, v, z = select(is_met, u, ZERO), select(is_met, v, ZERO), select(is_met, z, ZERO)
        return records[n, OPACITY] * falloff, depth, (depth, u, v, z, dx, dy, ox, oy, falloff, records[n, PIVOT])

    @scalar
    def hit_vjp(records, n, place, v_mean, v_shape, v_place):
        """With ``v_rho = -alpha v / 2``: ``v_U = z v_u``, ``v_W = -z (u v_u + v v_v) - z^2 v_z``, times (x, y, 1)."""
        _, u, v, z, dx, dy, ox, oy, falloff, _ = place
        v_z = load(v_place, 0)
        v_rho = -HALF * records[n, OPACITY] * falloff * v_mean
        v_u, v_v = TWO * v_rho * u, TWO * v_rho * v
        v_U, v_V, v_W = z * v_u, z * v_v, -z * (u * v_u + v * v_v)
        v_depth = v_z
        if has_hit_depths:
            v_W = v_W - z * z * v_z
            v_depth = select(abs(z) > ZERO, ZERO, v_z)
        to_center = select(abs(z) > ZERO, ZERO, TWO * _LOW_PASS * v_rho)
        return (
            *(v_U * dx, v_U * dy, v_U, v_V * dx, v_V * dy, v_V, v_W * dx, v_W * dy, v_W),
            *(to_center * ox, to_center * oy, falloff * v_shape, v_depth),
        )

    shade, shade_vjp = depth_shades(layout)
    return KernelResponse(
        _records, _records_vjp, _boxes, hit, hit_vjp, N_GRADIENTS, shade, shade_vjp, n_coefficients=1, n_places=1
    )


def response_for(dtype: np.dtype, surfels: Surfels, layout: Layout) -> KernelResponse:
    """Return the response for arrays of a dtype: float32 data use the polynomial exponential."""
    rules = surfels.rules
    return _surfel_response(choose_exponential(dtype), channels_of(layout), rules.has_hit_depths, rules.drops_near_hits)


def _planes(surfels: Surfels) -> tuple[Floats, Floats]:
    """Return pixels r near the centres [N, 2], and the inverses [N, 3, 3] of T with its rows moved by r.

    The inverse is the matrix of cofactors over the determinant; it is 0 where a disc is seen from its edge, which then
    is met nowhere.
    """
    r = np.clip(np.rint(surfels.means2d), -1e9, 1e9)
    moved = _moved(surfels.transforms, r)
    M_u, M_v, M_w = moved[:, 0], moved[:, 1], moved[:, 2]
    cofactors = np.stack([np.cross(M_v, M_w), np.cross(M_w, M_u), np.cross(M_u, M_v)], axis=2)
    det = np.sum(M_u * np.cross(M_v, M_w), axis=1)[:, None, None]
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        planes = cofactors / det
        return r, np.where((np.abs(planes) < PLANE_MAX).all(axis=(1, 2), keepdims=True), planes, 0)


def _moved(T: Floats, r: Floats) -> Floats:
    """Return T of pixels relative to r: ``M_u - r_x M_w, M_v - r_y M_w, M_w``."""
    return np.concatenate([T[:, :2] - r[:, :, None] * T[:, 2:], T[:, 2:]], axis=1)


def _records(surfels: Surfels, dtype: np.dtype) -> Floats:
    r, planes = _planes(surfels)
    records = np.empty((len(r), SIZE), dtype)
    records[:, :CENTER_X] = planes.reshape(-1, 9)
    records[:, CENTER_X : CENTER_Y + 1] = surfels.means2d - r
    records[:, OPACITY], records[:, DEPTH] = surfels.opacities, surfels.depths  # of the centres
    records[:, REF_X : REF_Y + 1], records[:, NEAR], records[:, PIVOT] = r, surfels.near_plane, surfels.pivot
    return records


def _records_vjp(surfels: Surfels, v_records: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Gradient with respect to transforms, means2d, opacities and depths.

    With ``P = T'^-1``, ``dP = -P dT' P``::

        v_T' = -P^T v_P P^T,   v_M_u = v_M'_u,   v_M_v = v_M'_v,   v_M_w = v_M'_w - r_x v_M'_u - r_y v_M'_v
    """
    r, planes = _planes(surfels)
    inverse = np.swapaxes(planes, 1, 2)
    v_T = -inverse @ v_records[:, :CENTER_X].reshape(-1, 3, 3) @ inverse
    v_T[:, 2] -= np.einsum("nk,nkj->nj", r, v_T[:, :2])
    v_depths = v_records[:, DEPTH]
    if surfels.rules.has_hit_depths:  # then the depth of the centre is the corner of T
        v_T[:, 2, 2] += v_depths
        v_depths = np.zeros_like(v_depths)
    return v_T, v_records[:, CENTER_X : CENTER_Y + 1], v_records[:, OPACITY], v_depths


def _boxes(surfels: Surfels) -> Ints:
    return surfels.boxes
