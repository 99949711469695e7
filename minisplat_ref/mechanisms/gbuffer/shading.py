"""The colour of a surface point: its own, by the light on it, and that of the light which it reflects.

With the albedo a, the metallic share m, the roughness, the unit normal n and the unit direction v to the camera::

    r = 2 (n.v) n - v,   F_0 = 0.04 (1 - m) + a m
    L = V L_env(r, roughness) + (1 - V) L_around
    c = (1 - m) D + (F_0 S(n.v, roughness) + B(n.v, roughness)) L,   D = a E(n) where no other is given

E and L_env are those of :mod:`.prefilter`, S and B those of :mod:`.brdf`. V in [0, 1] is the visibility of the
environment along a reflected ray, and L_around the light of the scene that hides it (Ref-Gaussian, Yao et al. 2024,
arXiv 2412.19282).
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.mechanisms.gbuffer.brdf import reflectance
from minisplat_ref.mechanisms.gbuffer.prefilter import (
    Filtered,
    matte,
    matte_vjp,
    reflected,
    reflected_vjp,
)
from minisplat_ref.types import Floats

DIELECTRIC = 0.04  # F_0 of what is not metal


class Surface(NamedTuple):
    """P surface points."""

    albedo: Floats
    """[P, 3] linear RGB in [0, 1]."""
    metallic: Floats
    """[P] in [0, 1]."""
    roughness: Floats
    """[P] in [0, 1]."""
    normals: Floats
    """[P, 3] unit, world frame, towards the camera."""
    to_camera: Floats
    """[P, 3] unit, world frame."""


class Around(NamedTuple):
    """The light of the scene itself along reflected rays."""

    visibility: Floats
    """[P] V; it has no gradient."""
    colors: Floats
    """[P, 3] L_around."""


class ShadingTape(NamedTuple):
    """The values that :func:`shade` keeps for :func:`shade_vjp`."""

    surface: Surface
    light: Filtered
    around: Around | None
    cosines: Floats  # [P] n.v
    r: Floats  # [P, 3]
    matte: Floats  # [P, 3] E
    environment: Floats  # [P, 3] L_env
    incoming: Floats  # [P, 3] L
    shares: tuple[Floats, Floats, Floats]  # S and B with their derivatives, [P, 2] each
    scattered: Floats | None  # [P, 3] D, where it was given


class ShadingGradient(NamedTuple):
    """Gradient of the loss with respect to the inputs of :func:`shade`."""

    surface: Surface
    light: Filtered
    around: Floats | None  # [P, 3]
    scattered: Floats | None  # [P, 3]


def mirror_rays(surface: Surface) -> tuple[Floats, Floats]:
    """Return n.v [P] and the directions r [P, 3]."""
    n, v = surface.normals, surface.to_camera
    cosines = np.sum(n * v, axis=1)
    return cosines, 2 * cosines[:, None] * n - v


def shade(
    surface: Surface,
    light: Filtered,
    around: Around | None = None,
    mirrors: bool = True,
    scattered: Floats | None = None,
) -> tuple[Floats, ShadingTape]:
    """Return the colours [P, 3] of surface points, linear RGB, and the tape.

    Parameters
    ----------
    surface : Surface
        Their materials and directions.
    light : Filtered
        The environment.
    around : Around, optional
        What hides it; nothing by default.
    mirrors : bool
        Whether anything is reflected; without, S and B are 0, and the surface is matte.
    scattered : ndarray of shape (P, 3), optional
        D, the light that the surface would scatter without metal; that of the environment by default.
    """
    a, m, roughness, n, _ = surface
    cosines, r = mirror_rays(surface)
    shares = reflectance(cosines, roughness)
    if not mirrors:
        shares = (np.zeros_like(shares[0]),) * 3
    S, B = shares[0][:, :1], shares[0][:, 1:]
    E, L_env = matte(light, n), reflected(light, r, roughness)
    D = a * E if scattered is None else scattered
    L = L_env
    if around is not None:
        V = around.visibility[:, None]
        L = V * L_env + (1 - V) * around.colors
    F_0 = DIELECTRIC * (1 - m[:, None]) + a * m[:, None]
    colors = (1 - m[:, None]) * D + (F_0 * S + B) * L
    return colors, ShadingTape(surface, light, around, cosines, r, E, L_env, L, shares, scattered)


def shade_vjp(tape: ShadingTape, v_colors: Floats) -> ShadingGradient:
    """Gradient of :func:`shade`.

    ::

        v_D = (1 - m) v_c,   v_L = (F_0 S + B) v_c,   v_F0 = S L v_c,   v_S = F_0 . L v_c,   v_B = sum L v_c
        v_a = m v_F0,   v_m = -D . v_c + (a - 0.04) . v_F0;   of D = a E:  v_E = a v_D,  v_a += E v_D
        v_r from L_env;   v_n += 2 (n.v) v_r + 2 (n.v_r) v,   v_v += 2 (n.v_r) n - v_r
        v_(n.v) from S and B;   v_n += v_(n.v) v,   v_v += v_(n.v) n
    """
    (a, m, roughness, n, v), light, around = tape.surface, tape.light, tape.around
    metal, (table, by_cosine, by_roughness) = m[:, None], tape.shares
    S, B, L, E = table[:, :1], table[:, 1:], tape.incoming, tape.matte
    F_0 = DIELECTRIC * (1 - metal) + a * metal
    v_F0 = S * L * v_colors
    v_table = np.stack([np.sum(F_0 * L * v_colors, axis=1), np.sum(L * v_colors, axis=1)], axis=1)
    v_L = (F_0 * S + B) * v_colors
    v_around = None
    if around is not None:
        V = around.visibility[:, None]
        v_L, v_around = V * v_L, (1 - V) * v_L
    v_maps, v_r, v_roughness = reflected_vjp(light, tape.r, roughness, v_L)
    v_D, v_albedo = (1 - metal) * v_colors, metal * v_F0
    if tape.scattered is None:
        D: Floats = a * E
        v_irradiance, v_n = matte_vjp(light, n, a * v_D)
        v_albedo = v_albedo + E * v_D
    else:
        D, v_n = tape.scattered, np.zeros_like(n)
        v_irradiance = np.zeros_like(light.irradiance)
    is_inside = (tape.cosines > 0) & (tape.cosines < 1)
    v_cosines = np.where(is_inside, np.sum(v_table * by_cosine, axis=1), 0)[:, None]
    n_v_r = np.sum(n * v_r, axis=1, keepdims=True)
    v_surface = Surface(
        albedo=v_albedo,
        metallic=np.sum((a - DIELECTRIC) * v_F0 - D * v_colors, axis=1),
        roughness=v_roughness + np.sum(v_table * by_roughness, axis=1),
        normals=v_n + 2 * tape.cosines[:, None] * v_r + (2 * n_v_r + v_cosines) * v,
        to_camera=(2 * n_v_r + v_cosines) * n - v_r,
    )
    v_scattered = None if tape.scattered is None else v_D
    return ShadingGradient(v_surface, Filtered(v_maps, v_irradiance), v_around, v_scattered)
