"""3D Gaussians hit by rays on lanes: a response for the plain kernels, stated by differences of directions.

``b - t a`` is a difference of numbers as large as the distance in standard deviations. Here the ray is compared with
the unit vector ``n = x / r`` to the mean instead, ``r = |x|``: with ``G = r M``, ``h = G n`` and the difference
``e = d - n``, which is exact where they are close::

    g = G e,   a = g + h,   c = a . g / a . a,   p = c a - g,   t = r (1 - c)

so float32 loses no more than the direction's last digit, however thin or far away a Gaussian is.
"""

import functools
from collections.abc import Callable

import numpy as np

from minisplat_ref.cpu.compositing.exponential import choose_exponential
from minisplat_ref.cpu.compositing.responses import KernelResponse
from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import maximum, select
from minisplat_ref.jit.literals import HALF, ONE, ZERO
from minisplat_ref.mechanisms.cameras.ray_footprints import LensFootprints, boxes_of
from minisplat_ref.mechanisms.cameras.record_kernels import (
    AHEAD,
    DEPTH,
    N_GRADIENTS,
    NORMAL,
    OPACITY,
    WHITE,
    records_of,
    records_of_vjp,
)
from minisplat_ref.types import Floats

_TINY = np.float32(1e-30)  # of a . a where a Gaussian is culled


@functools.cache
def lens_response(exp: Callable) -> KernelResponse:
    """Return the response with an exponential of :mod:`minisplat_ref.cpu.compositing.exponential`."""

    @scalar
    def white(records, n, k, e):
        """Return component k of G e."""
        first = WHITE + 3 * k
        return records[n, first] * e[0] + records[n, first + 1] * e[1] + records[n, first + 2] * e[2]

    @scalar
    def hit(records, n, ray, y):
        e = ray[0] - records[n, NORMAL], ray[1] - records[n, NORMAL + 1], ray[2] - records[n, NORMAL + 2]
        g0, g1, g2 = white(records, n, 0, e), white(records, n, 1, e), white(records, n, 2, e)
        h0, h1, h2 = records[n, AHEAD], records[n, AHEAD + 1], records[n, AHEAD + 2]
        a0, a1, a2 = g0 + h0, g1 + h1, g2 + h2
        inverse = ONE / maximum(a0 * a0 + a1 * a1 + a2 * a2, _TINY)
        c = (a0 * g0 + a1 * g1 + a2 * g2) * inverse
        p0, p1, p2 = c * a0 - g0, c * a1 - g1, c * a2 - g2
        falloff = select(c < ONE, exp(-HALF * (p0 * p0 + p1 * p1 + p2 * p2)), ZERO)
        away = c * ray[0] - e[0], c * ray[1] - e[1], c * ray[2] - e[2]  # (x - t d) / r
        return records[n, OPACITY] * falloff, records[n, DEPTH], (p0, p1, p2, away, falloff)

    @scalar
    def hit_vjp(records, n, place, v_mean, v_shape, v_place):
        """With ``q = -alpha v_alpha``: the sums of ``q p`` and of ``q p (x - t d)^T / r``."""
        p0, p1, p2, (x, y, z), falloff = place
        alpha = records[n, OPACITY] * falloff
        m, q = -alpha * v_mean, -alpha * v_shape
        q0, q1, q2 = q * p0, q * p1, q * p2
        of_shape = q0 * x, q0 * y, q0 * z, q1 * x, q1 * y, q1 * z, q2 * x, q2 * y, q2 * z
        return (falloff * v_shape, m * p0, m * p1, m * p2) + of_shape  # noqa: RUF005  (Numba unpacks no tuple here)

    return KernelResponse(records_of, records_of_vjp, boxes_of, hit, hit_vjp, N_GRADIENTS, rays=_rays)


def response_for(dtype: np.dtype) -> KernelResponse:
    """Return the response for arrays of a dtype: float32 data use the polynomial exponential."""
    return lens_response(choose_exponential(dtype))


def _rays(footprints: LensFootprints, dtype: np.dtype) -> Floats:
    return np.ascontiguousarray(footprints.rays, dtype)
