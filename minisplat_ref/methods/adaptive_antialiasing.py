"""Compensated opacities, which ``adaptive`` switches on where photographs differ in resolution.

What the compensation would do to a photograph is a field, b = compensated rendering - rendering, and its amount x is
fitted to each half of each photograph and judged on the other (:mod:`minisplat_ref.methods.adaptive_evidence`). Where
all photographs show things at the same size, the Gaussians have learned what the low-pass adds, and no photograph wants
another x than the mean. Where some show them smaller, by their own size or from afar, those want more of it, and the
others less: then opacities are compensated from now on (:mod:`minisplat_ref.training.compensation`).
"""

from minisplat_ref.methods.adaptive_evidence import (
    Evidence,
    drawn,
    halves_of,
    pairs,
    plain_request,
    switch_on,
    weigh,
)
from minisplat_ref.training.calibration import ANTIALIASING
from minisplat_ref.training.compensation import COMPENSATION, compensated, compensation
from minisplat_ref.training.pace import Decision, trained_ids
from minisplat_ref.training.state import Iteration, TrainState


def antialiasing_evidence(state: TrainState, iteration: Iteration, view_ids: list[int]) -> Evidence:
    """Return the training views' evidence for individual amounts of compensation."""
    request = compensated(plain_request(iteration))
    photographs = []
    for view, photograph, rendered, is_counted in pairs(state, iteration, view_ids):
        field = drawn(state, iteration, view, request) - rendered
        photographs.append(halves_of(photograph - rendered, field[None], is_counted))
    return weigh(photographs)


def switch_antialiasing_on(state: TrainState, iteration: Iteration, *, min_antialiasing_gain: float) -> str | None:
    """Compensate opacities if halves of photographs explain each other by different amounts of it.

    Parameters
    ----------
    state, iteration
        As for every action.
    min_antialiasing_gain : float
        dB of the squared error that the photographs must gain on average, and more than the standard error.
    """
    if COMPENSATION in state.shared or iteration.conventions.is_antialiased:
        return "nothing done: opacities are compensated"
    n_views = len(iteration.scene.train_views)
    evidence = antialiasing_evidence(state, iteration, trained_ids(n_views, iteration.cooling, state.pace))
    why = f"amounts of compensation that spread by {evidence.spread:.2f} explain {evidence.gain:.2f} dB of other halves"
    if not evidence.is_above(min_antialiasing_gain):
        return f"nothing done: {why}"
    decision = Decision(iteration.step, "anti-aliasing", why, evidence.gain, evidence.standard_error)
    switch_on(state, ANTIALIASING, compensation(n_views), decision)
    return why
