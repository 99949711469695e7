"""The growing of anchors: new ones where the Gaussians of those that exist are pulled hard.

The rule is that of Scaffold-GS (Lu et al. 2023, arXiv 2312.00109, section 3.3), from which CUS-GS has its anchors. In
every iteration the gradient of the loss with respect to the projected centre of each Gaussian is collected, in
normalised device coordinates as in 3DGS. Every hundred iterations space is divided into voxels at three levels, of
sides that become smaller and thresholds that become higher::

    eps_m = eps / 4^(m-1),   tau_m = tau 2^(m-1),   m = 1, 2, 3;   eps = 16 l

A voxel gets an anchor at its centre if the mean gradient of the Gaussians in it exceeds ``tau_m``, if it has no anchor
yet, and if it survives a random elimination. At the third level voxels are as large as those of the first anchors,
whose side is l.

The paper gives no share of the random elimination; in its release a half, a quarter and an eighth go. Nor does it
define the start of a new anchor: here it has latent and colour of the anchor whose Gaussian has the largest gradient in
the voxel. Gradients are those of the photometric loss.
"""

from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.extensions.cus.population import Anchors, at_rest, voxel_side
from minisplat_ref.strategy.clone_split import screen_gradient_norms
from minisplat_ref.strategy.initialization import initial_gaussians
from minisplat_ref.strategy.ops import Edit, concat
from minisplat_ref.training.state import Iteration, TrainState, apply_edit
from minisplat_ref.types import Floats, Ints

N_LEVELS = 3
COARSEST = 16  # eps, in units of l
FINER, STEEPER = 4, 2  # from one level to the next: what sides are divided by, and thresholds multiplied with
THRESHOLD = 2e-4  # tau of the release, that of 3DGS
SUM, COUNT = "children_gradient_sum", "children_view_count"


def collect_gradients_of_children(state: TrainState, iteration: Iteration, *, growth_threshold: float | None) -> None:
    """Add the positional gradient of each Gaussian to ``stats[SUM]`` [N, K], and count the view in ``stats[COUNT]``.

    A Gaussian without a gradient was not seen. Without a threshold nothing grows, and nothing is collected.
    """
    if growth_threshold is None:
        return
    n, k = len(state.gaussians.means), state.gaussians.n_children
    if SUM not in state.stats:
        state.stats[SUM] = np.zeros((n, k), iteration.v_means2d.dtype)
        state.stats[COUNT] = np.zeros((n, k), np.int32)
    camera = iteration.view.camera
    norms = screen_gradient_norms(iteration.v_means2d.reshape(n * k, 2), camera.width, camera.height).reshape(n, k)
    state.stats[SUM] += norms
    state.stats[COUNT] += norms > 0


class Candidates(NamedTuple):
    """Voxels of one level whose mean gradient exceeds the threshold, in lexicographic order of their places."""

    centers: Floats
    """[C, 3] world frame."""
    parent_ids: Ints
    """[C] row, among the given points, of that with the largest gradient in the voxel."""


def find_candidates(points: Floats, gradients: Floats, anchors: Floats, side: float, threshold: float) -> Candidates:
    """Return the voxels without an anchor in which the mean gradient of the points exceeds a threshold.

    The centres of voxels are the multiples of their side.

    Parameters
    ----------
    points : ndarray of shape (P, 3)
        Centres of the Gaussians that were seen, world frame.
    gradients : ndarray of shape (P,)
        Mean length of the positional gradient of each over the views that saw it, normalised device coordinates.
    anchors : ndarray of shape (N, 3)
    side : float
        eps_m, world units.
    threshold : float
        tau_m.
    """
    cells, voxel_ids = np.unique(_cells(points, side), axis=0, return_inverse=True)
    voxel_ids = voxel_ids.ravel()
    n = len(cells)
    counts = np.bincount(voxel_ids, minlength=n)
    is_steep = np.bincount(voxel_ids, weights=gradients, minlength=n) > threshold * counts
    taken = {tuple(cell) for cell in _cells(anchors, side)}
    is_free = np.array([tuple(cell) not in taken for cell in cells], bool)
    steepest = np.zeros(n, np.int64)
    order = np.argsort(gradients, kind="stable")
    steepest[voxel_ids[order]] = order  # the last that is written is the largest
    chosen = np.flatnonzero(is_steep & is_free)
    return Candidates(cells[chosen] * side, steepest[chosen])


def _cells(points: Floats, side: float) -> Ints:
    return np.round(points.astype(np.float64) / side).astype(np.int64)


def grow(anchors: Anchors, gradients: Floats, side: float, threshold: float, rng: np.random.Generator) -> Edit:
    """Return the anchors with the new ones behind them.

    Parameters
    ----------
    anchors : Anchors
    gradients : ndarray of shape (N, K)
        Mean length of the positional gradient of each Gaussian; NaN if no view saw it.
    side : float
        l, world units.
    threshold : float
        tau.
    rng : numpy.random.Generator
        Draws the eliminated anchors, and the offsets of the new ones.
    """
    n, k = gradients.shape
    is_seen = ~np.isnan(gradients)
    points = (anchors.means[:, None] + anchors.offsets.reshape(n, k, 3))[is_seen]
    owners = np.repeat(np.arange(n), k).reshape(n, k)[is_seen]
    parent_ids = np.arange(n)
    grown: Any = anchors
    for level in range(N_LEVELS):
        side_here = side * COARSEST / FINER**level
        found = find_candidates(points, gradients[is_seen], grown.means, side_here, threshold * STEEPER**level)
        survives = rng.random(len(found.centers)) >= 0.5 ** (level + 1)
        parents = owners[found.parent_ids[survives]]
        new = at_rest(found.centers[survives], anchors.sh_dc[parents], anchors.latents[parents], side_here, k, rng)
        grown, parent_ids = concat(grown, new), np.concatenate([parent_ids, parents])
    return Edit(grown, parent_ids, np.arange(len(parent_ids)) >= n)


def grow_anchors(
    state: TrainState, iteration: Iteration, *, voxel: float, growth_threshold: float | None
) -> str | None:
    """Apply :func:`grow` with the gradients collected since the last time, and reset them.

    Parameters
    ----------
    state : TrainState
    iteration : Iteration
    voxel : float
        Side of the first voxels in units of the points' median scale, as for :func:`.population.as_anchors`.
    growth_threshold : float or None
        tau; None: there is no growing.
    """
    if growth_threshold is None:
        return "nothing done: growth_threshold is none"
    counts, sums = state.stats.pop(COUNT), state.stats.pop(SUM)
    gradients = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
    first = initial_gaussians(iteration.scene, 0, np.random.default_rng(0))  # draws only where there are no points
    edit = grow(state.gaussians, gradients, voxel_side(first, voxel), growth_threshold, state.rng)
    n_new = int(edit.is_new.sum())
    apply_edit(state, edit)
    return None if n_new else "nothing done: no voxel has a gradient above its threshold"
