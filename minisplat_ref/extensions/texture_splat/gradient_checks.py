"""The stage of the gradient check: textured surfels shaded with occlusion.

Besides the kinks of shading, a hit has those between the cells of its textures, and a normal that of its largest tilt.
"""

from functools import partial

import numpy as np

from minisplat_ref.extensions.texture_splat.method import TEXTURED_SURFELS
from minisplat_ref.extensions.texture_splat.population import with_textures
from minisplat_ref.extensions.texture_splat.reference import REACH, TILT_MAX
from minisplat_ref.extensions.texture_splat.renderer import render
from minisplat_ref.mechanisms.gbuffer.gradient_checks import shading_stage
from minisplat_ref.mechanisms.gbuffer.population import WITH_OCCLUSION
from minisplat_ref.mechanisms.surfels.renderer import Shown
from minisplat_ref.mechanisms.surfels.response import Layout, surfel_response
from minisplat_ref.oracle.models import Drawn
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.rendering.backends import Backend

TEXELS = 3  # the smallest texture that has a kink inside


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the whole renderer, by its own name."""
    representation = TEXTURED_SURFELS._replace(extend=partial(with_textures, texels=TEXELS))
    stage = shading_stage(
        backend,
        setting,
        rng,
        representation,
        WITH_OCCLUSION,
        render=render,
        shaded=lambda tape: tape,
        further=_sides,
    )
    return (stage,)


def _sides(drawn: Drawn) -> list[np.ndarray]:
    tilts = np.sum(np.tanh(drawn.model.gaussians.normal_textures.reshape(-1, 2)) ** 2, axis=1)
    return [*cells_of(drawn.tape.blend.shown, TEXELS), tilts < TILT_MAX]


def cells_of(shown: Shown, size: int) -> list[np.ndarray]:
    """Return between which texels the hits of a view are, along both axes, as the reference computes them."""
    cells = []
    for tile in tile_hits(shown.surfels, shown.bins, shown.conventions, surfel_response(Layout())):
        is_hit, place = tile.alphas > 0, tile.hit.place
        for coordinate in (place.u, place.v):
            x = (np.where(is_hit, coordinate, 0) / REACH + 1) * (size - 1) / 2
            cells.append((np.floor(x) * is_hit * place.is_met).ravel())
    return cells
