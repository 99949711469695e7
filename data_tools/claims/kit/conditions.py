"""Conditions under which claims train a scene: as it is, with few photographs, and with a known defect.

A disturbance is the same for every recipe and seed, so that trainings under one condition differ in nothing else.
(:mod:`data_tools.claims.defects` plants another one in every trial.) Test views stay as they are but under ``sky``.

=============  =====================================================================================================
``whole``      the scene as it is
``few``        every fifth training photograph
``gains``      each training photograph is multiplied by its own gain
``few-gains``  both
``poses``      each training camera is rotated by half a pixel
``sizes``      every second training photograph has half the width and height
``sky``        what is high becomes sky, in the test views, too (synthetic scenes)
=============  =====================================================================================================
"""

from collections.abc import Callable, Mapping

import numpy as np

from data_tools.claims.defects import halve, multiply, under_a_sky, with_rotated_cameras
from minisplat_ref.errors import InputError
from minisplat_ref.types import Scene

FEW = 5  # one in this many training photographs remains
GAINS = (0.7, 1.4)  # of a photograph, uniform in the logarithm


def few_photographs(scene: Scene) -> Scene:
    """Return the scene with every fifth training photograph."""
    return scene._replace(train_views=scene.train_views[::FEW])


def random_gains(scene: Scene) -> Scene:
    """Return the scene with every training photograph multiplied by its own gain."""
    low, high = np.log(GAINS)
    return multiply(scene, np.exp(np.random.default_rng(0).uniform(low, high, len(scene.train_views))))


CONDITIONS: Mapping[str, Callable[[Scene], Scene]] = {
    "whole": lambda scene: scene,
    "few": few_photographs,
    "gains": random_gains,
    "few-gains": lambda scene: random_gains(few_photographs(scene)),
    "poses": lambda scene: with_rotated_cameras(scene, np.random.default_rng(0)),
    "sizes": lambda scene: halve(scene, np.arange(len(scene.train_views)) % 2 == 1),
    "sky": lambda scene: under_a_sky(scene, np.random.default_rng(0)),
}


def get_condition(name: str) -> Callable[[Scene], Scene]:
    """Return the function that puts a scene under the condition of that name.

    Raises
    ------
    InputError
        There is none.
    """
    if name not in CONDITIONS:
        raise InputError(f"condition {name!r} does not exist: choose from {', '.join(CONDITIONS)}")
    return CONDITIONS[name]
