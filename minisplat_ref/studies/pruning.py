"""Other ways to prune in ``adaptive``'s cool-down, for the study that takes its rules out one by one.

*By blend weight*, at once: what carries the last 2 % of it goes, as Mini-Splatting's prunes do with the last 1 %.

*By the exact change of the squared error*, in the same slices: S - o dSSE/do, with the gradient that
:mod:`minisplat_ref.reference.removal` leaves out.
"""

from functools import partial
from typing import Any

import numpy as np

from minisplat_ref.methods.adaptive.numbers import SLICE_MIN
from minisplat_ref.methods.adaptive.prune import prune_in_slices, prune_seen_by_few, slice_due
from minisplat_ref.methods.mini_splatting import prune_tail
from minisplat_ref.strategy.importance import indoor
from minisplat_ref.strategy.ops import keep, n_rows
from minisplat_ref.strategy.removal import CHANGES, RemovalCosts, worth_their_place
from minisplat_ref.training.schedule import Recipe, does, settings_of
from minisplat_ref.training.state import Iteration, TrainState, apply_edit

MASS = 0.98


def with_pruning_by(recipe: Recipe, action: Any) -> Recipe:
    """Return the recipe with another action in place of its own prune, with the same settings."""
    settings = {name: settings_of(recipe)[name] for name in ("min_views", "min_slope", "max_pruned")}
    own = partial(action, **settings)
    events = (event._replace(action=own) if does(event, prune_in_slices) else event for event in recipe.events)
    return recipe._replace(events=tuple(events))


def prune_by_weight(
    state: TrainState, iteration: Iteration, *, min_views: int, min_slope: float, max_pruned: float
) -> None:
    """Keep what carries 98 % of the blend weight, at the first slice; ``min_slope``, ``max_pruned`` are not used."""
    if slice_due(state.pace, iteration.step) == 0:
        prune_tail(state, iteration, metric=indoor, mass=MASS, min_views=min_views, is_intersecting=False)


def prune_by_exact_change(
    state: TrainState, iteration: Iteration, *, min_views: int, min_slope: float, max_pruned: float
) -> None:
    """Prune as :func:`~minisplat_ref.methods.adaptive.prune.prune_in_slices`, with the gradient subtracted from S."""
    number = slice_due(state.pace, iteration.step)
    if number is None:
        return
    if number == 0:
        prune_seen_by_few(state, iteration, min_views)
    n = n_rows(state.gaussians)
    rows = worth_their_place(exact_costs(state, iteration), min_slope, max_pruned)
    if n - len(rows) >= SLICE_MIN * n:
        apply_edit(state, keep(state.gaussians, rows))


def exact_costs(state: TrainState, iteration: Iteration) -> RemovalCosts:
    """Return the exact change of the squared error by each removal in place of S, where alpha is not clamped.

    Masks are left out, as they are in S.
    """
    changes, squared_error = np.zeros(n_rows(state.gaussians)), 0.0
    logits = state.gaussians.opacity_logits.astype(np.float64)
    settings = iteration.render_settings
    for view in iteration.scene.train_views:
        photographed = view.load()
        output, tape = settings.render(state.model, photographed, frozenset({CHANGES}))
        residual = output.image - photographed.image / np.float32(255.0)
        v_logits = settings.renderer.render_vjp(tape, 2 * residual, None).gaussians.opacity_logits
        changes += output.extras[CHANGES] - v_logits * (1 + np.exp(logits))  # v_logit = o (1 - o) v_o
        squared_error += float(np.sum(residual**2, dtype=np.float64))
    return RemovalCosts(changes, squared_error)
