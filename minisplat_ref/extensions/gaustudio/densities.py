"""The stage ``density``: the treatment of Gaussians whose images move, at the dates of 3DGS."""

import numpy as np

from minisplat_ref.methods.gaussian_splatting import clone_and_split
from minisplat_ref.strategy.halving import halves as halve
from minisplat_ref.training.state import Iteration, TrainState, apply_edit

THRESHOLD, SIZE_FRACTION = 2e-4, 0.01  # of 3DGS


def clones(state: TrainState, iteration: Iteration) -> str | None:
    """Small ones are cloned, large ones split in two at random, as in 3DGS."""
    return clone_and_split(state, iteration, threshold=THRESHOLD, size_fraction=SIZE_FRACTION)


def halves(state: TrainState, iteration: Iteration) -> str | None:
    """Each is replaced by two halves that look the same together."""
    means = state.stats.pop("gradient_sum") / np.maximum(state.stats.pop("view_count"), 1)
    apply_edit(state, halve(state.gaussians, np.flatnonzero(means >= THRESHOLD)))
    return None


def fixed(state: TrainState, iteration: Iteration) -> str | None:
    """Nothing: there are never more than at the start."""
    return "nothing done: the number is fixed"
