"""Footprints on tangent planes on lanes: a response for the plain kernels, stated without the reference's m, n and K.

A footprint is three linear functions of a pixel, planes through the camera: two numerators whose quotients with the
third are the whitened coordinates u on the tangent plane, with ``K = A^T A``::

    u_k = (a_k . d) / (n . d),   alpha = o exp(-(u_1^2 + u_2^2) / 2)

Each plane is stored by its value at a pixel of the footprint's box and its slopes along x and y, so that differences of
large numbers are taken in float64, before a float32 kernel begins. The three planes M d of the depth are stored in the
same way.
"""

import functools
from collections.abc import Callable

import numpy as np

from minisplat_ref.cpu.compositing.exponential import choose_exponential
from minisplat_ref.cpu.compositing.responses import KernelResponse
from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import maximum, select
from minisplat_ref.jit.literals import HALF, ONE, ZERO
from minisplat_ref.mechanisms.tangent.planes import COSINE_MIN, TangentFootprints, tangent_bases
from minisplat_ref.types import Floats

# Columns of a record, and of its gradient.
OPACITY, REF_X, REF_Y, FIRST, SECOND, COSINE, WHITE, CENTER = 0, 1, 2, 3, 6, 9, 12, 21
V_OPACITY, V_MOVE, V_STRETCH, V_SHAPE, N_GRADIENTS = 0, 1, 3, 5, 8
SIZE = CENTER + 3
_COSINE_MIN, _TINY = np.float32(COSINE_MIN), np.float32(1e-30)


@functools.cache
def tangent_response(exp: Callable) -> KernelResponse:
    """Return the response on tangent planes with an exponential of :mod:`minisplat_ref.cpu.compositing.exponential`."""

    @scalar
    def plane(records, n, k, dx, dy):
        return records[n, k] + (records[n, k + 1] * dx + records[n, k + 2] * dy)

    @scalar
    def hit(records, n, x, y):
        dx, dy = x - records[n, REF_X], y - records[n, REF_Y]
        cosine = plane(records, n, COSINE, dx, dy)
        is_met = cosine > _COSINE_MIN
        inverse = ONE / select(is_met, cosine, ONE)
        u, v = plane(records, n, FIRST, dx, dy) * inverse, plane(records, n, SECOND, dx, dy) * inverse
        falloff = select(is_met, exp(-HALF * (u * u + v * v)), ZERO)
        a, b = plane(records, n, WHITE, dx, dy), plane(records, n, WHITE + 3, dx, dy)
        c = plane(records, n, WHITE + 6, dx, dy)
        along = records[n, CENTER] * a + records[n, CENTER + 1] * b + records[n, CENTER + 2] * c
        return records[n, OPACITY] * falloff, along / maximum(a * a + b * b + c * c, _TINY), (u, v, falloff)

    @scalar
    def hit_vjp(records, n, place, v_mean, v_shape, v_place):
        """Add the moments of ``q = dL/dsigma`` with u, with ``|u|^2 u`` and with ``u u^T``; see ``_records_vjp``."""
        u, v, falloff = place
        alpha = records[n, OPACITY] * falloff
        q, p = -alpha * v_shape, -alpha * v_mean
        s = p * (u * u + v * v)
        return falloff * v_shape, p * u, p * v, s * u, s * v, q * u * u, q * u * v, q * v * v

    return KernelResponse(_records, _records_vjp, _boxes, hit, hit_vjp, n_gradients=N_GRADIENTS)


def response_for(dtype: np.dtype, buffer_size: int) -> KernelResponse:
    """Return the response for arrays of a dtype: float32 data use the polynomial exponential."""
    return tangent_response(choose_exponential(dtype))._replace(buffer_size=buffer_size)


def _numerators(footprints: TangentFootprints) -> tuple[Floats, Floats]:
    """Return A [N, 2, 3] with ``A^T A = K``, and its pseudo-inverse [N, 3, 2].

    K is ``B^T Q B`` on the basis B of the tangent plane; Q = L^T L with ``L = [[sqrt(a), b / sqrt(a)], [0, pivot]]``.
    """
    is_culled = footprints.radii[:, 0] == 0
    normals = footprints.normals + is_culled[:, None] * np.array([0.0, 0.0, 1.0])
    B = tangent_bases(normals)
    Q = B @ footprints.conics @ np.swapaxes(B, 1, 2) + is_culled[:, None, None] * np.eye(2)
    a, b = np.sqrt(Q[:, 0, 0]), Q[:, 0, 1]
    pivot = np.sqrt(np.maximum(Q[:, 1, 1] - b * b / Q[:, 0, 0], 1e-14 * Q[:, 1, 1]))
    zero = np.zeros_like(a)
    L = np.stack([np.stack([a, b / a], -1), np.stack([zero, pivot], -1)], 1)
    inverse = np.stack([np.stack([1 / a, -b / (a * a * pivot)], -1), np.stack([zero, 1 / pivot], -1)], 1)
    return L @ B, np.swapaxes(B, 1, 2) @ inverse


def _records(footprints: TangentFootprints, dtype: np.dtype) -> Floats:
    camera, n = footprints.camera, len(footprints.radii)
    A, _ = _numerators(footprints)
    reference = (footprints.boxes[:, :2] + footprints.boxes[:, 2:]) // 2  # [N, 2] a pixel's corner
    planes = np.concatenate([A, footprints.normals[:, None], footprints.whitenings], axis=1)  # [N, 6, 3] of d
    slopes = planes[:, :, :2] / (camera.fx, camera.fy)
    rays = (reference - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    values = np.einsum("nki,ni->nk", planes[:, :, :2], rays) + planes[:, :, 2]
    records = np.empty((n, SIZE), dtype)
    records[:, OPACITY] = footprints.opacities
    records[:, REF_X : REF_Y + 1] = reference
    records[:, FIRST:CENTER] = np.concatenate([values[:, :, None], slopes], axis=2).reshape(n, CENTER - FIRST)
    records[:, CENTER:] = footprints.centers
    return records


def _records_vjp(footprints: TangentFootprints, v_records: Floats) -> tuple[Floats, Floats, Floats]:
    """Gradient with respect to normals, conics and opacities: ``K m = A^T u``, ``m = A^+ u``."""
    A, inverse = _numerators(footprints)
    moved, stretched = v_records[:, V_MOVE:V_STRETCH], v_records[:, V_STRETCH:V_SHAPE]
    v_normals = -np.einsum("nki,nk->ni", A, moved) - np.einsum("nik,nk->ni", inverse, stretched)
    moments = v_records[:, [V_SHAPE, V_SHAPE + 1, V_SHAPE + 1, V_SHAPE + 2]].reshape(-1, 2, 2)
    return v_normals, inverse @ moments @ np.swapaxes(inverse, 1, 2) / 2, v_records[:, V_OPACITY]


def _boxes(footprints):
    return footprints.boxes
