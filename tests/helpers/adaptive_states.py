"""A training by ``adaptive`` in mid-run, for the tests of what it decides about its photographs."""

import numpy as np

from minisplat_ref.methods.adaptive.recipe import ADAPTIVE
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.state import Iteration

HOLDING = configure(ADAPTIVE, hold_out_from=0)
"""Holds two views out of the few that a quick test has."""


def state_of(scene, truth):
    """A training that has come to the truth, with moments for each of its Gaussians."""
    state = initial_state(scene, ADAPTIVE, 0)
    state.gaussians = type(truth)(*(field.copy() for field in truth))
    state.adam = zero_moments(state.gaussians)
    return state


def iteration_of(scene, step=600):
    """An iteration whose view and rendering no decision uses."""
    return Iteration(
        *(scene, scene.train_views[0], None, np.zeros(0, int), None, RenderSettings(scene.background)),
        step=step,
        iterations=30_000,
        cooling=HOLDING.cooling,
    )
