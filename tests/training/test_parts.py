"""Recipes for a part of the scene: as many events and the same rates in fewer iterations, and a loss by its share."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from minisplat_ref.methods import get_recipe
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.training.losses import Rendered, photometric, photometric_of_part
from minisplat_ref.training.schedule import At, Every, compress_recipe, describe
from minisplat_ref.types import RenderOutput, View
from scenes import make_camera
from tolerances import PARITY_FLOAT64

HEIGHT, WIDTH = 12, 16


def dates(event, iterations):
    return [step for step in range(1, iterations + 1) if event.is_due(step)]


def test_periodic_events_act_as_often():
    """In a quarter of the iterations, too."""
    whole = get_recipe("3dgs-accel", 2400)
    part = compress_recipe(whole, 600)
    assert part.iterations == 600
    n_periodic = 0
    for of_whole, of_part in zip(whole.events, part.events, strict=True):
        if isinstance(of_whole, Every):
            n_periodic += 1
            expected, found = dates(of_whole, 2400), dates(of_part, 600)
            assert len(found) == len(expected) > 1
            assert_allclose(found, np.array(expected) / 4, atol=0.5)  # rounded to whole iterations
    assert n_periodic == 4  # growth, two ways to prune, reset


def test_a_shorter_training_of_the_whole_densifies_less_often():
    """What a part must not do: 3DGS itself keeps a distance between two densifications."""
    (densify, *_) = (event for event in get_recipe("3dgs-accel", 2400).events if isinstance(event, Every))
    (shorter, *_) = (event for event in get_recipe("3dgs-accel", 600).events if isinstance(event, Every))
    assert len(dates(shorter, 600)) < len(dates(densify, 2400))


def test_rates_stay():
    whole = get_recipe("mini-splatting2", 2400)  # raises its rates in short runs
    part = compress_recipe(whole, 600)
    for step in (1, 100, 600):
        ours, theirs = part.learning_rates.at(step, 3.0), whole.learning_rates.at(4 * step, 3.0)
        assert ours == pytest.approx(theirs, rel=PARITY_FLOAT64)
    (ours, *_), (theirs, *_) = ([e for e in r.events if isinstance(e, At)] for r in (part, whole))
    assert ours.step == round(theirs.step / 4)


def test_the_loss_counts_by_the_share_of_the_pixels():
    recipe = compress_recipe(get_recipe("3dgs-accel", 2400), 600)
    (term,) = recipe.losses
    assert term.function.func is photometric_of_part
    assert term.function.keywords == {"dssim_weight": 0.2}
    assert "photometric_of_part" in str(describe(recipe))


@pytest.mark.parametrize("has_mask", [True, False])
def test_parts_of_a_photograph_weigh_as_much_as_the_whole(rng, has_mask):
    """Without SSIM, which also sees the neighbours, losses and gradients of two halves add up to those of the whole."""
    image, target = rng.uniform(size=(HEIGHT, WIDTH, 3)), rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    left = np.arange(WIDTH)[None] + np.zeros((HEIGHT, 1)) < 5
    masks = (left, ~left) if has_mask else (None,)

    def rendered(mask):
        output = RenderOutput(image, np.ones((HEIGHT, WIDTH)), None, None)
        view = View("a", make_camera(WIDTH, HEIGHT), target, mask)
        return Rendered(output, {"rgb": slice(0, 3)}, view, None, None, 1, Request(np.zeros(3), backend=REFERENCE))

    loss, v = photometric(rendered(None), dssim_weight=0.0)
    parts = [photometric_of_part(rendered(mask), dssim_weight=0.0) for mask in masks]
    assert_allclose(sum(part for part, _ in parts), loss, rtol=PARITY_FLOAT64)
    assert_allclose(sum(v.channels["rgb"] for _, v in parts), v.channels["rgb"], rtol=PARITY_FLOAT64)
