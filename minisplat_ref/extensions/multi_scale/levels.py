"""From Gaussians to levels: Gaussians that are too small to be seen from farther away are merged, cell by cell.

Level l is made for images of 1/F^l of the size of the training views. Of the Gaussians that are shown at the previous
level, those that would cover too few pixels are sorted into cubes as large as a pixel of that size, and all in a cube
become one Gaussian with their common moments, which stops as much light (``strategy.simplify.merge_clusters``). The
others stay as they are, and a cube with a single small one keeps it.
"""

from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.extensions.multi_scale.reference import NO_CELL, coverages
from minisplat_ref.strategy.ops import concat, n_rows, take
from minisplat_ref.strategy.simplify import merge_clusters, optical_masses
from minisplat_ref.types import Floats, Gaussians, Ints


class MultiScaleGaussians(NamedTuple):
    """Gaussians of several levels: the fields of :class:`Gaussians` and one more."""

    means: Floats
    quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    sh_dc: Floats
    sh_rest: Floats
    cells: Floats
    """[N, 2] world units: the side w of the cube that was merged into this Gaussian, 0 where none was, and the side w'
    of the cube in which this Gaussian was merged, ``NO_CELL`` where it was not. An event sets them; they have no
    gradient."""


class Plan(NamedTuple):
    """Settings of the levels."""

    factor: float
    """F: each level is for images smaller by this factor."""
    n_levels: int
    """Number of levels besides the finest."""
    min_coverage: float
    """Gaussians that cover fewer pixels than this are merged."""


def level_zero(gaussians: Gaussians, rng: np.random.Generator) -> MultiScaleGaussians:
    """Return the Gaussians as the only level."""
    cells = np.zeros((n_rows(gaussians), 2), gaussians.means.dtype)
    cells[:, 1] = NO_CELL
    return MultiScaleGaussians(**gaussians._asdict(), cells=cells)


def with_levels(
    gaussians: MultiScaleGaussians, densities: Floats, plan: Plan, conventions: Conventions
) -> MultiScaleGaussians:
    """Return the Gaussians with coarser levels appended.

    Parameters
    ----------
    gaussians : MultiScaleGaussians
        N rows of level 0.
    densities : ndarray of shape (N,)
        The largest density, pixels per world unit, at which each was trained.
    plan : Plan
        Settings of the levels.
    conventions : Conventions
        ``alpha_min`` is used.

    Returns
    -------
    MultiScaleGaussians
        The N rows in their order, some with the cells of their parents, and then level after level.
    """
    octaves = np.round(np.log2(densities))  # so that cells of equal size lie on one grid
    gaussians = gaussians._replace(cells=gaussians.cells.copy())
    front = np.flatnonzero(gaussians.cells[:, 1] == NO_CELL)
    for level in range(1, plan.n_levels + 1):
        density = np.exp2(octaves[front]) / plan.factor**level  # [M]
        g = take(gaussians, front)
        is_small = coverages(g.log_scales, g.opacity_logits, density, conventions) < plan.min_coverage
        ids, labels = _in_common_cells(g.means, 1 / density, is_small)
        if len(ids) == 0:
            continue
        merged, sides, members = _merge_members(take(g, ids), labels), 1 / density[ids], front[ids]
        first = np.unique(labels, return_index=True)[1]  # [C] a member of each cell
        merged = merged._replace(cells=_cells(sides[first], gaussians.cells.dtype))
        gaussians.cells[members, 1] = sides
        new_ids = n_rows(gaussians) + np.arange(len(first))
        octaves = np.concatenate([octaves, octaves[members[first]]])
        gaussians = concat(gaussians, merged)
        front = np.concatenate([np.delete(front, ids), new_ids])
    return gaussians


def _in_common_cells(means: Floats, sides: Floats, is_small: Any) -> tuple[Ints, Ints]:
    """Return the small rows that share a cell with another, and the index of each one's cell."""
    ids = np.flatnonzero(is_small)
    places = np.column_stack([sides[ids], np.floor(means[ids].astype(np.float64) / sides[ids, None])])
    _, labels, counts = np.unique(places, axis=0, return_inverse=True, return_counts=True)
    is_shared = counts[labels] > 1
    return ids[is_shared], np.unique(labels[is_shared], return_inverse=True)[1]


def _merge_members(members: MultiScaleGaussians, labels: Ints) -> MultiScaleGaussians:
    """Return one Gaussian per label, with moments weighted by the light that the members stop."""
    masses = np.maximum(optical_masses(members), np.finfo(np.float64).tiny)
    merged: Any = merge_clusters(members, masses, labels).gaussians
    return merged


def _cells(own: Floats, dtype: Any) -> Floats:
    """Return cells [C, 2] without parents."""
    return np.column_stack([own, np.full(len(own), NO_CELL)]).astype(dtype)
