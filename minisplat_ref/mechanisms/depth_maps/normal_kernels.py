"""Normals of a depth map and their gradient: the loops over the pixels; :mod:`.normals` states the equations.

The gradient of a pixel's normal reaches its four neighbours. Each pixel first stores what it has for them, and then
collects what they have for it, so that no two threads write to one number and every sum has one order.
"""

import math

import numpy as np

from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.jit.literals import ZERO
from minisplat_ref.mechanisms.depth_maps.normals import LENGTH_MIN
from minisplat_ref.scalar.projection import cross, dot
from minisplat_ref.types import Camera, Floats

DOWN, UP, RIGHT, LEFT, N_NEIGHBOURS = range(5)


@scalar
def _differences(depth, s, t, x, y):
    """Return a and b of pixel (x, y), for the slopes s [W] and t [H] of the rays (s, t, 1)."""
    down, up, right, left = depth[y + 1, x], depth[y - 1, x], depth[y, x + 1], depth[y, x - 1]
    a = s[x] * (down - up), t[y + 1] * down - t[y - 1] * up, down - up
    b = s[x + 1] * right - s[x - 1] * left, t[y] * (right - left), right - left
    return a, b


@scalar
def _divisor(N, length_min):
    """Return the length of N, or the least by which N is divided."""
    return max(math.sqrt(dot(N, N)), length_min)


@scalar
def _write_line(y, depth, s, t, length_min, normals):
    for x in range(1, depth.shape[1] - 1):
        a, b = _differences(depth, s, t, x, y)
        N = cross(a, b)
        length = _divisor(N, length_min)
        for k in range(3):
            normals[y, x, k] = N[k] / length


@kernel()
def _write_normals(depth, s, t, length_min, normals):
    for y in prange(depth.shape[0]):
        if 0 < y and y < depth.shape[0] - 1:
            _write_line(y, depth, s, t, length_min, normals)


def central_normals(depth: Floats, camera: Camera) -> Floats:
    """Return the normals of the surface through a depth map; see :func:`.normals.central_normals`."""
    normals = np.zeros((*depth.shape, 3), depth.dtype)
    _write_normals(np.ascontiguousarray(depth), *_slopes(depth, camera), depth.dtype.type(LENGTH_MIN), normals)
    return normals


def _slopes(depth: Floats, camera: Camera) -> tuple[Floats, Floats]:
    """Return s [W] and t [H] in the dtype of the depths."""
    height, width = depth.shape
    s = (np.arange(width) + 0.5 - camera.cx) / camera.fx
    t = (np.arange(height) + 0.5 - camera.cy) / camera.fy
    return s.astype(depth.dtype), t.astype(depth.dtype)


@scalar
def _write_line_vjp(y, depth, s, t, length_min, v_normals, shares):
    for x in range(1, depth.shape[1] - 1):
        a, b = _differences(depth, s, t, x, y)
        N = cross(a, b)
        length = _divisor(N, length_min)
        v = v_normals[y, x, 0], v_normals[y, x, 1], v_normals[y, x, 2]
        along = ZERO * length
        if length > length_min:
            along = dot(N, v) / (length * length)
        v_N = (v[0] - along * N[0]) / length, (v[1] - along * N[1]) / length, (v[2] - along * N[2]) / length
        v_a, v_b = cross(b, v_N), cross(v_N, a)
        shares[y, x, DOWN] = s[x] * v_a[0] + t[y + 1] * v_a[1] + v_a[2]
        shares[y, x, UP] = -(s[x] * v_a[0] + t[y - 1] * v_a[1] + v_a[2])
        shares[y, x, RIGHT] = s[x + 1] * v_b[0] + t[y] * v_b[1] + v_b[2]
        shares[y, x, LEFT] = -(s[x - 1] * v_b[0] + t[y] * v_b[1] + v_b[2])


@scalar
def _collect_line(y, shares, v_depth):
    height, width = v_depth.shape
    for x in range(width):
        v = ZERO * shares[y, x, DOWN]
        if y > 0:
            v += shares[y - 1, x, DOWN]
        if y < height - 1:
            v += shares[y + 1, x, UP]
        if x > 0:
            v += shares[y, x - 1, RIGHT]
        if x < width - 1:
            v += shares[y, x + 1, LEFT]
        v_depth[y, x] = v


@kernel()
def _write_normals_vjp(depth, s, t, length_min, v_normals, shares, v_depth):
    for y in prange(depth.shape[0]):
        if 0 < y and y < depth.shape[0] - 1:
            _write_line_vjp(y, depth, s, t, length_min, v_normals, shares)
    for y in prange(depth.shape[0]):
        _collect_line(y, shares, v_depth)


def central_normals_vjp(depth: Floats, camera: Camera, v_normals: Floats) -> Floats:
    """Gradient [H, W] of :func:`central_normals`; see :func:`.normals.central_normals_vjp`."""
    shares, v_depth = np.zeros((*depth.shape, N_NEIGHBOURS), depth.dtype), np.empty_like(depth)
    tables = np.ascontiguousarray(depth), *_slopes(depth, camera), depth.dtype.type(LENGTH_MIN)
    _write_normals_vjp(*tables, np.ascontiguousarray(v_normals, depth.dtype), shares, v_depth)
    return v_depth
