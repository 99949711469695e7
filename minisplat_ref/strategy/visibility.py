"""Visibility culling of Mini-Splatting2: each training view is drawn with the Gaussians that matter to it.

A Gaussian is *visible* in a view if it belongs to the most important ones that together carry 0.99 of the view's blend
weight (:func:`minisplat_ref.strategy.importance.collect_importance`). The table [N, V] of who is visible where is
measured now and then, with culling off, on the training views alone; in between, children have their parent's row. Left
out: skipping the others when a view is drawn, which is the renderer's.
"""

import numpy as np

from minisplat_ref.types import Bools, Floats, Ints

COUNT_OFFSET = 0.1  # views; the released code's, against division by zero


def gradient_factors(is_visible: Bools, frustum_count: Ints) -> Floats:
    """Return what the positional gradients are multiplied by while views are culled.

    Density control compares the mean gradient, over the views that see the Gaussian, with a threshold that was chosen
    without culling. Culling takes away those views in which the Gaussian hardly counts and its gradient is small, so
    the mean rises. With the views left out at zero it is the mean over all views again::

        f = (views in which it is visible) / (views with it in the frustum + 0.1)

    The paper does not mention the factor, the released code has it.

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


def seen_by_few(is_visible: Bools, least_views: int) -> Bools:
    """Tell which Gaussians are visible in fewer than ``least_views`` training views.

    Depth from one view is a guess; the released code removes what fewer than two see. Of a scene with two views it
    would leave next to nothing, so no more than half of the views, rounded up, are ever asked for.

    Parameters
    ----------
    is_visible : ndarray of shape (N, V) of booleans
        Per training view.
    least_views : int
        2 in the released code; 0 for nobody.

    Returns
    -------
    mask : ndarray of shape (N,) of booleans
    """
    n_views = is_visible.shape[1]
    return np.count_nonzero(is_visible, axis=1) < min(least_views, (n_views + 1) // 2)


def culled_fraction(is_visible: Bools, frustum_count: Ints) -> float:
    """Return which part of the (Gaussian, view) pairs culling removes, of those that the frustum leaves.

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
    n_pairs = int(frustum_count.sum())
    return 1.0 - np.count_nonzero(is_visible) / n_pairs if n_pairs else 0.0
