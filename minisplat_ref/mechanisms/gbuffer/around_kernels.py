"""The light that surfels receive from around, as kernels: the functions of :mod:`.around`, which states the equations.

The arithmetic is float64 whatever the data, and the sums of the gradient with respect to R have a fixed order.
"""

import math
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import SH_C0, SH_C1, SH_C2, SH_C3
from minisplat_ref.cpu.gaussian_rows import contiguous
from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.mechanisms.gbuffer.around import AroundGradient, Coefficients, Sight
from minisplat_ref.mechanisms.gbuffer.formulas import load_triple, store_triple, turn, turn_back
from minisplat_ref.scalar.projection import dot
from minisplat_ref.scalar.spherical_harmonics import basis_1, basis_1_vjp, basis_2, basis_2_vjp, basis_3, basis_3_vjp
from minisplat_ref.types import Floats

N_CHUNKS = 32
N_BASES = 16


class _View(NamedTuple):
    """The view of a camera on surfels, and the constants of the harmonics."""

    x: Floats  # [M, 3]
    normals: Floats  # [M, 3]
    R: Floats  # [3, 3] float64
    constants: Floats  # [10] float64


class _Gradient(NamedTuple):
    """The gradient with respect to coefficients, centres and normals, and the sums of that with respect to R."""

    dc: Floats  # [N, 3]
    rest: Floats  # [N, 3 (K - 1)]
    x: Floats  # [M, 3]
    normals: Floats  # [M, 3]
    R: Floats  # [C, 3, 3] float64, by chunk


@scalar
def _reflect(m, view):
    """Return 1 / |x|, d, n and r of a surfel."""
    x, n = load_triple(view.x, m), load_triple(view.normals, m)
    inverse = 1.0 / math.sqrt(dot(x, x))
    d = x[0] * inverse, x[1] * inverse, x[2] * inverse
    twice = 2.0 * dot(d, n)
    return inverse, d, n, (d[0] - twice * n[0], d[1] - twice * n[1], d[2] - twice * n[2])


@scalar
def _fill_bases(w, constants, n_bases, bases):
    bases[0] = constants[0]
    if n_bases > 1:
        bases[1], bases[2], bases[3] = basis_1(w[0], w[1], w[2], constants)
    if n_bases > 4:
        bases[4], bases[5], bases[6], bases[7], bases[8] = basis_2(w[0], w[1], w[2], constants)
    if n_bases > 9:
        third = basis_3(w[0], w[1], w[2], constants)
        bases[9], bases[10], bases[11], bases[12], bases[13], bases[14], bases[15] = third


@scalar
def _sum_channel(bases, coefficients, row, c, n_bases):
    total = bases[0] * coefficients.dc[row, c]
    for k in range(1, n_bases):
        total += bases[k] * coefficients.rest[row, 3 * (k - 1) + c]
    return total


@scalar
def _bases_vjp(w, constants, n_bases, v):
    """Return the gradient with respect to w from that with respect to the bases."""
    v_x, v_y, v_z = 0.0, 0.0, 0.0
    if n_bases > 1:
        v_x, v_y, v_z = basis_1_vjp(constants, (v[1], v[2], v[3]))
    if n_bases > 4:
        x, y, z = basis_2_vjp(w[0], w[1], w[2], constants, (v[4], v[5], v[6], v[7], v[8]))
        v_x, v_y, v_z = v_x + x, v_y + y, v_z + z
    if n_bases > 9:
        third = v[9], v[10], v[11], v[12], v[13], v[14], v[15]
        x, y, z = basis_3_vjp(w[0], w[1], w[2], constants, third)
        v_x, v_y, v_z = v_x + x, v_y + y, v_z + z
    return v_x, v_y, v_z


@scalar
def _coefficients_vjp(row, bases, coefficients, v_light, v):
    """Write the gradient of a surfel's coefficients; replace the bases by the gradient with respect to them."""
    for c in range(3):
        v.dc[row, c] = bases[0] * v_light[c]
    for k in range(1, bases.size):
        first = 3 * (k - 1)
        if first >= coefficients.rest.shape[1]:
            break
        total = 0.0
        for c in range(3):
            total += coefficients.rest[row, first + c] * v_light[c]
            v.rest[row, first + c] = bases[k] * v_light[c]
        bases[k] = total


@scalar
def _light_range(first, end, view, coefficients, light):
    bases, n_bases = np.empty(N_BASES, np.float64), 1 + coefficients.rest.shape[1] // 3
    for m in range(first, end):
        _, _, _, r = _reflect(m, view)
        _fill_bases(turn_back(view.R, r), view.constants, n_bases, bases)
        row = coefficients.rows[m]
        for c in range(3):
            light[m, c] = max(_sum_channel(bases, coefficients, row, c, n_bases), 0.0)


@scalar
def _chain_surfel(m, view, coefficients, v_light, bases, v, v_R):
    n_bases, row = 1 + coefficients.rest.shape[1] // 3, coefficients.rows[m]
    inverse, d, n, r = _reflect(m, view)
    w = turn_back(view.R, r)
    _fill_bases(w, view.constants, n_bases, bases)
    red = v_light[m, 0] if _sum_channel(bases, coefficients, row, 0, n_bases) >= 0.0 else 0.0
    green = v_light[m, 1] if _sum_channel(bases, coefficients, row, 1, n_bases) >= 0.0 else 0.0
    blue = v_light[m, 2] if _sum_channel(bases, coefficients, row, 2, n_bases) >= 0.0 else 0.0
    _coefficients_vjp(row, bases, coefficients, (red, green, blue), v)
    v_w = _bases_vjp(w, view.constants, n_bases, bases)
    for i in range(3):
        v_R[0, i] += r[0] * v_w[i]
        v_R[1, i] += r[1] * v_w[i]
        v_R[2, i] += r[2] * v_w[i]
    v_r = turn(view.R, v_w)
    d_n, n_v = -2.0 * dot(d, n), -2.0 * dot(n, v_r)
    store_triple(v.normals, m, (d_n * v_r[0] + n_v * d[0], d_n * v_r[1] + n_v * d[1], d_n * v_r[2] + n_v * d[2]))
    v_d = v_r[0] + n_v * n[0], v_r[1] + n_v * n[1], v_r[2] + n_v * n[2]
    along = dot(d, v_d)
    v_x = v_d[0] - along * d[0], v_d[1] - along * d[1], v_d[2] - along * d[2]
    store_triple(v.x, m, (inverse * v_x[0], inverse * v_x[1], inverse * v_x[2]))


@scalar
def _chain_range(span, view, coefficients, v_light, v, v_R):
    bases = np.empty(N_BASES, np.float64)
    for m in range(span[0], span[1]):
        _chain_surfel(m, view, coefficients, v_light, bases, v, v_R)


@kernel()
def _light(
    view,  # _View
    coefficients,  # Coefficients
    light,  # [M, 3]
):
    n = coefficients.rows.size
    for chunk in prange(N_CHUNKS):
        _light_range(n * chunk // N_CHUNKS, n * (chunk + 1) // N_CHUNKS, view, coefficients, light)


@kernel()
def _chain(
    view,  # _View
    coefficients,  # Coefficients
    v_light,  # [M, 3]
    v,  # _Gradient
):
    n = coefficients.rows.size
    for chunk in prange(N_CHUNKS):
        span = n * chunk // N_CHUNKS, n * (chunk + 1) // N_CHUNKS
        _chain_range(span, view, coefficients, v_light, v, v.R[chunk])


def light_around(sight: Sight, coefficients: Coefficients) -> Floats:
    """Return the light [M, 3] that surfels receive from around; see :func:`.around.light_around`."""
    light = np.empty_like(sight.x)
    _light(_pack_view(sight), _pack(coefficients), light)
    return light


def light_around_vjp(sight: Sight, coefficients: Coefficients, v_light: Floats) -> AroundGradient:
    """Gradient of :func:`light_around`; see :func:`.around.light_around_vjp`."""
    v = _Gradient(
        np.zeros_like(coefficients.dc),
        np.zeros_like(coefficients.rest),
        np.empty_like(sight.x),
        np.empty_like(sight.x),
        np.zeros((N_CHUNKS, 3, 3)),
    )
    _chain(_pack_view(sight), _pack(coefficients), np.ascontiguousarray(v_light), v)
    return AroundGradient(v.dc, v.rest, v.x, v.normals, v.R.sum(axis=0))


def _pack_view(sight: Sight) -> _View:
    x, normals, R = contiguous(sight.x, sight.normals, sight.R.astype(np.float64))
    return _View(x, normals, R, np.array((SH_C0, SH_C1, *SH_C2, *SH_C3)))


def _pack(coefficients: Coefficients) -> Coefficients:
    dc, rest = contiguous(coefficients.dc, coefficients.rest)
    return Coefficients(dc, rest, coefficients.rows)
