"""Surfels on lanes: a response for the plain kernels, stated without the planes of the reference.

The map from the disc to the pixel, ``T (u, v, 1)^T = z (x, y, 1)^T``, is inverted once for each surfel instead of being
intersected with two planes for each pixel::

    (u, v, 1) / z = T^-1 (x, y, 1)^T

These are three linear functions of the pixel, U, V and W, and the depth of the hit is z = 1 / W.
:mod:`.record_kernels` computes them.
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
from minisplat_ref.mechanisms.surfels.record_kernels import (
    CENTER_X,
    CENTER_Y,
    DEPTH,
    N_GRADIENTS,
    NEAR,
    OPACITY,
    PIVOT,
    REF_X,
    REF_Y,
    U,
    V,
    W,
    records_of,
    records_of_vjp,
)
from minisplat_ref.mechanisms.surfels.response import Layout
from minisplat_ref.types import Ints

_LOW_PASS = np.float32(LOW_PASS)
_RHO_MAX = np.float32(1e30)  # of a disc that the ray does not meet


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
        records_of, records_of_vjp, _boxes, hit, hit_vjp, N_GRADIENTS, shade, shade_vjp, n_coefficients=1, n_places=1
    )


def response_for(dtype: np.dtype, surfels: Surfels, layout: Layout) -> KernelResponse:
    """Return the response for arrays of a dtype: float32 data use the polynomial exponential."""
    rules = surfels.rules
    return _surfel_response(choose_exponential(dtype), channels_of(layout), rules.has_hit_depths, rules.drops_near_hits)


def _boxes(surfels: Surfels) -> Ints:
    return surfels.boxes
