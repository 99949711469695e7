"""Fine-tuning: a training that begins with a population instead of the points of a scene."""

from typing import Any

import numpy as np

from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.loop import train
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import Scene


def fine_tune(
    population: Any,
    scene: Scene,
    recipe: Recipe,
    rng: np.random.Generator | int,
    on_step: Any = None,
    **arguments: Any,
) -> Any:
    """Return a population after a training that begins with it; the given one is not changed.

    Parameters
    ----------
    population : Gaussians or a relative's population
    scene : Scene
    recipe : Recipe
        Of the length of the fine-tuning. :func:`drop_events` keeps the number as it is.
    rng : Generator or int
        Source of the random numbers of events and of the order of views; or its seed.
    on_step : callable, optional
        Called after each iteration.
    **arguments
        Others of :func:`~minisplat_ref.training.loop.train`.
    """
    copy = type(population)(*(np.ascontiguousarray(field).copy() for field in population))
    generator = np.random.default_rng(rng) if isinstance(rng, int) else rng
    state = TrainState(copy, zero_moments(copy), step=0, view_order=[], rng=generator, stats={})
    return train(scene, recipe, seed=0, state=state, on_step=on_step, **arguments).gaussians


def drop_events(recipe: Recipe) -> Recipe:
    """Return the recipe for fine-tuning: the number of Gaussians stays, and all stored harmonics are trained."""
    return recipe._replace(events=(), sh_milestones=(0,) * recipe.sh_degree)
