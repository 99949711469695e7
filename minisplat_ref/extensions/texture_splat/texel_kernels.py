"""Texels of all visible surfels of a view, forward and backward: the loops around the formulas of one texel.

The functions have the names and the arguments of their counterparts in :mod:`.model`, and :mod:`.textures` states the
formula of normals. Here tanh and sigmoid are one function, ``tanh(x) = 2 s(2 x) - 1``, so that a texel takes seven
exponentials and no other function. For float32 data they are those of the blend, a polynomial. Eight surfels are
processed together, all other arithmetic is float64 whatever the data, and the sums of the camera's gradient have a
fixed order.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from minisplat_ref.cpu.compositing.exponential import choose_exponential
from minisplat_ref.cpu.gaussian_rows import (
    DOUBLE,
    add,
    contiguous,
    gather_wide,
    list_visible,
    load_rows,
    quaternion,
    scatter_triple,
    sum_parts,
    triple,
)
from minisplat_ref.cpu.projection import N_CHUNKS
from minisplat_ref.extensions.texture_splat.textures import N_CHANNELS, TILT_MAX
from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.jit.lanes import WIDTH, broadcast, cast, gather, iota, minimum, scatter, select, sqrt
from minisplat_ref.jit.literals import FOUR, ONE, TWO, ZERO
from minisplat_ref.mechanisms.gbuffer.renderer import MaterialGradient
from minisplat_ref.mechanisms.surfels.formulas import add_triples
from minisplat_ref.mechanisms.surfels.renderer import Seen
from minisplat_ref.scalar.projection import axes, axes_vjp, dot, matmul3, matrix_rows, transpose3
from minisplat_ref.types import Floats, Ints


class _Discs(NamedTuple):
    """The discs of a view."""

    quats: Floats  # [N, 4]
    normals: Floats  # [N, 3] camera frame, towards the camera
    radii: Ints  # [N, 2]
    R: Floats  # [3, 3] cam_from_world, float64


class _Textures(NamedTuple):
    """The textures of a population."""

    normal_textures: Floats  # [N, 2 T^2]
    albedo_logits: Floats  # [N, 3 T^2]
    metallic_logits: Floats  # [N, T^2]
    roughness_logits: Floats  # [N, T^2]


class _Gradient(NamedTuple):
    """The gradient with respect to textures and quaternions."""

    normal_textures: Floats
    albedo_logits: Floats
    metallic_logits: Floats
    roughness_logits: Floats
    quats: Floats


@scalar
def _list_chunk(chunk, radii):
    """Return the visible surfels of a chunk, and their number."""
    first, end = radii.shape[0] * chunk // N_CHUNKS, radii.shape[0] * (chunk + 1) // N_CHUNKS
    rows = np.empty(end - first + WIDTH, np.int64)
    return rows, list_visible(radii, first, end, rows)


@scalar
def _turn_disc(discs, rows):
    """Return the axes of eight discs by columns, in the world and in the camera's frame, and the signs of normals."""
    one = broadcast(DOUBLE) + ONE
    r = axes(quaternion(discs.quats, rows), (one, one, one))
    a = matmul3(matrix_rows(discs.R), r)
    return r, a, select(dot((a[0][2], a[1][2], a[2][2]), triple(discs.normals, rows)) > ZERO, one, -one)


@scalar
def _scale(factor, a):
    return factor * a[0], factor * a[1], factor * a[2]


@scalar
def _height(x, y):
    """Return z of the normal with the tilts x and y."""
    return sqrt(ONE - minimum(x * x + y * y, TILT_MAX))


@scalar
def _add_outer(M, a, b):
    """Return the matrix M + a b^T by rows."""
    return (
        add_triples(M[0], _scale(a[0], b)),
        add_triples(M[1], _scale(a[1], b)),
        add_triples(M[2], _scale(a[2], b)),
    )


@scalar
def _add_product_row(sums, first, is_counted, a, R):
    """Add row a of A to sums of A R^T."""
    add(sums, first, is_counted, dot(a, R[0]))
    add(sums, first + 1, is_counted, dot(a, R[1]))
    add(sums, first + 2, is_counted, dot(a, R[2]))


@functools.cache
def texel_kernels(exp: Callable) -> tuple[Callable, Callable]:
    """Compile the kernels of :func:`read_textures` and its gradient for an exponential of numbers up to 0."""

    @scalar
    def logistic(x):
        """Return ``s = 1 / (1 + exp(-x))``, by ``exp(-|x|)``, and its derivative ``s (1 - s)``, in float64."""
        e = cast(exp(-abs(x)), DOUBLE)
        tail = ONE / (ONE + e)
        return select(x > ZERO, tail, e * tail), e * tail * tail

    @scalar
    def tilt(raw):
        """Return ``tanh(raw)`` and its derivative ``1 - tanh(raw)^2``."""
        s, slope = logistic(TWO * raw)
        return TWO * s - ONE, FOUR * slope

    @scalar
    def read_eight(rows, discs, textures, texels):
        _, a, side = _turn_disc(discs, rows)
        a = _scale(side, a[0]), _scale(side, a[1]), _scale(side, a[2])
        for t in range(texels.shape[1]):
            x, _ = tilt(gather(textures.normal_textures, rows, 2 * t))
            y, _ = tilt(gather(textures.normal_textures, rows, 2 * t + 1))
            tangent = x, y, _height(x, y)
            red, _ = logistic(gather(textures.albedo_logits, rows, 3 * t))
            green, _ = logistic(gather(textures.albedo_logits, rows, 3 * t + 1))
            blue, _ = logistic(gather(textures.albedo_logits, rows, 3 * t + 2))
            metallic, _ = logistic(gather(textures.metallic_logits, rows, t))
            roughness, _ = logistic(gather(textures.roughness_logits, rows, t))
            normal = dot(a[0], tangent), dot(a[1], tangent), dot(a[2], tangent)
            scatter(texels, rows, t * N_CHANNELS, (*normal, red, green, blue, metallic, roughness))

    @scalar
    def logits_vjp(v_logits, logits, rows, column, v_share):
        _, slope = logistic(gather(logits, rows, column))
        scatter(v_logits, rows, column, slope * v_share)

    @scalar
    def read_eight_vjp(rows, is_counted, discs, textures, v_texels, v, v_R):
        r, a, side = _turn_disc(discs, rows)
        a_transposed, zero = transpose3(a), broadcast(DOUBLE)
        v_a = (zero, zero, zero), (zero, zero, zero), (zero, zero, zero)
        for t in range(v_texels.shape[1]):
            at = t * N_CHANNELS
            n_0, n_1 = gather_wide(v_texels, rows, at), gather_wide(v_texels, rows, at + 1)
            v_n = _scale(side, (n_0, n_1, gather_wide(v_texels, rows, at + 2)))
            x, slope_x = tilt(gather(textures.normal_textures, rows, 2 * t))
            y, slope_y = tilt(gather(textures.normal_textures, rows, 2 * t + 1))
            z = _height(x, y)
            along_z = select(x * x + y * y < TILT_MAX, dot(a_transposed[2], v_n) / z, ZERO)
            scatter(v.normal_textures, rows, 2 * t, slope_x * (dot(a_transposed[0], v_n) - x * along_z))
            scatter(v.normal_textures, rows, 2 * t + 1, slope_y * (dot(a_transposed[1], v_n) - y * along_z))
            v_a = _add_outer(v_a, v_n, (x, y, z))
            for k in range(3):
                v_share = gather_wide(v_texels, rows, at + 3 + k)
                logits_vjp(v.albedo_logits, textures.albedo_logits, rows, 3 * t + k, v_share)
            logits_vjp(v.metallic_logits, textures.metallic_logits, rows, t, gather_wide(v_texels, rows, at + 6))
            logits_vjp(v.roughness_logits, textures.roughness_logits, rows, t, gather_wide(v_texels, rows, at + 7))
        one = zero + ONE
        v_r = matmul3(transpose3(matrix_rows(discs.R)), v_a)
        v_quat, _ = axes_vjp(quaternion(discs.quats, rows), (one, one, one), v_r)
        scatter_triple(v.quats, rows, v_quat)
        scatter(v.quats, rows, 3, v_quat[3])
        _add_product_row(v_R, 0, is_counted, v_a[0], r)
        _add_product_row(v_R, 3, is_counted, v_a[1], r)
        _add_product_row(v_R, 6, is_counted, v_a[2], r)

    @scalar
    def read_chunk(chunk, discs, textures, texels):
        rows, count = _list_chunk(chunk, discs.radii)
        for i in range(0, count, WIDTH):
            read_eight(load_rows(rows, i), discs, textures, texels)

    @scalar
    def read_chunk_vjp(chunk, discs, textures, v_texels, v, v_Rs):
        rows, count = _list_chunk(chunk, discs.radii)
        v_Rs[chunk] = ZERO
        for i in range(0, count, WIDTH):
            is_counted = iota(DOUBLE) < count - i
            read_eight_vjp(load_rows(rows, i), is_counted, discs, textures, v_texels, v, v_Rs[chunk])

    @kernel()
    def read(
        discs,  # _Discs
        textures,  # _Textures
        texels,  # [N, T^2, 8]
    ):
        for chunk in prange(N_CHUNKS):
            read_chunk(chunk, discs, textures, texels)

    @kernel()
    def read_vjp(
        discs,  # _Discs
        textures,  # _Textures
        v_texels,  # [N, T^2, 8]
        v,  # _Gradient
    ):
        v_Rs = np.empty((N_CHUNKS, 9 * WIDTH), np.float64)
        for chunk in prange(N_CHUNKS):
            read_chunk_vjp(chunk, discs, textures, v_texels, v, v_Rs)
        return sum_parts(v_Rs)

    return read, read_vjp


def read_textures(seen: Seen) -> Floats:
    """Return the texels of all visible surfels; see :func:`.model.read_textures`."""
    dtype = seen.gaussians.means.dtype
    textures = _pack_textures(seen)
    texels = np.zeros((*textures.metallic_logits.shape, N_CHANNELS), dtype)
    read, _ = texel_kernels(choose_exponential(dtype))
    read(_pack_discs(seen), textures, texels)
    return texels


def read_textures_vjp(seen: Seen, v_texels: Floats) -> MaterialGradient:
    """Gradient of :func:`read_textures`; see :func:`.model.read_textures_vjp`."""
    dtype = seen.gaussians.means.dtype
    textures = _pack_textures(seen)
    v = _Gradient(*(np.zeros(field.shape, dtype) for field in (*textures, seen.primitives.quats)))
    _, read_vjp = texel_kernels(choose_exponential(dtype))
    v_R = read_vjp(_pack_discs(seen), textures, np.ascontiguousarray(v_texels, dtype), v)
    return MaterialGradient({name: getattr(v, name) for name in _Textures._fields}, v.quats, v_R.reshape(3, 3))


def _pack_discs(seen: Seen) -> _Discs:
    quats, normals, R = contiguous(seen.primitives.quats, seen.surfels.normals, seen.camera.cam_from_world_R)
    return _Discs(quats, normals, np.ascontiguousarray(seen.surfels.radii), R.astype(np.float64))


def _pack_textures(seen: Seen) -> _Textures:
    return _Textures(*contiguous(*(getattr(seen.gaussians, name) for name in _Textures._fields)))
