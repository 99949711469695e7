"""Textured Gaussians on lanes: a response for the plain kernels.

With the frame in units of its distance, ``a^ = a / |a|``, ``D = A_xy / |a|`` and ``C = a^ x A_xy`` by columns, and the
pixel's offset d = x - p, the ray and the nearest point are ``b = a^ + D d`` and ``q = (C d) x b / b^2``. These numbers
are of order one in float32, however thin or far away a Gaussian is.

Textures have 15 coefficients here; those of a lower degree are padded with zeros.
"""

import functools
from collections.abc import Callable

import numpy as np

from minisplat_ref.constants import SH_C0, SH_C1, SH_C2, SH_C3
from minisplat_ref.cpu.compositing.exponential import choose_exponential
from minisplat_ref.cpu.compositing.responses import CONIC_GRADIENTS, MEAN_X, OPACITY, KernelResponse, conic_response
from minisplat_ref.extensions.textured.formulas import (
    dot_5,
    dot_7,
    load_3,
    load_5,
    load_7,
    plus_3,
    plus_5,
    plus_7,
    row_3,
    row_5,
    row_7,
    times_3,
    times_5,
    times_7,
)
from minisplat_ref.extensions.textured.model import LIMB, TexturedFootprints, bounds
from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import maximum, minimum, select, sqrt
from minisplat_ref.jit.literals import HALF, ONE, TWO, ZERO
from minisplat_ref.mechanisms.payload.footprints import boxes_of
from minisplat_ref.scalar.projection import cross, dot
from minisplat_ref.scalar.spherical_harmonics import basis_1, basis_1_vjp, basis_2, basis_2_vjp, basis_3, basis_3_vjp
from minisplat_ref.types import Floats

N_TEXTURE = 15  # coefficients of degree 1 to 3
LOGIT, H = CONIC_GRADIENTS, CONIC_GRADIENTS + 1
A, D_X, D_Y, C_X, C_Y = range(H + N_TEXTURE, H + N_TEXTURE + 15, 3)
SHIFT = C_Y + 3  # of the texture by the centre's pixel: two gradients, no numbers
N_GRADIENTS = SHIFT + 2
DEPTH, ODDS, BOUND = range(N_GRADIENTS, N_GRADIENTS + 3)
ODDS_MAX = 1e30  # so that a product with it stays finite in float32


@functools.cache
def make_textured_response(exp: Callable, constants: tuple) -> KernelResponse:
    """Return the response of textured Gaussians; ``constants`` are those of the harmonics, then LIMB^2."""
    conic = conic_response(exp)
    flat_hit, flat_hit_vjp = conic.hit, conic.hit_vjp
    limb_squared = constants[-1]

    @scalar
    def ray(records, n, dx, dy):
        """Return b, q and ``1 / b^2`` of the pixel at d from the centre, and ``c = C d``."""
        along = plus_3(times_3(dx, row_3(records, n, D_X)), times_3(dy, row_3(records, n, D_Y)))
        b = plus_3(row_3(records, n, A), along)
        c = plus_3(times_3(dx, row_3(records, n, C_X)), times_3(dy, row_3(records, n, C_Y)))
        inverse = ONE / dot(b, b)
        return b, times_3(inverse, cross(c, b)), inverse, c

    @scalar
    def direction(b, q, inverse):
        """Return n, the unit vector u along b, g and ``1 / l^2``."""
        h = dot(q, q)
        g, u = sqrt(maximum(ONE - h, limb_squared)), times_3(sqrt(inverse), b)
        shrink = ONE / maximum(h + limb_squared, ONE)
        return times_3(sqrt(shrink), plus_3(q, times_3(-g, u))), u, g, shrink

    @scalar
    def texture(table, n, k, Y1, Y2, Y3):
        """Return the sum of the harmonics with the 15 coefficients of row n from column k on."""
        return dot(row_3(table, n, k), Y1) + dot_5(row_5(table, n, k + 3), Y2) + dot_7(row_7(table, n, k + 8), Y3)

    @scalar
    def hit(records, n, x, y):
        flat, _, (e, dy, falloff) = flat_hit(records, n, x, y)
        dx = x - records[n, MEAN_X]
        b, q, inverse, _ = ray(records, n, dx, -dy)
        v, _, _, _ = direction(b, q, inverse)
        Y1 = basis_1(v[0], v[1], v[2], constants)
        Y2, Y3 = basis_2(v[0], v[1], v[2], constants), basis_3(v[0], v[1], v[2], constants)
        raised, odds = exp(minimum(texture(records, n, H, Y1, Y2, Y3) - records[n, BOUND], ZERO)), records[n, ODDS]
        share, transparency = raised * (ONE + odds) / (raised + odds), odds / (raised + odds)
        return flat * share, records[n, DEPTH], (Y1, Y2, Y3, dx, (e, dy, falloff), share, transparency)

    @scalar
    def hit_vjp(records, n, place, v_mean, v_shape, v_place):
        """Differentiate from alpha to x, from the Y_k to n, and from n to b and ``c = C d``, as the reference does."""
        Y1, Y2, Y3, dx, flat, share, transparency = place
        dy, falloff = -flat[1], flat[2]
        v_flat = flat_hit_vjp(records, n, flat, share * v_mean, share * v_shape, v_place)
        v_x = v_shape * records[n, OPACITY] * falloff * share * transparency

        b, q, inverse, c = ray(records, n, dx, dy)
        v, u, g, shrink = direction(b, q, inverse)
        v_Y1 = plus_3(times_3(v_x, row_3(records, n, H)), load_3(v_place, 0))
        v_Y2 = plus_5(times_5(v_x, row_5(records, n, H + 3)), load_5(v_place, 3))
        v_Y3 = plus_7(times_7(v_x, row_7(records, n, H + 8)), load_7(v_place, 8))
        v_n = plus_3(basis_1_vjp(constants, v_Y1), basis_2_vjp(v[0], v[1], v[2], constants, v_Y2))
        v_n = plus_3(v_n, basis_3_vjp(v[0], v[1], v[2], constants, v_Y3))

        v_r = times_3(sqrt(shrink), v_n)
        v_u = times_3(-g, v_r)
        is_round = ONE - dot(q, q) > limb_squared
        v_h = HALF * select(is_round, dot(u, v_r) / g, -shrink * dot(v, v_n))
        v_q = plus_3(v_r, times_3(TWO * v_h, q))
        v_c = times_3(inverse, cross(b, v_q))
        v_b = times_3(inverse, plus_3(cross(v_q, c), times_3(-TWO * dot(q, v_q), b)))
        v_b = plus_3(v_b, times_3(sqrt(inverse), plus_3(v_u, times_3(-dot(u, v_u), u))))
        v_shift_x = -dot(row_3(records, n, D_X), v_b) - dot(row_3(records, n, C_X), v_c)
        v_shift_y = -dot(row_3(records, n, D_Y), v_b) - dot(row_3(records, n, C_Y), v_c)
        v_texture = (v_x,) + times_3(v_x, Y1) + times_5(v_x, Y2) + times_7(v_x, Y3)  # noqa: RUF005
        v_ray = v_b + times_3(dx, v_b) + times_3(dy, v_b) + times_3(dx, v_c) + times_3(dy, v_c)
        return v_flat + v_texture + v_ray + (v_shift_x, v_shift_y)

    @scalar
    def shade(colors, n, k, place):
        first = k * (1 + N_TEXTURE)
        return maximum(colors[n, first] + texture(colors, n, first + 1, place[0], place[1], place[2]), ZERO)

    @scalar
    def shade_vjp(colors, n, k, place, v):
        first, (Y1, Y2, Y3) = k * (1 + N_TEXTURE), (place[0], place[1], place[2])
        unclamped = colors[n, first] + texture(colors, n, first + 1, Y1, Y2, Y3)
        v = select(unclamped >= ZERO, v, ZERO)
        v_coefficients = (v,) + times_3(v, Y1) + times_5(v, Y2) + times_7(v, Y3)  # noqa: RUF005
        v_place = times_3(v, row_3(colors, n, first + 1)) + times_5(v, row_5(colors, n, first + 4))
        return v_coefficients, v_place + times_7(v, row_7(colors, n, first + 9))

    return KernelResponse(
        functools.partial(_records, conic.records),
        functools.partial(_records_vjp, conic.records_vjp),
        boxes_of,
        hit,
        hit_vjp,
        N_GRADIENTS,
        shade,
        shade_vjp,
        n_coefficients=1 + N_TEXTURE,
        n_places=N_TEXTURE,
    )


def make_response(dtype: np.dtype) -> KernelResponse:
    """Return the response for arrays of a dtype: float32 data use the polynomial exponential."""
    constants = (SH_C0, SH_C1, *SH_C2, *SH_C3, LIMB**2)
    as_data = np.dtype(dtype).type
    return make_textured_response(choose_exponential(dtype), tuple(map(as_data, constants)))


def pad_textures(textures: Floats, n_rows: int) -> Floats:
    """Return coefficients [N, n_rows (K-1)] of any degree padded with zeros to [N, n_rows, 15]."""
    n, k = len(textures), textures.shape[1] // n_rows
    full = np.zeros((n, n_rows, N_TEXTURE), textures.dtype)
    full[:, :, :k] = textures.reshape(n, n_rows, k)
    return full


def _units(footprints: TexturedFootprints) -> tuple[Floats, Floats, Floats, Floats]:
    """Return a [N, 3], its length [N, 1], and D and C [N, 3, 2], in float64."""
    frames, p = footprints.frames.astype(np.float64), footprints.means2d.astype(np.float64)
    a = np.einsum("nij,nj->ni", frames[:, :, :2], p) + frames[:, :, 2]
    length = np.linalg.norm(a, axis=1, keepdims=True)
    C = np.cross(a[:, :, None] / length[:, :, None], frames[:, :, :2], axis=1)
    return a, length, frames[:, :, :2] / length[:, :, None], C


def _records(conic_records: Callable, footprints: TexturedFootprints, dtype: np.dtype) -> Floats:
    a, length, D, C = _units(footprints)
    records = np.zeros((len(a), BOUND + 1), dtype)
    records[:, :CONIC_GRADIENTS] = conic_records(footprints.projection, dtype)[:, :CONIC_GRADIENTS]
    records[:, LOGIT] = footprints.logits
    records[:, H : H + N_TEXTURE] = pad_textures(footprints.opacity_textures, 1)[:, 0]
    records[:, A : A + 3], records[:, D_X : D_X + 6] = a / length, _flatten_columns(D)
    records[:, C_X : C_X + 6] = _flatten_columns(C)
    records[:, DEPTH], records[:, ODDS] = footprints.projection.depths, np.minimum(footprints.odds, ODDS_MAX)
    records[:, BOUND] = bounds(footprints.opacity_textures)
    return records


def _records_vjp(conic_records_vjp: Callable, footprints: TexturedFootprints, v_records: Floats) -> tuple[Floats, ...]:
    """Gradient with respect to the footprints' ``FIELDS``.

    With ``a^ = a / |a|``, ``D = A_xy / |a|``, ``C = a^ x A_xy``, ``a = A (p, 1)``::

        v_A_xy = v_D / |a| + sum over columns of v_C x a^
        v_a^ += A_x x v_C_x + A_y x v_C_y,   v_a = (v_a^ - a^ (a^ . v_a^) - a^ <D, v_D>) / |a|
        v_A += v_a (p, 1)^T,  v_p = A_xy^T v_a + that of the shift
    """
    v_means2d, v_conics, v_opacities = conic_records_vjp(footprints.projection, v_records)
    n_texture, dtype = footprints.opacity_textures.shape[1], footprints.means2d.dtype
    a, length, D, _ = _units(footprints)
    unit, xy = a / length, footprints.frames[:, :, :2].astype(np.float64)
    v_D, v_C = _split_columns(v_records[:, D_X : D_X + 6]), _split_columns(v_records[:, C_X : C_X + 6])
    v_unit = v_records[:, A : A + 3] + np.cross(xy, v_C, axis=1).sum(axis=2)
    v_a = v_unit - unit * np.sum(unit * v_unit, axis=1, keepdims=True)
    v_a = (v_a - unit * np.einsum("nij,nij->n", D, v_D)[:, None]) / length
    v_frames = np.zeros(footprints.frames.shape)
    v_frames[:, :, :2] = v_D / length[:, :, None] + np.cross(v_C, unit[:, :, None], axis=1)
    v_frames[:, :, :2] += v_a[:, :, None] * footprints.means2d[:, None, :]
    v_frames[:, :, 2] = v_a
    v_shift = v_records[:, SHIFT : SHIFT + 2] + np.einsum("nij,ni->nj", xy, v_a)
    return (
        (v_means2d + v_shift).astype(dtype),
        v_conics,
        v_opacities,
        v_records[:, LOGIT].astype(dtype),
        v_records[:, H : H + n_texture].astype(dtype),
        v_frames.astype(dtype),
    )


def _flatten_columns(matrices: Floats) -> Floats:
    """Return [N, 3, 2] as [N, 6], the first column first."""
    return np.swapaxes(matrices, 1, 2).reshape(-1, 6)


def _split_columns(rows: Floats) -> Floats:
    """Return [N, 6] as [N, 3, 2]: the inverse of :func:`_flatten_columns`."""
    return np.swapaxes(rows.reshape(-1, 2, 3), 1, 2)
