"""Simplification: keep few Gaussians whose image is nearly the same (Mini-Splatting, equation 3).

Importance (:mod:`minisplat_ref.strategy.importance`) measures a Gaussian's contribution to the training views. There
are four ways to use it, to be compared at equal numbers of Gaussians:

- sampling, the paper's: draw Gaussians with probability proportional to importance, so that plain regions keep some;
- rank: keep the most important ones;
- mass: keep those that together carry a given fraction of all importance;
- merging: replace near neighbours by one Gaussian with their common mean and covariance. It is not in the paper.

Left out: when each is done, and the restart of the optimiser, which the recipe decides.
"""

from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from minisplat_ref.constants import GSPLAT_MAIN, SH_C0
from minisplat_ref.errors import InputError
from minisplat_ref.reference.covariance import covariances
from minisplat_ref.strategy.clone_split import logit
from minisplat_ref.strategy.importance import mass_mask
from minisplat_ref.strategy.initialization import gaussians_from_means
from minisplat_ref.strategy.ops import Edit, keep, take
from minisplat_ref.types import Floats, Gaussians, Ints

COLOR_REACH = 10.0  # a difference of 1 in colour counts like this many median distances to the nearest centre
LARGEST_OPACITY = GSPLAT_MAIN.alpha_max  # of a merged Gaussian: above it, alpha is clamped and has no gradient


def intersection_preserving(importance: Floats, dominant_count: Ints) -> Floats:
    """Return the importance with 0 where the Gaussian dominates no pixel of any view (equation 3).

    Those that dominate a pixel are the first that rays meet; the others are buried, or one of many that share a pixel.

    Parameters
    ----------
    importance : ndarray of shape (N,)
    dominant_count : ndarray of shape (N,)
        Pixels of all training views that each dominates.
    """
    return np.where(dominant_count > 0, importance, 0.0)


def sample(importance: Floats, n: int, rng: np.random.Generator) -> Ints:
    """Draw ``n`` different rows with probability proportional to importance.

    The distribution is that of drawing one after the other from the rows that are left. This draws all at once from the
    same distribution: add a standard Gumbel variate to every log importance, and take the ``n`` largest.

    Parameters
    ----------
    importance : ndarray of shape (N,)
        Not negative; rows of 0 are never drawn.
    n : int
    rng : numpy.random.Generator

    Returns
    -------
    ids : ndarray of shape (n,)
        Ascending.

    Raises
    ------
    InputError
        Fewer than ``n`` rows have any importance, or ``n`` is below 1.
    """
    ids = _candidates(importance, n)
    keys = np.log(importance[ids]) + rng.gumbel(size=len(ids))
    return np.sort(ids[np.argpartition(-keys, n - 1)[:n]])


def most_important(importance: Floats, n: int) -> Ints:
    """Return the ``n`` rows of largest importance, ascending; of equals the first.

    Parameters, result and errors as for :func:`sample`.
    """
    ids = _candidates(importance, n)
    return np.sort(ids[np.argsort(-importance[ids], kind="stable")[:n]])


def select_mass(importance: Floats, mass: float) -> Ints:
    """Return the rows, ascending, that :func:`mass_mask` marks.

    Raises
    ------
    InputError
        All importance is 0.
    """
    _candidates(importance, 1)
    return np.flatnonzero(mass_mask(importance, mass))


def _candidates(importance: Floats, n: int) -> Ints:
    """Return the rows that are not 0, of which there must be ``n``."""
    ids = np.flatnonzero(importance)
    if n < 1:
        raise InputError(f"budget is {n:,}, but a scene needs a Gaussian: give a budget of at least 1")
    if len(ids) == 0:
        raise InputError("all importance is 0, nothing is seen in any view: check the cameras, or train longer before")
    if n > len(ids):
        raise InputError(f"budget is {n:,} but only {len(ids):,} Gaussians have any importance: lower the budget")
    return ids


def by_sampling(gaussians: Gaussians, importance: Floats, n: int, rng: np.random.Generator) -> Edit:
    """Keep the ``n`` Gaussians that :func:`sample` draws. An event can take this function or one of the next two."""
    return keep(gaussians, sample(importance, n, rng))


def by_rank(gaussians: Gaussians, importance: Floats, n: int, rng: np.random.Generator) -> Edit:
    """Keep the ``n`` Gaussians of :func:`most_important`, without random numbers."""
    return keep(gaussians, most_important(importance, n))


def by_merging(gaussians: Gaussians, importance: Floats, n: int, rng: np.random.Generator) -> Edit:
    """Merge down to ``n`` Gaussians with :func:`merge_neighbours`, without random numbers."""
    return merge_neighbours(gaussians, importance, n)


def merge_neighbours(gaussians: Gaussians, importance: Floats, n: int) -> Edit:
    """Merge near neighbours until ``n`` Gaussians are left; those without importance are dropped first.

    Neighbours are near in space and in colour. Each round considers the pairs that are each other's nearest neighbour
    and merges the cheaper half of them by Ward's criterion, squared distance times w_1 w_2 / (w_1 + w_2), by which
    unimportant ones go first. With the members m of a cluster, their importance w_m and d_m = mu_m - mu::

        mu    = sum w_m mu_m / sum w_m                      all other fields alike, such as the colour's coefficients
        Sigma = sum w_m (Sigma_m + d_m d_m^T) / sum w_m     quaternion and scales by its eigenvectors and eigenvalues
        tau A = sum tau_m A_m,   o = 1 - exp(-tau)

    tau is the optical thickness of a Gaussian, and A, with A^2 = s1^2 s2^2 + s2^2 s3^2 + s3^2 s1^2, is its
    cross-section up to a factor. So two in one place, merged, absorb as much light as before, and two side by side
    become a larger one of about their opacity.

    Parameters
    ----------
    gaussians : Gaussians
    importance : ndarray of shape (N,)
    n : int

    Returns
    -------
    edit : Edit
        Ordered by the first member of each cluster. Rows that were not merged stay the same; a merged row is new, and
        its parent is its most important member.

    Raises
    ------
    InputError
        As for :func:`sample`.
    """
    ids = _candidates(importance, n)
    if len(ids) == n:
        return keep(gaussians, ids)
    candidates, weights = take(gaussians, ids), importance[ids].astype(np.float64)
    edit = merge_clusters(candidates, weights, _clusters(_places(candidates), weights, n))
    return edit._replace(parent_ids=ids[edit.parent_ids])


def merge_clusters(gaussians: Any, weights: Floats, labels: Ints) -> Edit:
    """Merge each cluster into one Gaussian with the cluster's moments: the equations of :func:`merge_neighbours`.

    Parameters
    ----------
    gaussians : Gaussians, or another population with its fields
        N rows; of a further field the weighted mean is taken.
    weights : ndarray of shape (N,), float64
        Above 0; only their ratios within a cluster count.
    labels : ndarray of shape (N,) of ids
        Number of each row's cluster, from 0 on without gaps.

    Returns
    -------
    edit : Edit
        One row for each cluster, in the order of their numbers; see :func:`merge_neighbours`.
    """
    order = np.lexsort([-weights, labels])  # by cluster, its most important member first
    weights, labels = weights[order], labels[order]
    parent_ids = order[np.flatnonzero(np.diff(labels, prepend=-1))]  # [n]
    is_merged = np.bincount(labels) > 1  # [n]
    is_member = is_merged[labels]  # [N]
    left = take(gaussians, parent_ids)
    members = type(gaussians)._make(field.astype(np.float64) for field in take(gaussians, order[is_member]))
    for field, merged in zip(left, _merge_clusters(members, weights[is_member], labels[is_member]), strict=True):
        field[is_merged] = merged
    return Edit(left, parent_ids, is_merged)


def optical_masses(gaussians: Any) -> Floats:
    """Return ``tau A`` [N] of each Gaussian, float64: the light that it absorbs, which merging conserves."""
    scales = np.exp(gaussians.log_scales.astype(np.float64))
    return np.logaddexp(0.0, gaussians.opacity_logits.astype(np.float64)) * _cross_sections(scales**2)


def _places(gaussians: Gaussians) -> Floats:
    """Return centres and colours [C, 6] in one unit of length, float64."""
    means, colors = gaussians.means.astype(np.float64), SH_C0 * gaussians.sh_dc.astype(np.float64)
    distances, _ = cKDTree(means).query(means, 2)
    return np.column_stack([means, COLOR_REACH * np.median(distances[:, 1]) * colors])


def _clusters(places: Floats, weights: Floats, n: int) -> Ints:
    """Return for each row the number of its cluster; the ``n`` clusters are numbered by their first rows."""
    labels = np.arange(len(places))
    sums = np.column_stack([weights[:, None] * places, weights])  # [C, 7]
    while len(sums) > n:
        places, weights = sums[:, :-1] / sums[:, -1:], sums[:, -1]
        first, second = mutual_neighbours(places).T  # [P]
        squared = np.sum((places[first] - places[second]) ** 2, axis=1)
        costs = squared * weights[first] * weights[second] / (weights[first] + weights[second])
        chosen = np.argsort(costs, kind="stable")[: min(len(sums) - n, -(-len(costs) // 2))]
        into = np.arange(len(sums))
        into[second[chosen]] = first[chosen]
        into = np.unique(into, return_inverse=True)[1]
        labels = into[labels]
        sums = np.column_stack([np.bincount(into, column) for column in sums.T])
    return labels


def mutual_neighbours(places: Floats) -> Ints:
    """Return pairs [P, 2] of rows that are nearest to each other, the lower row first.

    Where distances are equal (coincident points, grids), nearest neighbours may form cycles. All pairs of a row and its
    neighbour are therefore ranked, and a pair counts if it is the first of both its rows: the closest always does.
    """
    rows = np.arange(len(places))
    distances, nearest = cKDTree(places).query(places, 2)  # [M, 2] a row need not come before a coincident one
    is_self = nearest[:, 0] == rows
    other = np.where(is_self, nearest[:, 1], nearest[:, 0])
    order = np.argsort(np.where(is_self, distances[:, 1], distances[:, 0]), kind="stable")
    neighbours = np.column_stack([np.minimum(rows, other), np.maximum(rows, other)])[order]
    ranks = np.full(len(places), len(neighbours))
    for column in neighbours.T:
        np.minimum.at(ranks, column, rows)
    return neighbours[(ranks[neighbours[:, 0]] == rows) & (ranks[neighbours[:, 1]] == rows)]


def _merge_clusters(members: Any, weights: Floats, labels: Ints) -> Gaussians:
    """Return one Gaussian, float64, per cluster; the members of a cluster are contiguous."""
    starts = np.flatnonzero(np.diff(labels, prepend=-1))  # [n]
    sizes = np.diff(starts, append=len(labels))
    shares = weights / np.repeat(np.add.reduceat(weights, starts), sizes)  # [M]

    def mean_of(values: Floats) -> Floats:
        return np.add.reduceat(shares.reshape(-1, *[1] * (values.ndim - 1)) * values, starts, axis=0)

    means = mean_of(members.means)  # [n, 3]
    offsets = members.means - np.repeat(means, sizes, axis=0)
    scales = np.exp(members.log_scales)
    sigmas = mean_of(covariances(members.quats, scales) + offsets[:, :, None] * offsets[:, None, :])  # [n, 3, 3]
    variances, axes = np.linalg.eigh(sigmas)
    # No variance is below the smallest of the members', except by rounding.
    variances = np.maximum(variances, np.minimum.reduceat(scales.min(axis=1) ** 2, starts)[:, None])
    axes[np.linalg.det(axes) < 0, :, 0] *= -1  # a rotation, not a reflection

    thickness = np.logaddexp(0.0, members.opacity_logits)  # tau = -ln(1 - o), from the logit
    tau = np.add.reduceat(thickness * _cross_sections(scales**2), starts) / _cross_sections(variances)
    averages = members._make(map(mean_of, members))
    merged: Gaussians = averages._replace(
        means=means,
        quats=Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]],
        log_scales=0.5 * np.log(variances),
        opacity_logits=np.minimum(tau + np.log(-np.expm1(-tau)), logit(LARGEST_OPACITY)),
    )
    return merged


def _cross_sections(variances: Floats) -> Floats:
    """Return A [M] with A^2 = s1^2 s2^2 + s2^2 s3^2 + s3^2 s1^2, given variances s^2 [M, 3]: an area up to a factor."""
    s1, s2, s3 = variances.T
    return np.sqrt(s1 * s2 + s2 * s3 + s3 * s1)


def reinitialise(gaussians: Gaussians, sh_degree: int) -> Gaussians:
    """Return Gaussians with these centres and colours, and all other fields as at the start of training.

    Mini-Splatting does this after sampling: the Gaussians that remain have to grow over the gaps.

    Parameters
    ----------
    gaussians : Gaussians
        At least 4.
    sh_degree : int
        Stored degree from now on; coefficients above degree 0 are zero.

    Returns
    -------
    gaussians : Gaussians
        In the dtype of the old ones.
    """
    return gaussians_from_means(gaussians.means, gaussians.sh_dc, sh_degree)
