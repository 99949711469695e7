"""From Gaussians to levels: what is too small to be seen from farther away is merged, cell by cell.

Level l is made for pictures of 1/F^l of the size of the training views. Of the Gaussians that are shown at the level
before, those that would cover too few pixels are sorted into cubes as large as a pixel of that size, and all in a cube
become one of their common moments and of the light that they stop (``strategy.simplify.merge_clusters``). The others
stay as they are, and a cube with a single small one keeps it.
"""

from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.extensions.multi_scale.reference import NO_CELL, coverages
from minisplat_ref.strategy.ops import concat, n_rows, take
from minisplat_ref.strategy.simplify import merge_clusters, optical_masses
from minisplat_ref.types import Floats, Gaussians, Ints


class MultiScaleGaussians(NamedTuple):
    """Gaussians of several levels: the fields of :class:`Gaussians`, and one more."""

    means: Floats
    quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    sh_dc: Floats
    sh_rest: Floats
    cells: Floats
    """[N, 2] sides of the cube that was merged into this Gaussian, 0 where none was, and of the one that this Gaussian
    was merged in, ``NO_CELL`` where it was not. World units. An event sets them, no gradient does."""


class Plan(NamedTuple):
    """How levels are made."""

    factor: float
    """F: each level is for pictures as many times smaller."""
    n_levels: int
    """Without the finest."""
    least_coverage: float
    """Pixels: what covers fewer is merged."""


def level_zero(gaussians: Gaussians, rng: np.random.Generator) -> MultiScaleGaussians:
    """Return the Gaussians as the only level."""
    cells = np.zeros((n_rows(gaussians), 2), gaussians.means.dtype)
    cells[:, 1] = NO_CELL
    return MultiScaleGaussians(**gaussians._asdict(), cells=cells)


def with_levels(
    gaussians: MultiScaleGaussians, densities: Floats, plan: Plan, conventions: Conventions
) -> MultiScaleGaussians:
    """Return the Gaussians with coarser levels behind them.

    Parameters
    ----------
    gaussians : MultiScaleGaussians
        N rows.
    densities : ndarray of shape (N,)
        The largest number of pixels per world unit in which each was trained.
    plan : Plan
    conventions : Conventions

    Returns
    -------
    MultiScaleGaussians
        The N rows in their order, the parents' cells of some set, and then level after level.
    """
    octaves = np.round(np.log2(densities))  # cells of one size lie on one grid
    gaussians = gaussians._replace(cells=gaussians.cells.copy())
    front = np.flatnonzero(gaussians.cells[:, 1] == NO_CELL)
    for level in range(1, plan.n_levels + 1):
        density = np.exp2(octaves[front]) / plan.factor**level  # [M]
        g = take(gaussians, front)
        is_small = coverages(g.log_scales, g.opacity_logits, density, conventions) < plan.least_coverage
        ids, labels = _in_common_cells(g.means, 1 / density, is_small)
        if len(ids) == 0:
            continue
        merged, sides, members = _merged(take(g, ids), labels), 1 / density[ids], front[ids]
        first = np.unique(labels, return_index=True)[1]  # [C] a member of each cell
        merged = merged._replace(cells=_cells(sides[first], gaussians.cells.dtype))
        gaussians.cells[members, 1] = sides
        new_ids = n_rows(gaussians) + np.arange(len(first))
        octaves = np.concatenate([octaves, octaves[members[first]]])
        gaussians = concat(gaussians, merged)
        front = np.concatenate([np.delete(front, ids), new_ids])
    return gaussians


def _in_common_cells(means: Floats, sides: Floats, is_small: Any) -> tuple[Ints, Ints]:
    """Return the small rows that share a cell with another, and the number of the cell of each, from 0 on."""
    ids = np.flatnonzero(is_small)
    places = np.column_stack([sides[ids], np.floor(means[ids].astype(np.float64) / sides[ids, None])])
    _, labels, counts = np.unique(places, axis=0, return_inverse=True, return_counts=True)
    is_shared = counts[labels] > 1
    return ids[is_shared], np.unique(labels[is_shared], return_inverse=True)[1]


def _merged(members: MultiScaleGaussians, labels: Ints) -> MultiScaleGaussians:
    """Return one Gaussian for each label, weighted by the light that the members stop."""
    masses = np.maximum(optical_masses(members), np.finfo(np.float64).tiny)
    merged: Any = merge_clusters(members, masses, labels).gaussians
    return merged


def _cells(own: Floats, dtype: Any) -> Floats:
    """Return cells [C, 2] without parents."""
    return np.column_stack([own, np.full(len(own), NO_CELL)]).astype(dtype)
