"""What the gradient proof checks: the renderer, with the thresholds of masked hits."""

from typing import Any

import numpy as np

from minisplat_ref.backends import Backend
from minisplat_ref.extensions.cuts.curve import N_EDGES, TOPS
from minisplat_ref.extensions.cuts.method import CUT_GAUSSIANS, CutGaussians, render, with_cuts
from minisplat_ref.extensions.cuts.response import RESPONSE
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.models import model_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.hits import TileHits, tile_hits
from minisplat_ref.rendering import Request
from minisplat_ref.types import Floats, Gaussians, Model, RenderOutput, View


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer; what is hit, and which part of a curve is nearest, is found by the reference."""
    sides: list[np.ndarray] = []

    def watched(model: Model, view: View, request: Request) -> tuple[RenderOutput, Any]:
        output, tape = render(model, view, request)
        footprints, _, _, bins = tape.blended
        tiles = tile_hits(footprints, bins, setting.conventions, RESPONSE)
        sides[:] = [bins.gaussian_ids, *(side for tile in tiles for side in _sides(tile))]
        return output, tape

    renderer = CUT_GAUSSIANS.renderer._replace(render=watched)
    stage = model_stage(backend, setting, CUT_GAUSSIANS._replace(extend=_near, renderer=renderer), rng)

    def function(*args: Floats) -> Point:
        point = stage.function(*args)
        return Point(point.outputs, (*point.sides, *sides))

    return (stage._replace(function=function),)


def _near(gaussians: Gaussians, rng: np.random.Generator) -> CutGaussians:
    """Return Gaussians whose curves go through what is bright, or little would depend on them."""
    population = with_cuts(gaussians, rng)
    return population._replace(curves=0.4 * population.curves)


def _sides(tile: TileHits) -> tuple[np.ndarray, ...]:
    """Which hits count and are clamped; which vertex of a polygon is nearest, or, numbered behind them, which piece."""
    is_hit, found = tile.alphas > 0, tile.hit.place.cut
    edges = np.arange(N_EDGES)
    first, last = np.array([*edges, 0, N_EDGES]), np.array([*edges + 1, 0, N_EDGES])  # vertices of each piece
    nearest = np.where(found.fractions > 0, N_EDGES + 1 + found.pieces, first[found.pieces])
    nearest = np.where(found.fractions < TOPS[found.pieces], nearest, last[found.pieces])
    return is_hit, tile.is_clamped, np.where(is_hit, nearest, -1)
