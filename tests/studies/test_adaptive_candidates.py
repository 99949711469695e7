"""Rules that ``adaptive`` lacks: what each of them does, in small."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from adaptive_states import iteration_of
from minisplat_ref.methods.adaptive.recipe import ADAPTIVE
from minisplat_ref.studies.adaptive_candidates import (
    CANDIDATES,
    mean_opacity,
    mean_scale,
    remove_near_cameras,
)
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.losses import Rendered
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import Model, Scene, view_from
from scenes import make_camera, make_gaussians
from tolerances import CLOSED_FORM, GRADIENT_REL


def scene_with(camera):
    return Scene("one", (view_from(camera),), (), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(3), 2.0)


def test_what_is_near_large_and_in_the_picture_goes(rng):
    """Depths 1 and 10 around a median of 10; of the near ones, one is small, one beside the picture, one behind."""
    camera = make_camera(rng=rng)._replace(cam_from_world_R=np.eye(3), cam_from_world_t=np.zeros(3))
    gaussians = make_gaussians(rng, 9)
    gaussians.means[:] = [0.0, 0.0, 10.0]
    gaussians.means[:4] = [[0, 0, 1], [0, 0, 1], [50, 0, 1], [0, 0, -1]]
    gaussians.log_scales[:] = np.log(0.5)
    gaussians.log_scales[1] = np.log(1e-3)
    state = TrainState(gaussians, zero_moments(gaussians), 0, [], rng, {})
    note = remove_near_cameras(state, iteration_of(scene_with(camera)), nearness=0.25, part=0.05)
    assert note == "1 removed"
    assert_array_equal(state.gaussians.means, gaussians.means[1:])
    assert len(state.adam.first.means) == 8


@pytest.mark.parametrize(("loss", "field"), [(mean_opacity, "opacity_logits"), (mean_scale, "log_scales")])
def test_gradient_of_the_losses(rng, loss, field):
    gaussians, scene = make_gaussians(rng, 6), scene_with(make_camera(rng=rng))

    def value(moved):
        changed = gaussians._replace(**{field: moved})
        return loss(Rendered(None, {}, None, scene, Model(changed), 1, None))

    x = getattr(gaussians, field)
    direction, step = rng.normal(size=x.shape), 1e-6
    numeric = (value(x + step * direction)[0] - value(x - step * direction)[0]) / (2 * step)
    (v,) = value(x)[1].gaussians.values()
    assert abs(numeric) > 1e-4
    assert_allclose(np.vdot(v, direction), numeric, rtol=GRADIENT_REL)


def test_mean_scale_by_hand(rng):
    gaussians = make_gaussians(rng, 2)._replace(log_scales=np.log([[1.0, 2.0, 3.0], [4.0, 5.0, 9.0]]))
    value, _ = mean_scale(Rendered(None, {}, None, scene_with(make_camera(rng=rng)), Model(gaussians), 1, None))
    assert value == pytest.approx(4.0 / 2.0, rel=CLOSED_FORM)


def test_each_candidate_is_adaptive_and_one_rule_more():
    recipes = {name: change(ADAPTIVE) for name, change in CANDIDATES.items()}
    assert recipes["adaptive"] == ADAPTIVE
    for name, recipe in recipes.items():
        differing = [field for field in recipe._fields if getattr(recipe, field) != getattr(ADAPTIVE, field)]
        assert len(differing) == (name != "adaptive"), name
