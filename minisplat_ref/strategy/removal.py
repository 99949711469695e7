"""The cost of removing each Gaussian, in squared error, and the Gaussians that are not worth their place.

:mod:`minisplat_ref.reference.removal` has S_i, the squared change of an image without Gaussian i: where the training
has converged, the increase of the squared error. Summed over the views it has a unit, unlike blend weight, which counts
a Gaussian in front of others of the same colour as highly as one that alone shows something. Beside the squared error E
of the N Gaussians, it is the slope of the curve of error over count at Gaussian i::

    slope_i = N S_i / E = -(d ln E / d ln N)          3 slope_i dB for each doubling of the count

Training adapts the others to replace what is gone, so the true loss is smaller; and S is not additive. So Gaussians are
removed a slice at a time, and S is computed again when the training has continued for a while.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.rendering import RenderSettings, as_model
from minisplat_ref.strategy.ops import n_rows
from minisplat_ref.types import Floats, Ints, View

CHANGES = "removal_changes"  # name of S in the requests to a renderer


class RemovalCosts(NamedTuple):
    """The change of the views by the removal of each Gaussian alone."""

    changes: Floats
    """[N] S, summed over all pixels, masked ones included, channels and views; before any exposure of a photograph."""
    squared_error: float
    """E, of the pixels of the views that are not masked, channel by channel."""

    @property
    def slopes(self) -> Floats:
        """Return N S / E [N]; infinite where there is no error but a change."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.changes != 0, len(self.changes) * self.changes / self.squared_error, 0.0)


def collect_removal_costs(model: Any, views: Sequence[View], settings: RenderSettings) -> RemovalCosts:
    """Render every view, compare it with its photograph, and accumulate in float64.

    Parameters
    ----------
    model : Model or Gaussians
    views : sequence of View
        Training views, with their photographs.
    settings : RenderSettings

    Raises
    ------
    InputError
        The renderer cannot compute the change by a removal.
    """
    model = as_model(model)
    changes, squared_error = np.zeros(n_rows(model.gaussians)), 0.0
    wants, renderer = frozenset({CHANGES}), settings.renderer
    rgb = renderer.channels(wants)["rgb"]
    for view in views:
        photographed = view.load()
        output, _ = settings.render_view(model, photographed, wants)
        if CHANGES not in output.extras:
            raise InputError(f"renderer {renderer.name} does not say what the removal of a Gaussian changes")
        changes += output.extras[CHANGES]
        squares = (output.image[..., rgb] - photographed.image / np.float32(255.0)) ** 2
        counted = squares if photographed.mask is None else squares[photographed.mask]
        squared_error += float(np.sum(counted, dtype=np.float64))
    return RemovalCosts(changes, squared_error)


def select_worthwhile(costs: RemovalCosts, min_slope: float, max_growth: float) -> Ints:
    """Return the rows to keep, ascending: all but those whose slope is below ``min_slope``.

    Parameters
    ----------
    costs : RemovalCosts
    min_slope : float
        Of the curve of squared error over count, both as logarithms.
    max_growth : float
        At most this fraction of the Gaussians goes, those of the smallest change first; of equals the first.
    """
    slopes = costs.slopes
    most = int(max_growth * len(slopes))
    going = np.argsort(slopes, kind="stable")[: min(most, np.count_nonzero(slopes < min_slope))]
    return np.setdiff1d(np.arange(len(slopes)), going)
