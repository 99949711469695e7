"""Shading of all surface points, forward and backward: the loops around :mod:`.formulas`.

The functions have the names and the arguments of their counterparts in :mod:`.shading`, which states the equations. The
arithmetic is float64 whatever the data. Points are divided into chunks whose number depends on nothing but the size of
the environment. Each chunk adds to texels of its own, and these sums are added in the order of the chunks.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import SH_C0, SH_C1, SH_C2, SH_C3
from minisplat_ref.cpu.gaussian_rows import contiguous
from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.mechanisms.gbuffer.brdf import table
from minisplat_ref.mechanisms.gbuffer.formulas import (
    angles_of,
    angles_vjp,
    find_knot,
    find_place,
    irradiate,
    irradiate_vjp,
    load_triple,
    mirror,
    mirror_vjp,
    nine_bases,
    nine_bases_vjp,
    read,
    read_table,
    read_vjp,
    store_triple,
)
from minisplat_ref.mechanisms.gbuffer.prefilter import KNOTS, Filtered
from minisplat_ref.mechanisms.gbuffer.shading import DIELECTRIC, Around, ShadingGradient, Surface
from minisplat_ref.scalar.projection import dot
from minisplat_ref.types import Floats, Ints

N_CHUNKS = 32
SUMS_MAX = 1 << 21  # numbers of all chunks: 16 MB


class ShadingTape(NamedTuple):
    """The values that :func:`shade` keeps for :func:`shade_vjp`."""

    surface: Surface
    light: Filtered
    points: "_Points"
    packed: "_Light"
    angles: Floats  # [P, 2] theta and phi of the reflected directions, float64


class _Points(NamedTuple):
    """Surface points in one dtype, and the gradient with respect to them."""

    albedo: Floats  # [P, 3]
    metallic: Floats  # [P]
    roughness: Floats  # [P]
    normals: Floats  # [P, 3]
    to_camera: Floats  # [P, 3]
    visibility: Floats  # [P], or [0] where nothing hides the environment
    around: Floats  # [P, 3], or [0, 3]
    scattered: Floats  # [P, 3], or [0, 3] where the albedo scatters the environment


class _Light(NamedTuple):
    """The environment and the shares that surfaces reflect, float64."""

    texels: Floats  # [T, 3] of all maps, one after the other
    maps: Ints  # [K, 3] of each map the first texel, and the number of rows and columns
    knots: Floats  # [K]
    irradiance: Floats  # [9, 3]
    table: Floats  # [SIZE, SIZE, 2] S and B by cosine and by roughness
    constants: Floats  # [10] of the spherical harmonics
    mirrors: bool


class _LightSums(NamedTuple):
    """Gradients with respect to the light, by chunk."""

    texels: Floats  # [C, T, 3]
    irradiance: Floats  # [C, 9, 3]


@scalar
def _both(a, b, share):
    """Return ``(1 - f) a + f b``."""
    rest = 1.0 - share
    return rest * a[0] + share * b[0], rest * a[1] + share * b[1], rest * a[2] + share * b[2]


@scalar
def _scale(factor, a):
    return factor * a[0], factor * a[1], factor * a[2]


@scalar
def _product(a, b):
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@scalar
def _sum(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@scalar
def _base_reflectance(albedo, metallic):
    """Return ``F_0 = 0.04 (1 - m) + a m``."""
    rest = DIELECTRIC * (1.0 - metallic)
    return rest + metallic * albedo[0], rest + metallic * albedo[1], rest + metallic * albedo[2]


@scalar
def _shade_point(i, points, light, angles, colors):
    albedo, metallic = load_triple(points.albedo, i), float(points.metallic[i])
    n = load_triple(points.normals, i)
    if points.scattered.size > 0:
        scattered = load_triple(points.scattered, i)
    else:
        scattered = _product(albedo, irradiate(nine_bases(n, light.constants), light.irradiance))
    color = _scale(1.0 - metallic, scattered)
    if light.mirrors:
        roughness = float(points.roughness[i])
        cosine, r = mirror(n, load_triple(points.to_camera, i))
        place = angles_of(r)
        angles[i, 0], angles[i, 1] = place[0], place[1]
        k, share, _ = find_knot(light.knots, roughness)
        incoming = _both(
            read(light.texels, find_place(light.maps, k, place)),
            read(light.texels, find_place(light.maps, k + 1, place)),
            share,
        )
        if points.visibility.size > 0:
            incoming = _both(load_triple(points.around, i), incoming, float(points.visibility[i]))
        (S, _, _), (B, _, _) = read_table(light.table, cosine, roughness)
        F_0 = _base_reflectance(albedo, metallic)
        color = _sum(color, _product((F_0[0] * S + B, F_0[1] * S + B, F_0[2] * S + B), incoming))
    store_triple(colors, i, color)


@scalar
def _reflect_vjp(i, points, light, place, v_color, v_texels, v):
    """Add the gradient of what a point reflects; return those with respect to its normal and its base reflectance."""
    albedo, metallic, roughness = load_triple(points.albedo, i), float(points.metallic[i]), float(points.roughness[i])
    n, to_camera = load_triple(points.normals, i), load_triple(points.to_camera, i)
    cosine, r = mirror(n, to_camera)
    k, share, step = find_knot(light.knots, roughness)
    below, above = find_place(light.maps, k, place), find_place(light.maps, k + 1, place)
    low, high = read(light.texels, below), read(light.texels, above)
    incoming = _both(low, high, share)
    (S, S_cosine, S_roughness), (B, B_cosine, B_roughness) = read_table(light.table, cosine, roughness)
    F_0 = _base_reflectance(albedo, metallic)
    v_incoming = _product((F_0[0] * S + B, F_0[1] * S + B, F_0[2] * S + B), v_color)
    if points.visibility.size > 0:
        visible = float(points.visibility[i])
        incoming = _both(load_triple(points.around, i), incoming, visible)
        store_triple(v.around, i, _scale(1.0 - visible, v_incoming))
        v_incoming = _scale(visible, v_incoming)
    reflected = _product(incoming, v_color)
    v_S, v_B = dot(F_0, reflected), reflected[0] + reflected[1] + reflected[2]
    low_theta, low_phi = read_vjp(light.texels, below, _scale(1.0 - share, v_incoming), v_texels)
    high_theta, high_phi = read_vjp(light.texels, above, _scale(share, v_incoming), v_texels)
    v_r = angles_vjp(r, low_theta + high_theta, low_phi + high_phi)
    v_cosine = v_S * S_cosine + v_B * B_cosine if cosine > 0.0 and cosine < 1.0 else 0.0
    v_n, v_to_camera = mirror_vjp(n, to_camera, cosine, v_cosine, v_r)
    v.roughness[i] = v_S * S_roughness + v_B * B_roughness + (dot(high, v_incoming) - dot(low, v_incoming)) / step
    store_triple(v.to_camera, i, v_to_camera)
    return v_n, _scale(S, reflected)


@scalar
def _shade_point_vjp(i, points, light, place, v_color, v_texels, v_irradiance, v):
    albedo, metallic = load_triple(points.albedo, i), float(points.metallic[i])
    v_n, v_F_0 = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    if light.mirrors:
        v_n, v_F_0 = _reflect_vjp(i, points, light, place, v_color, v_texels, v)
    v_albedo, v_scattered = _scale(metallic, v_F_0), _scale(1.0 - metallic, v_color)
    if points.scattered.size > 0:
        scattered = load_triple(points.scattered, i)
        store_triple(v.scattered, i, v_scattered)
    else:
        n = load_triple(points.normals, i)
        bases = nine_bases(n, light.constants)
        E = irradiate(bases, light.irradiance)
        scattered = _product(albedo, E)
        v_bases = irradiate_vjp(bases, light.irradiance, _product(albedo, v_scattered), v_irradiance)
        v_n, v_albedo = _sum(v_n, nine_bases_vjp(n, light.constants, v_bases)), _sum(v_albedo, _product(E, v_scattered))
    above_dielectric = albedo[0] - DIELECTRIC, albedo[1] - DIELECTRIC, albedo[2] - DIELECTRIC
    v.metallic[i] = dot(above_dielectric, v_F_0) - dot(scattered, v_color)
    store_triple(v.albedo, i, v_albedo)
    store_triple(v.normals, i, v_n)


@scalar
def _shade_range(first, end, points, light, angles, colors):
    for i in range(first, end):
        _shade_point(i, points, light, angles, colors)


@scalar
def _shade_range_vjp(span, points, light, angles, v_colors, v_texels, v_irradiance, v):
    for i in range(span[0], span[1]):
        place = angles[i, 0], angles[i, 1]
        _shade_point_vjp(i, points, light, place, load_triple(v_colors, i), v_texels, v_irradiance, v)


@kernel()
def _shade(
    points,  # _Points
    light,  # _Light
    angles,  # [P, 2]
    colors,  # [P, 3]
):
    n_points = points.metallic.size
    for chunk in prange(N_CHUNKS):
        _shade_range(n_points * chunk // N_CHUNKS, n_points * (chunk + 1) // N_CHUNKS, points, light, angles, colors)


@kernel()
def _shade_vjp(
    points,  # _Points
    light,  # _Light
    angles,  # [P, 2]
    v_colors,  # [P, 3]
    sums,  # _LightSums
    v,  # _Points
):
    n_points, n_chunks = points.metallic.size, sums.texels.shape[0]
    for chunk in prange(n_chunks):
        span = n_points * chunk // n_chunks, n_points * (chunk + 1) // n_chunks
        _shade_range_vjp(span, points, light, angles, v_colors, sums.texels[chunk], sums.irradiance[chunk], v)


def shade(
    surface: Surface,
    light: Filtered,
    around: Around | None = None,
    mirrors: bool = True,
    scattered: Floats | None = None,
) -> tuple[Floats, ShadingTape]:
    """Return the colours [P, 3] of surface points and the tape; see :func:`.shading.shade`."""
    points, packed = _pack_points(surface, around, scattered), _pack_light(light, mirrors)
    angles, colors = np.empty((len(points.metallic), 2)), np.empty_like(points.albedo)
    _shade(points, packed, angles, colors)
    return colors, ShadingTape(surface, light, points, packed, angles)


def shade_vjp(tape: ShadingTape, v_colors: Floats) -> ShadingGradient:
    """Gradient of :func:`shade`; see :func:`.shading.shade_vjp`."""
    points, light = tape.points, tape.packed
    v = _Points(*(np.empty_like(field) for field in points))
    if not light.mirrors:
        v.roughness[:], v.to_camera[:], v.around[:] = 0, 0, 0
    n_chunks = min(max(SUMS_MAX // light.texels.size, 1), N_CHUNKS)
    sums = _LightSums(np.zeros((n_chunks, *light.texels.shape)), np.zeros((n_chunks, *light.irradiance.shape)))
    _shade_vjp(points, light, tape.angles, np.ascontiguousarray(v_colors, v.albedo.dtype), sums, v)
    v_texels = sums.texels.sum(axis=0)
    v_maps = tuple(v_texels[first : first + h * w].reshape(h, w, 3) for first, h, w in light.maps.tolist())
    return ShadingGradient(
        Surface(v.albedo, v.metallic, v.roughness, v.normals, v.to_camera),
        Filtered(v_maps, sums.irradiance.sum(axis=0)),
        v.around if points.visibility.size else None,
        v.scattered if points.scattered.size else None,
    )


def _pack_points(surface: Surface, around: Around | None, scattered: Floats | None) -> _Points:
    dtype = surface.albedo.dtype
    visibility, colors = (np.zeros(0), np.zeros((0, 3))) if around is None else around
    given = np.zeros((0, 3)) if scattered is None else scattered
    return _Points(*contiguous(*(field.astype(dtype, copy=False) for field in (*surface, visibility, colors, given))))


def _pack_light(light: Filtered, mirrors: bool) -> _Light:
    sizes = [image.shape[0] * image.shape[1] for image in light.maps]
    starts = np.cumsum([0, *sizes[:-1]])
    maps = np.array([(start, *image.shape[:2]) for start, image in zip(starts, light.maps, strict=True)], np.int64)
    return _Light(
        np.concatenate([image.reshape(-1, 3) for image in light.maps]).astype(np.float64),
        maps,
        np.array(KNOTS),
        np.ascontiguousarray(light.irradiance, np.float64),
        table(),
        np.array((SH_C0, SH_C1, *SH_C2, *SH_C3)),
        mirrors,
    )
