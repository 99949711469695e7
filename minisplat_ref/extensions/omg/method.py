"""The event that prunes what is neither important nor distinct, and the recipe that uses it."""

from functools import partial

import numpy as np

from minisplat_ref.extensions.omg.reference import distinct_importance, local_distinctiveness
from minisplat_ref.methods.mini_splatting import (
    MINI_SPLATTING,
    ImportanceMetric,
    candidates,
    measure_importance,
    prune_tail,
)
from minisplat_ref.strategy import importance
from minisplat_ref.strategy.ops import keep
from minisplat_ref.training.schedule import action_name
from minisplat_ref.training.state import Iteration, TrainState, apply_edit

POWER = 2.0  # lambda
MASS = 0.99  # tau of the paper's model M; XS has 0.96, XL 0.9999


def prune_indistinct(
    state: TrainState, iteration: Iteration, *, metric: ImportanceMetric, distinct_mass: float, distinct_power: float
) -> str | None:
    """Keep the Gaussians of the largest scores that together carry the fraction ``distinct_mass`` of the sum.

    The score is ``importance distinctiveness^distinct_power``; Gaussians that dominate no pixel of a training view have
    none.
    """
    stats = measure_importance(state, iteration)
    important = candidates(stats, metric, 0, is_intersecting=True)  # [N]
    distinctiveness = local_distinctiveness(state.gaussians.means, state.gaussians.sh_dc)
    score = distinct_importance(important, distinctiveness, distinct_power)
    if not score.any():
        return "nothing done: all colours are alike"
    apply_edit(state, keep(state.gaussians, np.flatnonzero(importance.mass_mask(score, distinct_mass))))
    return None


_prune = partial(prune_indistinct, metric=importance.indoor, distinct_mass=MASS, distinct_power=POWER)

OMG = MINI_SPLATTING._replace(
    name="omg",
    events=tuple(
        event._replace(action=_prune) if action_name(event) == prune_tail.__name__ else event
        for event in MINI_SPLATTING.events
    ),
)
"""The recipe ``omg``: Mini-Splatting whose last pruning also considers distinctiveness."""
