"""Smaller views at first: when, how small, and that each size is made once."""

import numpy as np
from numpy.testing import assert_array_equal

from minisplat_ref.io.scene import half_size
from minisplat_ref.methods import RECIPES
from minisplat_ref.training.pace import COOLED, FINER, Decision, Pace
from minisplat_ref.training.schedule import SmallerViews, scale_recipe
from minisplat_ref.training.smaller_views import ViewSizes
from tiny_training import PLAIN, scene  # noqa: F401  (a fixture)


def twice(scene):
    return 2


def sizes_of(scene, **dates):
    return ViewSizes(PLAIN._replace(events=(SmallerViews(twice, **dates),)), scene)


def test_between_two_iterations(scene):
    sizes = sizes_of(scene, start=1, until=3)
    assert [sizes.count_halvings(step, Pace()) for step in range(1, 6)] == [0, 2, 2, 0, 0]
    assert [len(sizes.record_start(step, 30)) for step in range(1, 6)] == [0, 1, 0, 0, 0]
    assert ViewSizes(PLAIN, scene).count_halvings(1, Pace()) == 0


def test_decisions_take_halvings_back(scene):
    """One for each decision to proceed; in the cool-down views are as they are."""
    sizes, pace, found = sizes_of(scene), Pace(), []
    for step in range(3):
        found.append(sizes.count_halvings(step + 1, pace))
        pace = pace.with_decision(Decision(step, FINER, "little is gained", 0.1, 0.1))
    assert found == [2, 1, 0] and sizes.count_halvings(9, pace) == 0
    cooling = Pace(cooling_from=1).with_decision(Decision(1, COOLED, "little is gained", 0.1, 0.1))
    assert sizes.count_halvings(2, cooling) == 0


def test_each_size_is_made_once(scene):
    sizes = sizes_of(scene)
    small = sizes.halve(2)
    assert sizes.halve(2) is small and sizes.halve(0) is scene
    for view, original in zip(small.train_views, scene.train_views, strict=True):
        assert_array_equal(view.image, half_size(half_size(original)).image)
        assert view.camera.width == original.camera.width // 4
    assert len(small.points) == len(scene.points) and np.isclose(small.extent, scene.extent)


def test_dates_are_scaled():
    (event,) = [
        event for event in scale_recipe(RECIPES["mini-splatting2"], 1_800).events if isinstance(event, SmallerViews)
    ]
    assert (event.start, event.until) == (0, 300)
    (event,) = [
        event for event in scale_recipe(RECIPES["mini-splatting2"], 2).events if isinstance(event, SmallerViews)
    ]
    assert event.until == 0 and not event.is_due(1)
