"""The stage of the gradient check: the renderer with the thresholds of masked hits."""

import numpy as np

from minisplat_ref.extensions.cuts.curve import N_EDGES, N_PIECES, TOPS
from minisplat_ref.extensions.cuts.method import CUT_GAUSSIANS, CutGaussians, with_cuts
from minisplat_ref.mechanisms.payload.gradient_checks import renderer_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.hits import TileHits
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.types import Floats, Gaussians


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer of two curves as a stage; the reference finds the hits that count, and the nearest pieces."""
    return (renderer_stage(backend, setting, CUT_GAUSSIANS._replace(extend=_near), _sides, rng),)


def _near(gaussians: Gaussians, rng: np.random.Generator) -> CutGaussians:
    """Return Gaussians whose curves pass through their bright parts; otherwise little would depend on them."""
    population = with_cuts(gaussians, rng, n_curves=2)
    return population._replace(curves=0.4 * population.curves)


def _sides(tile: TileHits, colors: Floats) -> tuple[np.ndarray, ...]:
    """Return which hits count, which are clamped, and the nearest vertex or, numbered after the vertices, piece."""
    is_hit, found = tile.alphas > 0, tile.hit.place.cut
    edges, (curves, pieces) = np.arange(N_EDGES), np.divmod(found.pieces, N_PIECES)
    first, last = np.array([*edges, 0, N_EDGES]), np.array([*edges + 1, 0, N_EDGES])  # vertices of each piece
    nearest = np.where(found.fractions > 0, N_EDGES + 1 + pieces, first[pieces])
    nearest = np.where(found.fractions < TOPS[pieces], nearest, last[pieces])
    return is_hit, tile.is_clamped, np.where(is_hit, nearest, -1), np.where(is_hit, curves, -1)
