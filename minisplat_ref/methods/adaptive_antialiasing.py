"""Compensated opacities, which ``adaptive`` switches on where photographs differ in resolution.

What the compensation would do to a photograph is a field, b = compensated rendering - rendering, and its amount x is
fitted to each half of each photograph and judged on the other (:mod:`minisplat_ref.methods.adaptive_evidence`). Where
all photographs show things at the same size, the Gaussians have learned what the low-pass adds, and no photograph wants
another x than the mean. Where some show them smaller, by their own size or from afar, those want more of it, and the
others less: then opacities are compensated from now on (:mod:`minisplat_ref.training.compensation`).
"""

import numpy as np

from minisplat_ref.methods.adaptive_evidence import Evidence, halves_of, switch_on, weigh
from minisplat_ref.rendering import Request
from minisplat_ref.training.calibration import ANTIALIASING
from minisplat_ref.training.compensation import COMPENSATION, compensated, compensation
from minisplat_ref.training.pace import Decision, trained_ids
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import Bools


def antialiasing_evidence(state: TrainState, iteration: Iteration, view_ids: list[int]) -> Evidence:
    """Return the training views' evidence for individual amounts of compensation."""
    request = Request(iteration.scene.background, conventions=iteration.conventions, backend=iteration.backend)
    photographs = []
    for index in view_ids:
        view = iteration.scene.train_views[index].loaded()
        rendered, other = (
            np.clip(iteration.renderer.render(state.model, view, asked)[0].image, 0.0, 1.0)
            for asked in (request, compensated(request))
        )
        counted: Bools = np.ones(rendered.shape[:2], bool) if view.mask is None else view.mask
        photographs.append(halves_of(view.image / np.float32(255.0) - rendered, (other - rendered)[None], counted))
    return weigh(photographs)


def switch_antialiasing_on(state: TrainState, iteration: Iteration, *, least_antialiasing_gain: float) -> str | None:
    """Compensate opacities if halves of photographs explain each other by different amounts of it.

    Parameters
    ----------
    state, iteration
        As for every action.
    least_antialiasing_gain : float
        dB of the squared error that the photographs must gain on average, and more than the standard error.
    """
    if COMPENSATION in state.shared or iteration.conventions.is_antialiased:
        return "nothing done: opacities are compensated"
    n_views = len(iteration.scene.train_views)
    evidence = antialiasing_evidence(state, iteration, trained_ids(n_views, iteration.cooling, state.pace))
    why = f"amounts of compensation that spread by {evidence.spread:.2f} explain {evidence.gain:.2f} dB of other halves"
    if not evidence.is_above(least_antialiasing_gain):
        return f"nothing done: {why}"
    decision = Decision(iteration.step, "anti-aliasing", why, evidence.gain, evidence.standard_error)
    switch_on(state, ANTIALIASING, compensation(n_views), decision)
    return why
