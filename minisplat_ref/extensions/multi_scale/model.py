"""Gaussians in levels: which of them a view shows, how those of a level are merged into the next, and the renderer.

A camera of focal length f shows ``c = f / z`` pixels per world unit at depth z. A cell of side w, a cube in which
Gaussians were merged into one, covers w c pixels per side there.

Level l is made for images of 1/F^l of the size of the training views. Of the Gaussians that are shown at the previous
level, those that would cover too few pixels are sorted into cubes as large as a pixel of that size, and all in a cube
become one Gaussian with their common moments, which stops as much light (``strategy.simplify.merge_clusters``). The
others stay as they are, and a cube with a single small one keeps it.
"""

from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.io.frames import Unit
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.strategy.ops import concat, n_rows, take
from minisplat_ref.strategy.simplify import merge_clusters, optical_masses
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import WORLD_UNITS, Representation
from minisplat_ref.types import Bools, Camera, Floats, Gaussians, Ints, Model, RenderOutput, View

NO_CELL = float(np.finfo(np.float32).max)  # the side of the parent's cell where there is no parent: never too small


def pixel_densities(means: Floats, camera: Camera, near_plane: float) -> Floats:
    """Return the densities ``c = sqrt(fx fy) / z`` of centres.

    Parameters
    ----------
    means : ndarray of shape (N, 3)
        Centres, world frame.
    camera : Camera
        Pose and focal lengths are used.
    near_plane : float
        Least z, world units; nearer centres count as at this depth.

    Returns
    -------
    ndarray of shape (N,)
        Pixels per world unit, in the dtype of the means.
    """
    z = means @ camera.cam_from_world_R[2].astype(means.dtype) + means.dtype.type(camera.cam_from_world_t[2])
    return means.dtype.type(np.sqrt(camera.fx * camera.fy)) / np.maximum(z, means.dtype.type(near_plane))


def are_shown(cells: Floats, densities: Floats) -> Bools:
    """Return which Gaussians a view shows, [N].

    ::

        w c < 1 <= w' c

    with the side w of a Gaussian's own cell and w' of its parent's. So the members of a cell are replaced by their
    parent exactly where the cell shrinks below a pixel.

    Parameters
    ----------
    cells : ndarray of shape (N, 2)
        World units: w, 0 where nothing was merged into the Gaussian, and w', ``NO_CELL`` where it has no parent.
    densities : ndarray of shape (N,)
        c, pixels per world unit.
    """
    with np.errstate(over="ignore"):
        own, parent = (cells * densities[:, None]).T
    return (own < 1) & (parent >= 1)


def coverages(log_scales: Floats, opacity_logits: Floats, densities: Floats, conventions: Conventions) -> Floats:
    """Return the width in pixels of each Gaussian, seen face on.

    The ellipse in which alpha is at least ``alpha_min`` has, for a standard deviation s, the width::

        S = 2 sqrt(2 ln(o / alpha_min)) s c

    s is the middle one of the three, so a flat Gaussian counts as wide in any orientation; otherwise it would disappear
    when seen edge on.

    Parameters
    ----------
    log_scales : ndarray of shape (N, 3)
        World units.
    opacity_logits : ndarray of shape (N,)
    densities : ndarray of shape (N,)
        c, pixels per world unit.
    conventions : Conventions
        ``alpha_min`` is used.

    Returns
    -------
    ndarray of shape (N,)
        Pixels; 0 where the Gaussian is too faint to be seen.
    """
    log_opacities = -np.logaddexp(0, -opacity_logits)
    reach = np.sqrt(2 * np.maximum(log_opacities - np.log(conventions.alpha_min), 0))
    S: Floats = 2 * reach * np.exp(np.sort(log_scales, axis=1)[:, 1]) * densities
    return S


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


def add_levels(
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
        ids, labels = _find_common_cells(g.means, 1 / density, is_small)
        if len(ids) == 0:
            continue
        merged, sides, members = _merge_members(take(g, ids), labels), 1 / density[ids], front[ids]
        first = np.unique(labels, return_index=True)[1]  # [C] a member of each cell
        merged = merged._replace(cells=_make_cells(sides[first], gaussians.cells.dtype))
        gaussians.cells[members, 1] = sides
        new_ids = n_rows(gaussians) + np.arange(len(first))
        octaves = np.concatenate([octaves, octaves[members[first]]])
        gaussians = concat(gaussians, merged)
        front = np.concatenate([np.delete(front, ids), new_ids])
    return gaussians


def _find_common_cells(means: Floats, sides: Floats, is_small: Any) -> tuple[Ints, Ints]:
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


def _make_cells(own: Floats, dtype: Any) -> Floats:
    """Return cells [C, 2] without parents."""
    return np.column_stack([own, np.full(len(own), NO_CELL)]).astype(dtype)


def render_levels(model: Model, view: View, request: Request) -> tuple[RenderOutput, Any]:
    """Render at each place the level that suits the camera; the tape is that of 3DGS."""
    g = model.gaussians
    is_shown = are_shown(g.cells, pixel_densities(g.means, view.camera, request.conventions.near_plane))
    if not is_shown.all():
        is_shown = is_shown if request.is_visible is None else is_shown & request.is_visible
        request = request._replace(is_visible=is_shown)
    return SPLATTING.render(model, view, request)


LEVELS = Representation(
    "Gaussians in levels",
    population=MultiScaleGaussians,
    units={**WORLD_UNITS, "cells": Unit.LENGTH},
    extend=level_zero,
    renderer=SPLATTING._replace(name="multi-scale", render=render_levels),
    rates=Rates({"cells": 0.0}, frozenset()),
)
