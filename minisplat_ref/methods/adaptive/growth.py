"""Growth of ``adaptive``: Gaussians whose screen gradient is large are halved, those behind most of the error first."""

import numpy as np

from minisplat_ref.methods.gaussian_splatting import collect_gradients
from minisplat_ref.strategy.error_weights import collect_error_weights
from minisplat_ref.strategy.halving import halves
from minisplat_ref.strategy.ops import n_rows
from minisplat_ref.training.pace import trained_ids
from minisplat_ref.training.state import Iteration, TrainState, apply_edit
from minisplat_ref.types import Floats, some_of


def collect_while_growing(state: TrainState, iteration: Iteration) -> None:
    """Count the work of the iteration and, until the rates fall, collect gradients."""
    state.pace = state.pace._replace(n_pairs=state.pace.n_pairs + iteration.output.n_pairs)
    if state.pace.cooling_from is None:
        collect_gradients(state, iteration)
    else:
        state.stats.pop("gradient_sum", None)
        state.stats.pop("view_count", None)


def grow(
    state: TrainState,
    iteration: Iteration,
    *,
    threshold: float,
    max_growth: float,
    offset: float,
    error_views: int,
    budget: int | None = None,
) -> str | None:
    """Halve the Gaussians whose mean gradient reaches ``threshold``, and reset the collected gradients.

    Parameters
    ----------
    state, iteration
        As for every action.
    threshold : float
        Minimum of the mean length of the screen gradient, in normalised device coordinates.
    max_growth : float
        At most this fraction of the Gaussians is halved, those behind most of the images' error.
    offset : float
        How far apart the halves are, see :func:`minisplat_ref.strategy.halving.halves`.
    error_views : int
        At most this many of the views that are trained on, evenly spread, are rendered to locate the error; with 0 the
        gradients decide which come first.
    budget : int, optional
        Largest number of Gaussians to grow to; the training may begin with more.
    """
    if state.pace.cooling_from is not None:
        return "nothing done: the learning rates are falling"
    means = state.stats.pop("gradient_sum") / np.maximum(state.stats.pop("view_count"), 1)
    n = n_rows(state.gaussians)
    candidates = np.flatnonzero(means >= threshold)
    most = int(max_growth * n) if budget is None else min(int(max_growth * n), max(budget - n, 0))
    if len(candidates) > most:
        ranks = _error_weights(state, iteration, error_views) if error_views and most else means
        candidates = np.sort(candidates[np.argsort(-ranks[candidates], kind="stable")[:most]])
    share = np.count_nonzero(means >= threshold) / max(n, 1)
    apply_edit(state, halves(state.gaussians, candidates, offset=offset))
    return f"{share:.1%} have a gradient above the threshold"


def _error_weights(state: TrainState, iteration: Iteration, max_views: int) -> Floats:
    """Return the error that each Gaussian [N] is responsible for, in at most this many training views."""
    views = iteration.scene.train_views
    ids = trained_ids(len(views), iteration.cooling, state.pace)
    chosen = [views[index] for index in some_of(ids, max_views)]
    return collect_error_weights(state.model, chosen, iteration.render_settings)
