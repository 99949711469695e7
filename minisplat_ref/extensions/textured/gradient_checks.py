"""The stage of the gradient check: the renderer with the thresholds of textured hits."""

import numpy as np

from minisplat_ref.extensions.textured.method import TEXTURED_GAUSSIANS
from minisplat_ref.extensions.textured.reference import LIMB
from minisplat_ref.extensions.textured.response import shade
from minisplat_ref.mechanisms.payload.gradient_checks import renderer_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.hits import TileHits
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.types import Bools, Floats

NEAR_LIMB = 0.06  # of 1 - q . q, whose root has large higher derivatives, which need small steps


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer as a stage; the reference finds hits, clamps, and the rays that pass the limb."""
    return (renderer_stage(backend, setting, TEXTURED_GAUSSIANS, _sides, rng),)


def _sides(tile: TileHits, coefficients: Floats) -> tuple[Bools | Floats, ...]:
    """Return which hits count, which hits and colours are clamped, and near the limb eighths of octaves of the root."""
    is_hit, place = tile.alphas > 0, tile.hit.place
    colors = shade(coefficients[tile.ids], place)  # [G, P, D]
    left = 1 - np.sum(place.meeting.q**2, axis=2)  # [G, P]
    is_near = is_hit & (left > LIMB**2) & (left < NEAR_LIMB)
    octaves = np.where(is_near, np.floor(8 * np.log2(np.where(is_near, left, 1))), is_hit & (left > LIMB**2))
    return is_hit, tile.is_clamped, is_hit[:, :, None] & (colors > 0), octaves
