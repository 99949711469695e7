"""Pruning of ``adaptive``: in slices, while the rates fall, Gaussians that the photographs would hardly miss.

The contribution of most Gaussians to the images is then known:
:mod:`minisplat_ref.strategy.removal` computes the change of the squared error without each of them, in one pass over
the training views. Those that are not worth their place are removed, a slice at a time; after each slice the training
repairs what it can, and the changes are recomputed.

The cost is measured, too, on the training views that are held out, or with too few to hold some out, on two of them.
Meanwhile their error falls because the rates do, which hides what the slices cost; so a line predicts what the error
would be without them. The squared error of a view is ``a + b r``, where r is the factor of the means' rate: what the
model cannot show, and what comes of steps that are too long. Both are fitted to N_FITTED measurements before the first
slice; so are those of 1 - SSIM. When the next slice would cost more than a tenth of a decibel, or five thousandths of
SSIM, in all, the prune ends. To let the prune go on within the standard error of this cost was tried: two views agree
or disagree by chance, and on ten photographs it removed Gaussians that held-out ones needed (N). The prune also ends
where no further slice is due: at the end of the cool-down nothing is removed, and all photographs are trained on, so
that it can converge.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from minisplat_ref.errors import InputError
from minisplat_ref.methods.adaptive.numbers import GAP_MIN, LAST_SLICE, N_SLICES, N_UNPRUNED, SLICE_MIN
from minisplat_ref.methods.adaptive.progress import evaluate_measured
from minisplat_ref.methods.mini_splatting import candidates, measure_importance
from minisplat_ref.strategy.importance import indoor
from minisplat_ref.strategy.ops import keep, n_rows
from minisplat_ref.strategy.removal import collect_removal_costs, select_worthwhile
from minisplat_ref.training.pace import Decision, Measurement, Pace
from minisplat_ref.training.state import Iteration, TrainState, apply_edit
from minisplat_ref.types import Floats

N_FITTED = N_UNPRUNED + 1  # measurements without a prune: the last one is made directly before the first slice


def slice_due(pace: Pace, step: int) -> int | None:
    """Return which slice is due at an iteration, from 0; None where none is.

    Before them are N_UNPRUNED moments at which the held-out views are only measured, the last of which is -1.
    """
    if pace.cooling_from is None or pace.last_step is None:
        return None
    last = LAST_SLICE * (pace.last_step - pace.cooling_from)
    every = max(GAP_MIN, int(last / (N_UNPRUNED + N_SLICES)))
    since = step - pace.cooling_from - 1
    moment, rest = divmod(since, every)
    is_due = rest == 0 and 0 <= moment < N_UNPRUNED + N_SLICES and since <= last
    return moment - N_UNPRUNED if is_due else None


def prune_in_slices(
    state: TrainState,
    iteration: Iteration,
    *,
    min_views: int,
    min_slope: float,
    max_pruned: float,
    max_psnr_cost: float,
    max_ssim_cost: float,
) -> None:
    """Remove Gaussians that the training views would hardly miss, a slice at a time, until that costs too much.

    Parameters
    ----------
    state, iteration
        As for every action.
    min_views : int
        Those that are visible in fewer views are removed before the first slice, however much they change there.
    min_slope : float
        Those stay whose removal raises the squared error by at least this many times the fall of the count, both
        relative: 1.0 is 3 dB for each doubling, before training adapts the others to replace them.
    max_pruned : float
        A slice is at most this fraction of the Gaussians.
    max_psnr_cost, max_ssim_cost : float
        What all slices together may cost on the measured training views, dB and without a unit.
    """
    if not state.pace.is_pruning or iteration.cooling is None:
        return
    number = slice_due(state.pace, iteration.step)
    if number is None:
        if is_prune_done(state.pace, iteration.step):
            take_all_views(state)
        return
    iteration.fetch()
    now = evaluate_measured(state, iteration, iteration.cooling, has_ssim=True)
    state.pace = state.pace._replace(while_cooling=(*state.pace.while_cooling, now))
    if number < 0:
        return
    rates = [iteration.cooling.factors(m.step, state.pace)[1] for m in state.pace.while_cooling]
    psnr, ssim = foresee_costs(state.pace.while_cooling, rates)
    if psnr.mean > max_psnr_cost or ssim.mean > max_ssim_cost:
        which = "held-out" if iteration.cooling.holds_out(len(iteration.scene.train_views)) else "measured training"
        why = (
            f"with more removed, the {which} views might lose {psnr.mean:z.2f} ± {psnr.standard_error:.2f} dB and"
            f" {ssim.mean:z.4f} ± {ssim.standard_error:.4f} of SSIM in all; at most {max_psnr_cost:g} dB and"
            f" {max_ssim_cost:g} are allowed"
        )
        state.pace = state.pace.with_decision(Decision(iteration.step, "prune ended", why, None, None))
        take_all_views(state)
        return
    if number == 0:
        prune_seen_by_few(state, iteration, min_views)
    n = n_rows(state.gaussians)
    try:
        costs = collect_removal_costs(state.model, iteration.scene.train_views, iteration.render_settings)
    except InputError as reason:
        if number == 0:
            iteration.say(f"nothing more is pruned: {reason}")
        return
    rows = select_worthwhile(costs, min_slope, max_pruned)
    if n - len(rows) < SLICE_MIN * n:
        return
    apply_edit(state, keep(state.gaussians, rows))
    lost = 10.0 * np.log10(1.0 + float(np.delete(costs.changes, rows).sum()) / costs.squared_error)
    why = f"without {n - len(rows):,} of {n:,} Gaussians the training views lose only {lost:.2f} dB"
    _record(state, iteration, why)


def is_prune_done(pace: Pace, step: int) -> bool:
    """Return whether no slice is due at an iteration or later."""
    if pace.cooling_from is None or pace.last_step is None:
        return False
    since = step - pace.cooling_from - 1
    return since > LAST_SLICE * (pace.last_step - pace.cooling_from)


class Cost(NamedTuple):
    """What a prune costs the held-out views."""

    mean: float
    """Over the views."""
    standard_error: float
    """Of the mean."""


def foresee_costs(measurements: Sequence[Measurement], rates: Sequence[float]) -> tuple[Cost, Cost]:
    """Return the estimated cost of the prune after one more slice: PSNR in dB, and SSIM.

    The cost so far is the value that the first N_FITTED measurements predict, less the present one; one more slice is
    assumed to cost as much as the last one, unless the views have gained by that. Before the first slice both are 0.

    Parameters
    ----------
    measurements : sequence of Measurement
        At the moments of :func:`slice_due` so far.
    rates : sequence of float
        Factor of the means' rate at each.
    """
    if len(measurements) <= N_FITTED:
        return Cost(0.0, 0.0), Cost(0.0, 0.0)
    errors = 10.0 ** (-np.array([m.psnrs for m in measurements]) / 10.0)
    dissimilarities = 1.0 - np.array([m.ssims for m in measurements])
    psnr_costs = 10.0 * np.log10(errors[-2:] / predict_unpruned(errors, rates)[-2:])
    return _foresee(psnr_costs), _foresee((dissimilarities - predict_unpruned(dissimilarities, rates))[-2:])


def predict_unpruned(errors: Floats, rates: Sequence[float]) -> Floats:
    """Return the errors [S, V] without a prune: a + b r with a >= 0, fitted to the first N_FITTED of each view.

    Rates fall, so from the last fitted moment on the line is above 0: where b is negative it rises, and elsewhere a and
    b are not. Before that it may be below 0.

    Parameters
    ----------
    errors : ndarray of shape (S, V)
        Of V views at S moments, above 0.
    rates : sequence of S floats
        r, factor of the means' rate at each moment.
    """
    terms = np.stack([np.ones(len(rates)), np.asarray(rates)], axis=1)  # [S, 2]
    bounds = [0.0, -np.inf], np.inf  # of a and b, which is negative where held-out views lose while the rates fall
    fits = [lsq_linear(terms[:N_FITTED], of_view[:N_FITTED], bounds).x for of_view in errors.T]
    return terms @ np.transpose(fits)


def _foresee(costs: Floats) -> Cost:
    """Return the cost of one more slice by the costs [2, V] at the last two moments, of each view."""
    last = costs[-1] - costs[-2]
    lost = costs[-1] + (last if last.mean() > 0 else 0.0)
    return Cost(float(lost.mean()), float(lost.std(ddof=1) / np.sqrt(len(lost))))


def take_all_views(state: TrainState) -> None:
    """End the prune: from the next iteration on, all training views are trained on."""
    state.pace = state.pace._replace(is_pruning=False)
    state.view_order = []


def prune_seen_by_few(state: TrainState, iteration: Iteration, min_views: int) -> None:
    """Remove what fewer than ``min_views`` views see, and what none does."""
    n = n_rows(state.gaussians)
    rows = np.flatnonzero(candidates(measure_importance(state, iteration), indoor, min_views, is_intersecting=False))
    if len(rows) < n:
        apply_edit(state, keep(state.gaussians, rows))
        _record(state, iteration, f"{n - len(rows):,} of {n:,} Gaussians are visible in fewer than {min_views} views")


def _record(state: TrainState, iteration: Iteration, why: str) -> None:
    state.pace = state.pace.with_decision(Decision(iteration.step, "prune", why, None, None))
