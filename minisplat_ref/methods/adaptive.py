"""``adaptive``: the scene decides how many Gaussians it needs and when training ends.

No paper has published the whole; ``docs/measured/adaptive.md`` has the evidence for each rule, and what was tried
without success. There is no schedule, and no setting depends on the scene:

*Grow.* Every 100 iterations the Gaussians whose mean screen gradient reaches a threshold are halved
(:mod:`minisplat_ref.strategy.halving`), at most a fifth of all at a time; those come first that stand behind most of
the pictures' error (:mod:`minisplat_ref.strategy.error_weights`). A Gaussian that fits what it covers has a small
gradient, so growth fades where a scene has enough.

*View dependence.* Each Gaussian has as many bands of the harmonics as the views that show it determine
(:mod:`minisplat_ref.methods.adaptive_bands`).

*Measure.* Every 100 iterations the held-out training views are rendered. The gain of their PSNR for each doubling of
the work, in pairs (tile, Gaussian), is the slope of a line through the measurements since half of the work.

*See more, and cool down.* Large photographs are halved at first. When the slope falls below a threshold, they are shown
at twice the size; when they are as they were taken, rates fall and all training views are trained on
(:mod:`minisplat_ref.training.pace`).

*Ask the photographs.* A sky, exposures, refined poses and compensated opacities are each switched on once, and only if
one half of the photographs, or of each photograph, shows the other half what it gains by them
(:mod:`minisplat_ref.methods.adaptive_sky`, :mod:`minisplat_ref.methods.adaptive_evidence`).

*Prune.* While the rates fall, what the photographs would hardly miss is removed in slices
(:mod:`minisplat_ref.methods.adaptive_prune`).
"""

import math
from functools import partial

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.methods.adaptive_antialiasing import switch_antialiasing_on
from minisplat_ref.methods.adaptive_bands import cut_bands_when_cooling, grow_bands
from minisplat_ref.methods.adaptive_evidence import plain_request
from minisplat_ref.methods.adaptive_exposure import hold_mean_exposure, log_gains, switch_exposure_on
from minisplat_ref.methods.adaptive_pose import hold_mean_pose, switch_pose_on, turn_held_out
from minisplat_ref.methods.adaptive_prune import prune_in_slices
from minisplat_ref.methods.adaptive_sky import switch_sky_on
from minisplat_ref.methods.gaussian_splatting import GS, GS_ACCEL, collect_gradients, prune_faint
from minisplat_ref.metrics import psnr
from minisplat_ref.strategy.error_weights import collect_error_weights
from minisplat_ref.strategy.halving import OFFSET, halves
from minisplat_ref.strategy.ops import n_rows
from minisplat_ref.training.adam import AdamRule
from minisplat_ref.training.calibration import EXPOSURES
from minisplat_ref.training.pace import (
    COOLED,
    FINER,
    HALVINGS_MAX,
    Cooling,
    Decision,
    Measurement,
    held_out_ids,
    trained_ids,
)
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.schedule import At, During, Every
from minisplat_ref.training.state import Iteration, TrainState, apply_edit, begin_cooling, smallest_side
from minisplat_ref.types import Floats

ITERATIONS_MAX = 30_000
GAIN_MIN = 0.1  # dB of the squared error, for which a calibration of the photographs is worthwhile
SKY_GAIN_MIN = 2.0  # dB, likewise, for a sky, where it shows: it explains nearly all that is there
MEASUREMENTS_MIN = 4  # to fit a line
SIDE_MIN = 120  # pixels: on smaller views, calibrations were found where there are none
SMALLEST_SIDE = 16  # pixels: a tile
VARIATION_MIN = 4 / 255  # of a band of the harmonics, out of 1


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
        Least mean length of the screen gradient, in normalised device coordinates.
    max_growth : float
        At most this fraction of the Gaussians is halved, those behind most of the pictures' error.
    offset : float
        How far apart the halves are, see :func:`minisplat_ref.strategy.halving.halves`.
    error_views : int
        At most so many of the views that are trained on, evenly spread, are rendered to say where the error is; with 0
        the gradients decide which come first.
    budget : int, optional
        Largest number of Gaussians to grow to; the training may begin with more.
    """
    if state.pace.cooling_from is not None:
        return "nothing done: the rates are falling"
    means = state.stats.pop("gradient_sum") / np.maximum(state.stats.pop("view_count"), 1)
    n = n_rows(state.gaussians)
    candidates = np.flatnonzero(means >= threshold)
    most = int(max_growth * n) if budget is None else min(int(max_growth * n), max(budget - n, 0))
    if len(candidates) > most:
        ranks = _error_weights(state, iteration, error_views) if error_views and most else means
        candidates = np.sort(candidates[np.argsort(-ranks[candidates], kind="stable")[:most]])
    share = np.count_nonzero(means >= threshold) / max(n, 1)
    apply_edit(state, halves(state.gaussians, candidates, offset=offset))
    return f"{share:.1%} above the threshold"


def _error_weights(state: TrainState, iteration: Iteration, max_views: int) -> Floats:
    """Return the error behind which each Gaussian stands [N], in at most so many of the views that are trained on."""
    views = iteration.scene.train_views
    ids = trained_ids(len(views), iteration.cooling, state.pace)
    return collect_error_weights(
        state.model,
        [views[index] for index in ids[:: math.ceil(len(ids) / max_views)]],
        background=iteration.scene.background,
        renderer=iteration.renderer,
        conventions=iteration.conventions,
        backend=iteration.backend,
    )


def measure_held_out(state: TrainState, iteration: Iteration) -> str | None:
    """Render the held-out training views and record their PSNR."""
    if iteration.cooling is None or state.pace.cooling_from is not None:
        return "nothing done: all training views are trained on"
    views = iteration.scene.train_views
    ids, psnrs = held_out_ids(len(views), iteration.cooling.hold_out_every), []
    # Their exposures are not trained and must not enter the measurement. For poses, see turn_held_out.
    gains = np.exp(log_gains(state, iteration, ids) if EXPOSURES in state.shared else np.zeros(len(ids)))
    for index, gain in zip(ids, gains.astype(np.float32), strict=True):
        view = views[index].load()
        output, _ = iteration.renderer.render(state.model, view, plain_request(iteration))
        psnrs.append(psnr(np.clip(gain * output.image, 0.0, 1.0), view.image, view.mask))
    measurement = Measurement(iteration.step, tuple(psnrs), n_rows(state.gaussians), state.pace.n_pairs)
    state.pace = state.pace._replace(measurements=(*state.pace.measurements, measurement))
    return f"{measurement.psnr:.2f} dB"


def halve_large_views(state: TrainState, iteration: Iteration, *, min_side: float) -> str:
    """Train on smaller views at first, halved as often as no side becomes shorter than ``min_side`` pixels.

    Raises
    ------
    InputError
        ``min_side`` is too small for a picture.
    """
    if not min_side >= SMALLEST_SIDE:
        raise InputError(f"min_side is {min_side}: give at least {SMALLEST_SIDE} pixels")
    side = smallest_side(iteration.scene)
    n_halvings = sum(side >= 2**times * min_side for times in range(1, HALVINGS_MAX + 1))
    state.pace = state.pace._replace(n_halvings=n_halvings)
    return f"to 1/{2**n_halvings} of their size" if n_halvings else f"nothing done: the shortest side has {side} pixels"


def proceed_when_little_is_gained(
    state: TrainState, iteration: Iteration, *, min_gain: float, min_step: int
) -> str | None:
    """Go on to larger views, or to the cool-down, when held-out views gain too little for each doubling of the work.

    What counts is what was measured since half of the work, and since anything was last decided.

    Parameters
    ----------
    state, iteration
        As for every action.
    min_gain : float
        dB for each doubling of the work.
    min_step : int
        No decision before this iteration: the first measurements rise steeply.
    """
    pace = state.pace
    if iteration.cooling is None or pace.cooling_from is not None or iteration.step < min_step:
        return None
    recent = pace.recent()
    if len(recent) < MEASUREMENTS_MIN:
        return None
    doublings = np.log2([m.n_pairs for m in recent])
    slopes = np.polyfit(doublings, np.array([m.psnrs for m in recent]), 1)[0]  # [V] dB per doubling
    gain, error = float(slopes.mean()), float(slopes.std(ddof=1) / np.sqrt(len(slopes)))
    if gain >= min_gain:
        return f"{gain:.2f} dB for each doubling of the work"
    why = f"held-out views gain {gain:.2f} dB for each doubling of the work, less than {min_gain}"
    if pace.n_halvings:
        state.pace = pace.seeing_finer(Decision(iteration.step, FINER, why, gain, error))
    else:
        decision = Decision(iteration.step, COOLED, why, gain, error)
        begin_cooling(state, iteration.cooling, iteration.iterations, decision)
    return why


RAISED = 2.24  # 6^0.45, as Mini-Splatting2's rates in a sixth of its iterations; for the means, too, not its square

ADAPTIVE = GS._replace(
    name="adaptive",
    iterations=ITERATIONS_MAX,
    learning_rates=Rates({name: RAISED * rate for name, rate in GS_ACCEL.learning_rates.at(0, extent=1.0).items()}),
    adam=AdamRule(is_visible_only=True, has_bias_correction=True),
    sh_milestones=(2, 2, 2),  # of Gaussians without degrees of their own; grow_bands gives them these in the first one
    events=(
        During(collect_while_growing),
        During(partial(grow_bands, views_per_coefficient=1.5)),
        During(hold_mean_exposure),
        During(hold_mean_pose),
        At(1, partial(halve_large_views, min_side=SIDE_MIN)),
        At(100, partial(switch_sky_on, min_sky_gain=SKY_GAIN_MIN)),
        At(600, partial(switch_exposure_on, min_exposure_gain=GAIN_MIN, min_antialiasing_gain=GAIN_MIN)),
        At(650, partial(switch_antialiasing_on, min_antialiasing_gain=GAIN_MIN)),
        At(700, partial(switch_pose_on, min_pose_gain=GAIN_MIN)),
        Every(100, turn_held_out, start=100),
        Every(100, measure_held_out, start=100),
        Every(100, partial(proceed_when_little_is_gained, min_gain=0.3, min_step=800), start=100),
        Every(
            100,
            partial(grow, threshold=4e-4, max_growth=0.2, offset=OFFSET, error_views=24, budget=None),
            start=100,
        ),
        Every(100, partial(prune_faint, min_opacity=0.005), start=100),
        During(partial(prune_in_slices, min_views=2, min_slope=1.0, max_pruned=0.2)),
        During(partial(cut_bands_when_cooling, min_variation=VARIATION_MIN)),
    ),
    min_views=5,
    cooling=Cooling(part=0.6, last=0.1, last_per_extent=0.01, hold_out_every=8),
)
"""``adaptive``."""
