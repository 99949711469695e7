"""Splits that make room for patterns: of large Gaussians, long ones, and ones that are pulled to two colours.

A Gaussian becomes a grid of children in the plane of its two longest axes. With two children per axis, each at a
distance d from the middle and with the standard deviation s', the variance stays where ``d^2 + s'^2 = s^2``; in a row
of four, at d and 3 d, where ``5 d^2 + s'^2 = s^2``. So the children leave no holes, and cover the same area as the
parent. The shortest axis stays.
"""

import math
from typing import Any

import numpy as np

from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.strategy.ops import Edit, concat, n_rows, take
from minisplat_ref.types import Floats, Gaussians, Ints

SHRINK = 1.6
"""The divisor of a scale that two children share, as in 3DGS; a row of four divides it by the square."""
GRIDS = {4: (2, 2), 8: (4, 2)}
"""Children along the longest and the second axis, by their number."""


def areas(gaussians: Any) -> Floats:
    """Return [N] the product of the two largest scales, squared world units."""
    return np.exp(np.sort(gaussians.log_scales.astype(np.float64), axis=1)[:, 1:].sum(axis=1))


def children_of(gaussians: Gaussians, parent_ids: Ints, n_children: int) -> Gaussians:
    """Return the children of each parent: ``n_children`` times P rows, the first child of every parent first.

    Parameters
    ----------
    gaussians : Gaussians
    parent_ids : ndarray of shape (P,)
    n_children : int
        4 or 8.
    """
    parents = take(gaussians, parent_ids)
    order = np.argsort(-parents.log_scales, axis=1, kind="stable")  # [P, 3] longest axis first
    rows = np.arange(len(parent_ids))
    log_scales, offsets = parents.log_scales.copy(), [np.zeros((1, len(rows), 3))]
    for axis, n in zip(order.T[:2], GRIDS[n_children], strict=True):
        shrink = SHRINK if n == 2 else SHRINK**2
        log_scales[rows, axis] -= log_scales.dtype.type(math.log(shrink))
        places = 2 * np.arange(n) - (n - 1)  # -1, 1, or -3, -1, 1, 3
        d = math.sqrt((1 - shrink**-2) / np.mean(places**2))  # mean (places d)^2 + shrink^-2 = 1
        steps = np.zeros((n, len(rows), 3))
        steps[:, rows, axis] = d * places[:, None] * np.exp(parents.log_scales[rows, axis].astype(np.float64))
        offsets.append(steps)
    grid = (offsets[1][:, None] + offsets[2][None]).reshape(n_children, len(rows), 3)  # in the parents' axes
    rotations = rotation_matrices(parents.quats.astype(np.float64))  # [P, 3, 3]
    moved = parents.means + np.einsum("pij,kpj->kpi", rotations, grid)  # [n, P, 3]
    children = take(parents, np.tile(rows, n_children))
    return children._replace(
        means=moved.reshape(-1, 3).astype(parents.means.dtype), log_scales=np.tile(log_scales, (n_children, 1))
    )


def split(gaussians: Gaussians, is_split: Any, n_children: int) -> Edit:
    """Return the edit that replaces the chosen rows [N] by their children, behind the others."""
    survivors, parents = np.flatnonzero(~is_split), np.flatnonzero(is_split)
    parent_ids = np.concatenate([survivors, np.tile(parents, n_children)])
    population = concat(take(gaussians, survivors), children_of(gaussians, parents, n_children))
    return Edit(population, parent_ids, np.arange(len(parent_ids)) >= len(survivors))


def largest(values: Floats, threshold: float, max_share: float) -> Any:
    """Return [N] whether a value is above the threshold, and among the largest ``max_share`` of all."""
    n_most = int(max_share * len(values))
    is_chosen = np.zeros(len(values), bool)
    is_chosen[np.argsort(-values, kind="stable")[:n_most]] = True
    return is_chosen & (values > threshold)


def split_large(gaussians: Gaussians, *, factor: float, max_share: float, n_children: int) -> Edit:
    """Split Gaussians whose area is above ``mean + factor std``, the largest first, at most ``max_share`` of all."""
    found = areas(gaussians)
    threshold = found.mean() + factor * found.std() if n_rows(gaussians) else 0.0
    return split(gaussians, largest(found, threshold, max_share), n_children)


def cut_stretch(log_scales: Floats, max_ratio: float) -> Floats:
    """Return log-scales [N, 3] whose longest axis is at most ``max_ratio`` times the second."""
    ordered = np.sort(log_scales, axis=1)
    limits = ordered[:, 1] + log_scales.dtype.type(math.log(max_ratio))
    return np.minimum(log_scales, limits[:, None])
