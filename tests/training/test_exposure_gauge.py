"""Refined exposures of any recipe keep their mean; learned ones, as released, do not."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.methods import get_recipe
from minisplat_ref.training.calibration import EXPOSURES, LEARNED, REFINED, TRACKS
from minisplat_ref.training.exposure_gauge import hold_mean_exposure
from minisplat_ref.training.loop import train
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.schedule import does

IDENTITY = np.eye(3, 4)


@pytest.fixture(scope="module")
def exposed():
    """Eight photographs with known exposures, of arithmetic mean 1."""
    scene = make_scene("room", supersampling=1, n_views=10, width=48, height=36, n_points=200).scene
    gains = np.linspace(0.8, 1.2, len(scene.train_views))
    views = zip(scene.train_views, gains, strict=True)
    return scene._replace(train_views=tuple(view._replace(log_gain=np.full(3, np.log(gain))) for view, gain in views))


def mean_exposure(scene, source):
    recipe = configure(get_recipe("3dgs-accel", 40), exposure=source)
    return train(scene, recipe, seed=0).shared[EXPOSURES].mean(axis=0)


def test_refined_exposures_keep_their_mean_and_learned_ones_drift(exposed):
    assert_allclose(mean_exposure(exposed, REFINED), IDENTITY, atol=1e-5)
    assert np.abs(mean_exposure(exposed, LEARNED) - IDENTITY).max() > 1e-3


def test_the_event_is_there_once_and_for_refined_exposures_alone():
    for name in ("3dgs-accel", "mini-splatting2", "adaptive"):
        recipe = get_recipe(name)
        for _ in range(2):  # configured twice
            recipe = configure(recipe, exposure=REFINED)
        assert sum(does(event, hold_mean_exposure) for event in recipe.events) == 1
    for source in (LEARNED, TRACKS):
        recipe = configure(get_recipe("mini-splatting2"), exposure=source)
        assert not any(does(event, hold_mean_exposure) for event in recipe.events)
