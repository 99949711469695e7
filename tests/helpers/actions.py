"""What an action of a recipe is given, made by hand instead of by a training."""

import numpy as np

from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.schedule import does
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import Scene, View


def scene_of(cameras=(), extent=1.0):
    """A scene of black photographs without points."""
    views = tuple(
        View(f"view{i}", camera, np.zeros((camera.height, camera.width, 3), np.uint8), None)
        for i, camera in enumerate(cameras)
    )
    return Scene("by hand", views, (), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(3), extent)


def state_of(gaussians, **stats):
    """A training state of these Gaussians, with moments of zero."""
    return TrainState(gaussians, zero_moments(gaussians), 0, [], np.random.default_rng(0), stats)


def act(recipe, action, state, scene):
    """Let a recipe act on the state once, with the settings that it binds to the action; return the action's note."""
    (event,) = (event for event in recipe.events if does(event, action))
    return event.action(state, Iteration(scene, *[None] * 4))
