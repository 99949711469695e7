"""Compensated opacities, which ``adaptive`` switches on where photographs differ in resolution.

The effect of the compensation on a photograph is a field, b = compensated rendering - rendering, and its amount x is
fitted to each half of each photograph and judged on the other (:mod:`minisplat_ref.methods.adaptive.evidence`). Where
all photographs show things at the same size, the Gaussians have been trained with the low-pass, and x is the same for
all photographs. Where some show them smaller, by their resolution or from afar, x is larger for those than for the
others: then opacities are compensated from now on (:mod:`minisplat_ref.training.compensation`).
"""

from minisplat_ref.methods.adaptive.evidence import Answer, Evidence, pairs, render_clipped, split_halves, weigh
from minisplat_ref.training.compensation import compensate, compensation
from minisplat_ref.training.pace import trained_ids
from minisplat_ref.training.state import Iteration, TrainState


def antialiasing_evidence(state: TrainState, iteration: Iteration, view_ids: list[int]) -> Evidence:
    """Return the training views' evidence for individual amounts of compensation."""
    request = compensate(iteration.render_settings.request())
    photographs = []
    for view, photograph, rendered, is_counted in pairs(state, iteration, view_ids):
        field = render_clipped(state, iteration, view, request) - rendered
        photographs.append(split_halves(photograph - rendered, field[None], is_counted))
    return weigh(photographs)


def examine_antialiasing(state: TrainState, iteration: Iteration) -> Answer | str:
    """Return whether halves of photographs explain each other by different amounts of compensation."""
    if iteration.render_settings.conventions.is_antialiased:
        return "opacities are compensated"
    n_views = len(iteration.scene.train_views)
    evidence = antialiasing_evidence(state, iteration, trained_ids(n_views, iteration.cooling, state.pace))
    why = evidence.describe(f"opacities compensated by amounts that differ by {evidence.spread:.2f}")
    return Answer(evidence, why, lambda: compensation(n_views))
