"""Progress of ``adaptive`` on held-out views, after which it continues with larger views or with the cool-down.

With too few views to hold some out, it proceeds as soon as it may.
"""

import numpy as np

from minisplat_ref.metrics import correct_colors, psnr, ssim
from minisplat_ref.strategy.ops import n_rows
from minisplat_ref.training.calibration import EXPOSURES
from minisplat_ref.training.pace import (
    COOLED,
    FINER,
    Cooling,
    Decision,
    Measurement,
    gains_per_doubling,
    measured_ids,
)
from minisplat_ref.training.state import Iteration, TrainState, begin_cooling


def measure_progress(state: TrainState, iteration: Iteration) -> str | None:
    """Render the held-out training views and record their PSNR; with too few to hold out, two that are trained on."""
    if iteration.cooling is None or state.pace.cooling_from is not None:
        return "nothing done: the learning rates are falling"
    measurement = evaluate_measured(state, iteration, iteration.cooling)
    state.pace = state.pace._replace(measurements=(*state.pace.measurements, measurement))
    return f"{measurement.psnr:.2f} dB"


def evaluate_measured(
    state: TrainState, iteration: Iteration, cooling: Cooling, *, has_ssim: bool = False
) -> Measurement:
    """Return the PSNR of the measured training views, and the SSIM on request.

    Each that is held out has the pose that ``turn_held_out`` gives it. Where photographs have exposures, those of views
    that are not trained on stay as they were before the training; their error would hide what the training gains, so
    colours are corrected first.
    """
    views, has_exposures = iteration.scene.train_views, EXPOSURES in state.shared
    ids, psnrs, ssims = measured_ids(len(views), cooling.hold_out_every), [], []
    for index in ids:
        view = views[index].load()
        output, _ = iteration.render_settings.render_view(state.model, view)
        image = np.clip(output.image, 0.0, 1.0)
        if has_exposures:
            image = correct_colors(image, view.image, view.mask)
        psnrs.append(psnr(image, view.image, view.mask))
        if has_ssim:
            ssims.append(ssim(image, view.image, view.mask))
    return Measurement(iteration.step, tuple(psnrs), n_rows(state.gaussians), state.pace.n_pairs, tuple(ssims))


def proceed_when_little_is_gained(
    state: TrainState, iteration: Iteration, *, min_gain: float, min_step: int
) -> str | None:
    """Continue to larger views, or to the cool-down, when held-out views gain too little for each doubling of the work.

    Only values since half of the work, and since the latest decision, count. Where no views are held out, it continues
    as soon as there are enough such values.

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
    slopes = gains_per_doubling(pace.recent())
    if slopes is None:
        return None
    n_views = len(iteration.scene.train_views)
    gain, error = None, None
    if iteration.cooling.holds_out(n_views):
        gain, error = float(slopes.mean()), float(slopes.std(ddof=1) / np.sqrt(len(slopes)))
        if gain >= min_gain:
            return f"{gain:.2f} dB from twice the work"
        why = f"twice the work would bring the held-out views {gain:.2f} dB, less than {min_gain:g} dB"
    else:
        why = f"{n_views} training views are too few to hold some out, so this comes as soon as it may"
    if iteration.n_halvings:
        state.pace = pace.with_decision(Decision(iteration.step, FINER, why, gain, error))
    else:
        decision = Decision(iteration.step, COOLED, why, gain, error)
        begin_cooling(state, iteration.cooling, iteration.iterations, decision)
    return why
