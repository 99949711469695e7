"""Surfels with textures: fields, their start from surfels with one material, and textures of another size.

A texture has T x T texels. A field holds those of all its channels in a row of numbers: the texel in row j, along the
disc's second axis, and column i, along the first, has its channel c in column ``(j T + i) C + c``.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.gbuffer.population import PER_PIXEL, STAGE, ReflectiveSurfels, with_materials
from minisplat_ref.mechanisms.gbuffer.population import first_light as first_light_of_reflective
from minisplat_ref.types import Floats, Gaussians, Scene

CHANNELS = {"metallic_logits": 1, "roughness_logits": 1, "albedo_logits": 3, "normal_textures": 2}
"""The textures, and the number of channels of each."""


class TexturedSurfels(NamedTuple):
    """Surfels with textures; the fields without a comment are those of surfels with one material."""

    means: Floats
    quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    sh_dc: Floats
    sh_rest: Floats
    normal_textures: Floats
    """[N, 2 T^2]; their tanh is the normal's part along the axes of the disc."""
    albedo_logits: Floats
    """[N, 3 T^2] linear RGB."""
    metallic_logits: Floats
    """[N, T^2]."""
    roughness_logits: Floats
    """[N, T^2]."""


def texels_of(population: Any) -> int:
    """Return T.

    Raises
    ------
    InputError
        The numbers of columns are not those of square textures of one size.
    """
    n_columns = {name: getattr(population, name).shape[1] for name in CHANNELS}
    size = math.isqrt(n_columns["metallic_logits"])
    for name, n_channels in CHANNELS.items():
        if size == 0 or n_columns[name] != n_channels * size * size:
            square = f"{n_channels} T^2" if n_channels > 1 else "T^2"
            raise InputError(
                f"{name} has {n_columns[name]} columns, where square textures of one size have {square}: the file is"
                " damaged, take another"
            )
    return size


def with_textures(
    surfels: Gaussians | ReflectiveSurfels | TexturedSurfels, rng: np.random.Generator, *, texels: int
) -> TexturedSurfels:
    """Return surfels with textures of ``texels`` x ``texels``, with the former materials of the surfels.

    Surfels with one material have it everywhere, and the normals of their discs; Gaussians first get the material of a
    new reflective surfel; textures of another size become larger or smaller.

    Raises
    ------
    InputError
        ``texels`` is below 1.
    """
    if isinstance(surfels, TexturedSurfels):
        return resized(surfels, texels)
    g = surfels if isinstance(surfels, ReflectiveSurfels) else with_materials(surfels, rng)
    flat = TexturedSurfels(
        **{name: getattr(g, name) for name in Gaussians._fields},
        normal_textures=np.zeros((len(g.means), 2), g.means.dtype),
        albedo_logits=g.albedo_logits,
        metallic_logits=g.metallic_logits[:, None],
        roughness_logits=g.roughness_logits[:, None],
    )
    return resized(flat, texels)


def first_light(scene: Scene, rng: np.random.Generator) -> Mapping[str, Floats]:
    """Return an environment of 1, as for reflective surfels; shading is per pixel from the start."""
    return {**first_light_of_reflective(scene, rng), STAGE: np.full(1, PER_PIXEL, np.float32)}


def resized(population: TexturedSurfels, size: int) -> TexturedSurfels:
    """Return the population with textures of ``size`` x ``size`` texels, bilinear between those it has.

    A texture of one texel is the same everywhere.

    Raises
    ------
    InputError
        ``size`` is below 1.
    """
    if not size or size < 1:  # --set texels=none is None
        raise InputError(f"a texture of {size} x {size} texels does not exist: give --set texels=1 or more")
    before, n = texels_of(population), len(population.means)
    at = np.linspace(0, before - 1, size) if size > 1 else np.array([(before - 1) / 2])
    hats = np.maximum(1 - np.abs(at[:, None] - np.arange(before)), 0)  # [size, before], rows sum to 1

    def enlarge(field: Floats, n_channels: int) -> Floats:
        grid = field.reshape(n, before, before, n_channels)
        found = np.einsum("jb,ia,nbac->njic", hats, hats, grid)
        return np.ascontiguousarray(found.reshape(n, size * size * n_channels), field.dtype)

    return population._replace(
        **{name: enlarge(getattr(population, name), n_channels) for name, n_channels in CHANNELS.items()}
    )
