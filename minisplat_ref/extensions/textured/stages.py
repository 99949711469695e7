"""What the gradient proof checks: the renderer, with the thresholds of textured hits."""

import numpy as np

from minisplat_ref.backends import REFERENCE, Backend
from minisplat_ref.extensions.textured.method import TEXTURED_GAUSSIANS, render
from minisplat_ref.extensions.textured.population import TexturedGaussians
from minisplat_ref.extensions.textured.reference import LIMB
from minisplat_ref.extensions.textured.response import RESPONSE, shade
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.models import model_stage
from minisplat_ref.oracle.setting import POSE, Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.hits import TileHits, tile_hits
from minisplat_ref.rendering import Request
from minisplat_ref.types import Bools, Floats, Model, view_from

NEAR_LIMB = 0.06  # of 1 - q . q, whose root has higher derivatives that a large step does not see through


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer; what is hit, clamped or cut, and where a ray passes the limb, is found by the reference."""
    stage = model_stage(backend, setting, TEXTURED_GAUSSIANS, rng)
    names = TexturedGaussians._fields

    def function(*args: Floats) -> Point:
        point, named = stage.function(*args), dict(zip(stage.inputs, args, strict=True))
        R, t = (named[name] for name in POSE)
        view = view_from(setting.camera._replace(cam_from_world_R=R, cam_from_world_t=t))
        request = Request(named["background"], conventions=setting.conventions, backend=REFERENCE)
        _, tape = render(Model(TexturedGaussians(*(named[name] for name in names))), view, request)
        footprints, coefficients, _, bins = tape.blended
        sides = [
            side
            for tile in tile_hits(footprints, bins, setting.conventions, RESPONSE)
            for side in _sides(tile, coefficients)
        ]
        return Point(point.outputs, (*point.sides, bins.gaussian_ids, *sides))

    return (stage._replace(function=function),)


def _sides(tile: TileHits, coefficients: Floats) -> tuple[Bools | Floats, ...]:
    """Which hits count, which are clamped, which colours are cut; near the limb the eighth of an octave of the root."""
    is_hit, place = tile.alphas > 0, tile.hit.place
    colors = shade(coefficients[tile.ids], place)  # [G, P, D]
    left = 1 - np.sum(place.meeting.q**2, axis=2)  # [G, P]
    is_near = is_hit & (left > LIMB**2) & (left < NEAR_LIMB)
    octaves = np.where(is_near, np.floor(8 * np.log2(np.where(is_near, left, 1))), is_hit & (left > LIMB**2))
    return is_hit, tile.is_clamped, is_hit[:, :, None] & (colors > 0), octaves
