"""Training on smaller views at first: the number of halvings in each iteration, and the halved views.

A recipe has an event for it (:class:`minisplat_ref.training.schedule.SmallerViews`). It ends at a given iteration
(Mini-Splatting2), or the training takes the halvings back one by one when it decides to (``adaptive``).
"""

import math

from minisplat_ref.errors import InputError
from minisplat_ref.io.scene import half_size
from minisplat_ref.training.pace import Pace
from minisplat_ref.training.schedule import Recipe, SmallerViews, action_name
from minisplat_ref.training.state import FiredEvent
from minisplat_ref.types import Scene

SIDE_MIN = 16  # pixels: a tile


def halve_large_views(scene: Scene, *, min_side: float, max_halvings: float = math.inf) -> int:
    """Return the number of halvings at first, the largest that leaves no side shorter than ``min_side``.

    Parameters
    ----------
    scene : Scene
        Its views as they are.
    min_side : float
        Pixels.
    max_halvings : int
        At most this many times; no limit by default.

    Raises
    ------
    InputError
        ``min_side`` is too small for an image.
    """
    if not min_side >= SIDE_MIN:
        raise InputError(f"min_side is {min_side}: give at least {SIDE_MIN} pixels")
    side = min(min(view.camera.width, view.camera.height) for view in scene.train_views)
    times = 0
    while times < max_halvings and side >= 2 ** (times + 1) * min_side:
        times += 1
    return times


class ViewSizes:
    """The scene with its training views at the size of each iteration.

    Parameters
    ----------
    recipe : Recipe
    scene : Scene
        Its views as they are.
    """

    def __init__(self, recipe: Recipe, scene: Scene) -> None:
        events = [event for event in recipe.events if isinstance(event, SmallerViews)]
        self._planned = [(event, event.action(scene)) for event in events]
        self._scenes = {0: scene}

    def count_halvings(self, step: int, pace: Pace) -> int:
        """Return the number of halvings of the views in an iteration, counted from 1."""
        if pace.cooling_from is not None:
            return 0
        return max([0, *(times - pace.n_finer for event, times in self._planned if event.is_due(step))])

    def halve(self, n_halvings: int) -> Scene:
        """Return the scene with its training views halved this many times in width and height."""
        if n_halvings not in self._scenes:
            views = self._scenes[0].train_views
            for _ in range(n_halvings):
                views = tuple(map(half_size, views))
            self._scenes = {0: self._scenes[0], n_halvings: self._scenes[0]._replace(train_views=views)}
        return self._scenes[n_halvings]

    def record_start(self, step: int, n_gaussians: int) -> list[FiredEvent]:
        """Return the record that views are halved from this iteration on."""
        return [
            FiredEvent(action_name(event), n_gaussians, n_gaussians, 0.0, _describe(event, times))
            for event, times in self._planned
            if times and step == event.start + 1 and event.is_due(step)
        ]


def _describe(event: SmallerViews, times: int) -> str:
    until = "" if event.until is None else f" until iteration {event.until}"
    return f"to 1/{2**times} of their size{until}"
