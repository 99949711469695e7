"""A training on a scene of four tiny images, for the tests of the loop and of what interrupts it."""

from functools import partial

import numpy as np
import pytest

from minisplat_ref.methods import RECIPES, gaussian_splatting
from minisplat_ref.rendering import render
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.training.loop import train
from minisplat_ref.training.schedule import During, Every
from minisplat_ref.types import Scene, View
from scenes import as_dtype, make_camera, make_gaussians

N_VIEWS, N_GAUSSIANS = 4, 30

# Every kind of event within 40 iterations.
EVENTS = (
    During(gaussian_splatting.collect_gradients, stop=30),
    Every(10, partial(gaussian_splatting.clone_and_split, threshold=2e-3, size_fraction=0.15), start=5, stop=30),
    Every(10, partial(gaussian_splatting.prune_faint, min_opacity=0.005), start=5, stop=30),
    Every(10, partial(gaussian_splatting.prune_large, size_fraction=2.0), start=15, stop=30),
    Every(25, partial(gaussian_splatting.reset_opacity, ceiling=0.05)),
)
RECIPE = RECIPES["3dgs-accel"]._replace(iterations=40, sh_degree=1, sh_milestones=(10,), events=EVENTS)
PLAIN = RECIPE._replace(iterations=60, events=())


@pytest.fixture(scope="module")
def scene():
    """Images of 30 Gaussians, and their centres with wrong colours as the points to start from."""
    rng = np.random.default_rng(5)
    truth = as_dtype(make_gaussians(rng, N_GAUSSIANS), np.float32)
    views = []
    for i in range(N_VIEWS):
        camera = make_camera(24, 16, rng=rng)
        image = render(truth, camera, background=np.array([0.0, 0.2, 0.4]), backend=REFERENCE)[0].image
        views.append(View(f"view{i}", camera, np.round(255 * np.clip(image, 0, 1)).astype(np.uint8), None))
    colors = rng.integers(0, 256, (N_GAUSSIANS, 3), np.uint8)
    return Scene("tiny", tuple(views), (), truth.means.astype(float), colors, np.array([0.0, 0.2, 0.4]), 1.0)


@pytest.fixture(scope="module")
def uninterrupted(scene):
    return train(scene, RECIPE, seed=3)


def all_arrays(state):
    return {
        **{f"p.{name}": field for name, field in state.gaussians._asdict().items()},
        **{f"m.{name}": field for name, field in state.adam.first._asdict().items()},
        **{f"v.{name}": field for name, field in state.adam.second._asdict().items()},
        **state.stats,
    }


def assert_same_bytes(state, other):
    assert (state.step, state.adam.step, state.view_order) == (other.step, other.adam.step, other.view_order)
    assert state.rng.bit_generator.state == other.rng.bit_generator.state
    arrays, others = all_arrays(state), all_arrays(other)
    assert arrays.keys() == others.keys()
    for name, array in arrays.items():
        assert array.dtype == others[name].dtype and array.tobytes() == others[name].tobytes(), name
