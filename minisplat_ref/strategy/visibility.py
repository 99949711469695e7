"""Visibility culling of Mini-Splatting2: render each training view only with the Gaussians that matter to it.

A Gaussian is *visible* in a view if it belongs to the most important ones that together carry 0.99 of the view's blend
weight (:func:`minisplat_ref.strategy.importance.collect_importance`). The table [N, V] of this visibility is measured
now and then, with culling off, on the training views alone; in between, children inherit their parent's row. Left out:
skipping the others when a view is rendered, which the renderer does.
"""

import numpy as np

from minisplat_ref.types import Bools, Floats, Ints

COUNT_OFFSET = 0.1  # views; against division by zero, from the released code


def gradient_factors(is_visible: Bools, frustum_count: Ints) -> Floats:
    """Return the factors by which positional gradients are multiplied while views are culled.

    Density control compares the mean gradient, over the views that see the Gaussian, with a threshold that was chosen
    without culling. Culling removes the views in which the Gaussian hardly counts and its gradient is small, so the
    mean rises. Counting those views as zero restores the mean over all views::

        f = (views in which it is visible) / (views with it in the frustum + 0.1)

    The factor is in the released code, not in the paper.

    Parameters
    ----------
    is_visible : ndarray of shape (N, V) of booleans
        Per training view.
    frustum_count : ndarray of shape (N,)
        Training views whose image it touches at all.

    Returns
    -------
    factors : ndarray of shape (N,)
        float64, in [0, 1).
    """
    return np.count_nonzero(is_visible, axis=1) / (frustum_count + COUNT_OFFSET)


def find_seen_by_few(is_visible: Bools, min_views: int) -> Bools:
    """Return which Gaussians are visible in fewer than ``min_views`` training views.

    Depth from one view is a guess; the released code removes Gaussians that fewer than two views see. In a scene with
    two views this would leave next to nothing, so at most half of the views, rounded up, are required.

    Parameters
    ----------
    is_visible : ndarray of shape (N, V) of booleans
        Per training view.
    min_views : int
        2 in the released code; 0 for none.

    Returns
    -------
    mask : ndarray of shape (N,) of booleans
    """
    n_views = is_visible.shape[1]
    return np.count_nonzero(is_visible, axis=1) < min(min_views, (n_views + 1) // 2)


def culled_fraction(is_visible: Bools, frustum_count: Ints) -> float:
    """Return the fraction of the Gaussians in the frusta of all views that culling removes.

    Parameters
    ----------
    is_visible : ndarray of shape (N, V) of booleans
        Per training view.
    frustum_count : ndarray of shape (N,)
        Training views whose image it touches at all.

    Returns
    -------
    fraction : float
        In [0, 1]; 0 where no view sees anything.
    """
    n_in_frustum = int(frustum_count.sum())
    return 1.0 - np.count_nonzero(is_visible) / n_in_frustum if n_in_frustum else 0.0
