"""Stages for the gradient proof: the renderer and all its channels, with hulls of all kinds.

The record has the edges on which pixels' hits lie, and which depths are bounded.
"""

import numpy as np

from minisplat_ref.extensions.mixed.method import MIXED_GAUSSIANS
from minisplat_ref.extensions.mixed.population import MixedGaussians, as_ellipses
from minisplat_ref.extensions.mixed.response import INSIDE
from minisplat_ref.extensions.mixed.surfaces import SurfacePlace
from minisplat_ref.mechanisms.payload.gradient_checks import renderer_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.hits import TileHits
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.types import Bools, Floats, Gaussians, Ints

SPAN = 1.0  # of the vertices from the first, in the Gaussians' own deviations
N_EDGES = 3


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer; the reference finds the hits, and the nearest points of hulls."""
    of_all = MIXED_GAUSSIANS._replace(extend=of_all_kinds)
    return (renderer_stage(backend, setting, of_all, _sides, rng, frozenset({"depth", "normal", "spread"})),)


def of_all_kinds(gaussians: Gaussians, rng: np.random.Generator) -> MixedGaussians:
    """Return the Gaussians themselves as alternating triangles, ellipses and lines, with random vertices."""
    population, n = as_ellipses(gaussians), len(gaussians.means)
    in_deviations = SPAN * rng.normal(size=(n, 2, 2))
    vertices = in_deviations * np.exp(gaussians.log_scales[:, None, :2])
    kinds = np.array([3, 1, 2])[np.arange(n) % 3].astype(gaussians.means.dtype)
    return population._replace(vertices=vertices.reshape(n, 4).astype(gaussians.means.dtype), n_vertices=kinds)


def _sides(tile: TileHits, colors: Floats) -> tuple[Bools | Ints, ...]:
    """Which hits count and are clamped; on which edge, or, numbered behind them, at which vertex the nearest point is.

    Squares of distances have no second derivative where the nearest point goes from an edge to a vertex.
    """
    place: SurfacePlace = tile.hit.place
    is_hit, found = tile.alphas > 0, place.hull.place.nearest
    vertex = np.argmax(found.weights, axis=2)
    is_vertex = (found.edges != INSIDE) & (found.weights.max(axis=2) == 1)
    return (
        is_hit,
        tile.is_clamped,
        place.is_bounded,
        np.where(is_hit, np.where(is_vertex, N_EDGES + vertex, found.edges), -2),
    )
