"""Adaptive density control of 3DGS (Sec. 5.2): clone, split, prune, opacity reset.

The signal is the gradient of the loss with respect to a Gaussian's position *in the image*, averaged over the views
that saw it since the last event: where it is large, the views pull one Gaussian to two places. Small Gaussians are then
cloned, large ones split.

Left out on purpose: the removal of Gaussians that are large on the screen (radius above 20 px). The released code
contains it, but the densification just before it zeroes the recorded radii, so it never removes anything; the paper's
figures were measured like this. The removal of Gaussians that are large in the world works there, and is included.
"""

import math
from collections.abc import Callable

import numpy as np

from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.strategy.ops import Edit, concat, keep, take
from minisplat_ref.types import Bools, Floats, Gaussians, Ints

N_CHILDREN = 2  # a split Gaussian is replaced by this many
SPLIT_SHRINK = 0.8 * N_CHILDREN  # children's scales are the parent's divided by this: 1.6 in the paper


def screen_gradient_norms(v_means2d: Floats, width: int, height: int) -> Floats:
    """Return the length of the positional gradient in normalised device coordinates.

    In them the image is two units wide and high, whatever its resolution, so v_ndc = v_pixel * (W, H) / 2. The
    released threshold 2e-4 is in this unit.

    Parameters
    ----------
    v_means2d : ndarray of shape (V, 2)
        Gradient with respect to the projected centres, per pixel. Of rows that are rendered as K Gaussians [V, 2 K]:
        the sum over these counts.
    width, height : int
        Image size, pixels.

    Returns
    -------
    norms : ndarray of shape (V,)
    """
    sums = v_means2d if v_means2d.shape[1] == 2 else v_means2d.reshape(len(v_means2d), -1, 2).sum(axis=1)
    v_x, v_y = 0.5 * width * sums[:, 0], 0.5 * height * sums[:, 1]  # [V]
    return np.sqrt(v_x * v_x + v_y * v_y)


def random_children(gaussians: Gaussians, parent_ids: Ints, rng: np.random.Generator) -> Gaussians:
    """Return two children of each parent, with centres drawn from it: mu + R (s * n) with n ~ N(0, I).

    They have 1/1.6 of its scales and the same opacity and colour.

    Parameters
    ----------
    gaussians : Gaussians
    parent_ids : ndarray of shape (P,)
        Rows to split.
    rng : numpy.random.Generator

    Returns
    -------
    children : Gaussians
        2 P rows: the first child of every parent, then the second.
    """
    parents = take(gaussians, np.tile(parent_ids, N_CHILDREN))
    dtype = parents.means.dtype
    offsets = np.exp(parents.log_scales) * rng.standard_normal(parents.means.shape).astype(dtype)  # [2P, 3] own axes
    rotations = rotation_matrices(parents.quats)  # [2P, 3, 3]
    return parents._replace(
        means=parents.means + (rotations @ offsets[:, :, None])[:, :, 0],
        log_scales=parents.log_scales - dtype.type(math.log(SPLIT_SHRINK)),
    )


def clone_and_split(
    gaussians: Gaussians,
    mean_norms: Floats,
    *,
    threshold: float,
    size_limit: float,
    rng: np.random.Generator,
    is_blurred: Bools | None = None,
    draw_children: Callable[[Gaussians, Ints, np.random.Generator], Gaussians] = random_children,
) -> Edit:
    """Clone the small and split the large among the Gaussians whose mean gradient reaches ``threshold``.

    A clone is an exact copy in the same place: the paper moves it along the gradient, the released code does not, and
    the two drift apart because the copy starts without momentum. A split Gaussian is replaced by its children.

    Parameters
    ----------
    gaussians : Gaussians
    mean_norms : ndarray of shape (N,)
        Mean of :func:`screen_gradient_norms` over the views that saw the Gaussian; 0 if none did.
    threshold : float
        In the unit of ``mean_norms``.
    size_limit : float
        Largest scale up to which a Gaussian is cloned rather than split, world units.
    rng : numpy.random.Generator
        Draws the children's positions.
    is_blurred : ndarray of shape (N,) of booleans, optional
        Split these too, whatever their gradient and size (Mini-Splatting,
        :func:`minisplat_ref.strategy.blur_split.is_blurred`). One that is also small and pulled is cloned first, as in
        the released code, so that its clone and its two children take its place.
    draw_children : function
        :func:`random_children`, or another with its signature and order of rows.

    Returns
    -------
    edit : Edit
        The survivors in their order, then clones, then the first and the second children.
    """
    is_pulled = mean_norms >= threshold  # [N]
    is_large = np.exp(gaussians.log_scales.max(axis=1, initial=-np.inf)) > size_limit  # [N]
    is_split = is_pulled & is_large  # [N]
    if is_blurred is not None:
        is_split |= is_blurred
    survivor_ids, split_ids = np.flatnonzero(~is_split), np.flatnonzero(is_split)
    clone_ids = np.flatnonzero(is_pulled & ~is_large)
    parent_ids = np.concatenate([survivor_ids, clone_ids, np.tile(split_ids, N_CHILDREN)])
    return Edit(
        concat(take(gaussians, survivor_ids), take(gaussians, clone_ids), draw_children(gaussians, split_ids, rng)),
        parent_ids,
        np.arange(len(parent_ids)) >= len(survivor_ids),
    )


def prune_faint(gaussians: Gaussians, *, min_opacity: float) -> Edit:
    """Remove nearly transparent Gaussians, of opacity below ``min_opacity``."""
    return keep(gaussians, gaussians.opacity_logits >= logit(min_opacity))


def prune_large(gaussians: Gaussians, *, size_limit: float | Floats) -> Edit:
    """Remove Gaussians larger than ``size_limit`` (world units; one for all, or [N]) along any axis."""
    return keep(gaussians, gaussians.log_scales.max(axis=1, initial=-np.inf) <= np.log(size_limit))


def cap_opacity_logits(opacity_logits: Floats, *, ceiling: float) -> Floats:
    """Return the logits with opacities lowered to ``ceiling`` where they are above it (the opacity reset).

    Gaussians that the photographs need become opaque again within a few hundred iterations; floaters near the cameras
    do not, and :func:`prune_faint` removes them.
    """
    return np.minimum(opacity_logits, opacity_logits.dtype.type(logit(ceiling)))


def logit(opacity: float) -> float:
    """Return the inverse of the sigmoid."""
    return math.log(opacity / (1.0 - opacity))
