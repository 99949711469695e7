"""Importance of each Gaussian to the training views (Mini-Splatting, Sec. 3.2 and appendix E), and the selection by it.

The weight w = alpha T of a hit is a Gaussian's share of a pixel. Everything here is a sum, a maximum or a count of
weights over the pixels of all training views. The Gaussian with the largest weight at a pixel *dominates* it.

The thresholds of Mini-Splatting2 are fractions of a sum, not ranks: 0.99 keeps those that together carry 99 % of it,
often more than half of all. Left out: the 1e-6 that the released code adds to every importance before summing, which
adds up for a million Gaussians.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.rendering import RenderSettings, as_model
from minisplat_ref.strategy.ops import n_rows
from minisplat_ref.types import Bools, Floats, Ints, View


class ImportanceStats(NamedTuple):
    """Statistics of each Gaussian over all training views."""

    blend_weight_sum: Floats
    """[N] sum of w over pixels and views."""
    mean_weight_sum: Floats
    """[N] sum, over the views in which it dominates a pixel, of its mean w per touched pixel."""
    blend_weight_max: Floats
    """[N] largest w in any pixel of any view."""
    dominant_count: Ints
    """[N] int64 pixels of all views that it dominates."""
    frustum_count: Ints
    """[N] int32 views that do not cull it."""
    is_visible: Bools
    """[N, V] whether it is among the Gaussians that carry most of the view's blend weight."""


def collect_importance(
    model: Any,
    views: Sequence[View],
    settings: RenderSettings = RenderSettings(),  # noqa: B008  (a constant)
    *,
    visibility_mass: float = 0.99,
) -> ImportanceStats:
    """Render every view for its blend statistics, and accumulate them in float64.

    Parameters
    ----------
    model : Model or Gaussians
    views : sequence of View
        The training views, at the resolution of training; only their cameras, indices and times matter.
    settings : RenderSettings
    visibility_mass : float
        Fraction of a view's blend weight that its visible Gaussians carry.

    Returns
    -------
    stats : ImportanceStats
        Columns of ``is_visible`` in the order of ``views``.
    """
    model = as_model(model)
    n = n_rows(model.gaussians)
    total = ImportanceStats(
        blend_weight_sum=np.zeros(n),
        mean_weight_sum=np.zeros(n),
        blend_weight_max=np.zeros(n),
        dominant_count=np.zeros(n, np.int64),
        frustum_count=np.zeros(n, np.int32),
        is_visible=np.zeros((n, len(views)), bool),
    )
    for v, seen_from in enumerate(views):
        output, _ = settings.render_view(model, seen_from, frozenset({"stats"}), sh_degree=0)
        view = output.stats
        assert view is not None
        total.blend_weight_sum[:] += view.blend_weight_sum
        is_dominant = view.dominant_count > 0  # [N] implies a hit, so nothing is divided by 0
        total.mean_weight_sum[is_dominant] += view.blend_weight_sum[is_dominant] / view.hit_count[is_dominant]
        np.maximum(total.blend_weight_max, view.blend_weight_max, out=total.blend_weight_max)
        total.dominant_count[:] += view.dominant_count
        total.frustum_count[output.visible_ids] += 1
        total.is_visible[:, v] = mass_mask(view.blend_weight_sum, visibility_mass)
    return total


def indoor(stats: ImportanceStats) -> Floats:
    """Return the importance [N] for indoor scenes: the sum of weights over all pixels and views (equation 12).

    Gaussians that cover many pixels count more.
    """
    return stats.blend_weight_sum


def outdoor(stats: ImportanceStats) -> Floats:
    """Return the importance [N] for outdoor scenes: mean weights per touched pixel, added up over the views.

    Only views in which the Gaussian dominates a pixel count; the number of pixels that it covers there does not.
    """
    return stats.mean_weight_sum


def mass_mask(importance: Floats, mass: float) -> Bools:
    """Return a mask of the most important rows that together carry ``mass`` of the sum.

    Parameters
    ----------
    importance : ndarray of shape (N,)
        Not negative.
    mass : float
        Fraction of the sum, in [0, 1]; at 1 all rows that are not zero.

    Returns
    -------
    mask : ndarray of shape (N,) of booleans
        False where the importance is zero. Of equals the later ones are left out first.
    """
    ids = np.flatnonzero(importance)[::-1]
    ascending = ids[np.argsort(importance[ids], kind="stable")]
    carried = np.cumsum(importance[ascending], dtype=np.float64)  # by each row and all less important ones
    n_left_out = np.searchsorted(carried, (1.0 - mass) * carried[-1:], side="right").sum()  # 0 where there are no rows
    mask = np.zeros(len(importance), bool)
    mask[ascending[n_left_out:]] = True
    return mask
