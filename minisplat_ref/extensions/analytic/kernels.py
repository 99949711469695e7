"""The integral over a pixel on lanes: a response for the plain kernels, with the logistic distribution function.

It shares the axes of footprints with the reference; the formulas of a pixel are stated independently.
"""

import functools
from collections.abc import Callable

import numpy as np

from minisplat_ref.cpu.compositing.exponential import choose_exponential
from minisplat_ref.cpu.compositing.responses import KernelResponse
from minisplat_ref.extensions.analytic.response import CUBIC, LINEAR, Axes, axes_of, axes_of_vjp
from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import select
from minisplat_ref.jit.literals import HALF, ONE, ZERO

MEAN_X, MEAN_Y, RATE_1, RATE_2, COS, OPACITY, SIN, MASS, DEPTH = range(9)
N_GRADIENTS = 6  # of which that of COS is with respect to the angle
_LINEAR, _CUBIC = np.float32(LINEAR), np.float32(CUBIC)


@functools.cache
def pixel_response(exp: Callable) -> KernelResponse:
    """Return the response of Gaussians with an exponential of :mod:`minisplat_ref.cpu.compositing.exponential`."""

    @scalar
    def cdf_and_pdf(x):
        """Return ``F(x) = 1 / (1 + exp(-y))`` with ``y = 1.6 x + 0.07 x^3``, by ``exp(-|y|)``, and its derivative."""
        square = x * x
        y = x * (_LINEAR + _CUBIC * square)
        e = exp(-abs(y))
        tail = ONE / (ONE + e)
        return select(y > ZERO, tail, e * tail), e * tail * tail * (_LINEAR + _CUBIC * (square + square + square))

    @scalar
    def integral(u, rate):
        """Return I, and its derivatives with respect to u and the rate."""
        high, high_pdf = cdf_and_pdf((u + HALF) * rate)
        low, low_pdf = cdf_and_pdf((u - HALF) * rate)
        by_rate = (u + HALF) * high_pdf - (u - HALF) * low_pdf
        return high - low, rate * (high_pdf - low_pdf), by_rate

    @scalar
    def hit(records, n, x, y):
        dx, dy = records[n, MEAN_X] - x, records[n, MEAN_Y] - y
        # I is even in u; with u <= 0 both tails are small, so no two numbers near one are subtracted.
        u_1 = records[n, COS] * dx + records[n, SIN] * dy
        u_2 = records[n, COS] * dy - records[n, SIN] * dx
        I_1, by_u_1, by_r_1 = integral(-abs(u_1), records[n, RATE_1])
        I_2, by_u_2, by_r_2 = integral(-abs(u_2), records[n, RATE_2])
        place = u_1, u_2, I_1, I_2, by_u_1, by_u_2, by_r_1, by_r_2
        return records[n, OPACITY] * records[n, MASS] * I_1 * I_2, records[n, DEPTH], place

    @scalar
    def hit_vjp(records, n, place, v_mean, v_shape, v_place):
        """With ``M = 2 pi o / (r_1 r_2)``: v_I_1 = v M I_2, v_r_k -= v alpha / r_k, v_angle = v_u_1 u_2 - v_u_2 u_1."""
        u_1, u_2, I_1, I_2, by_u_1, by_u_2, by_r_1, by_r_2 = place
        mass, cos, sin = records[n, MASS], records[n, COS], records[n, SIN]
        by_u_1, by_u_2 = select(u_1 > ZERO, -by_u_1, by_u_1), select(u_2 > ZERO, -by_u_2, by_u_2)  # odd in u
        M = records[n, OPACITY] * mass
        a_1, a_2, alpha = M * I_2 * by_u_1, M * I_1 * by_u_2, M * I_1 * I_2  # dalpha / du_k
        return (
            v_mean * (a_1 * cos - a_2 * sin),
            v_mean * (a_1 * sin + a_2 * cos),
            v_shape * (M * I_2 * by_r_1 - alpha / records[n, RATE_1]),
            v_shape * (M * I_1 * by_r_2 - alpha / records[n, RATE_2]),
            v_shape * (a_1 * u_2 - a_2 * u_1),
            v_shape * mass * I_1 * I_2,
        )

    return KernelResponse(_records, _records_vjp, _boxes, hit, hit_vjp, n_gradients=N_GRADIENTS)


def response_for(dtype: np.dtype) -> KernelResponse:
    """Return the response for arrays of a dtype: float32 data use the polynomial exponential."""
    return pixel_response(choose_exponential(dtype))


def _records(projection, dtype):
    rates, angles = axes_of(projection.conics)
    records = np.empty((len(angles), DEPTH + 1), dtype)
    records[:, MEAN_X], records[:, MEAN_Y] = projection.means2d.T
    records[:, RATE_1], records[:, RATE_2] = rates.T
    records[:, COS], records[:, SIN] = np.cos(angles), np.sin(angles)
    records[:, MASS] = 2 * np.pi / rates.prod(axis=1)
    records[:, OPACITY], records[:, DEPTH] = projection.opacities, projection.depths
    return records


def _records_vjp(projection, v_records):
    """Gradient with respect to means2d, conics and opacities."""
    v_axes = Axes(v_records[:, [RATE_1, RATE_2]], v_records[:, COS])
    v_conics = axes_of_vjp(projection.conics, axes_of(projection.conics), v_axes)
    dtype = projection.means2d.dtype
    return v_records[:, :RATE_1].astype(dtype), v_conics, v_records[:, OPACITY].astype(dtype)


def _boxes(projection):
    return projection.boxes
