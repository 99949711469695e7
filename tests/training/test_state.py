"""Actions on the training state: rows, moments and statistics stay in step."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.methods import gaussian_splatting
from minisplat_ref.strategy.ops import NO_PARENT, Edit, n_rows, take
from minisplat_ref.training.adam import AdamState
from minisplat_ref.training.state import Iteration, TrainState, apply_edit
from scenes import make_camera, make_gaussians
from tolerances import CLOSED_FORM

N = 4


@pytest.fixture
def state(rng):
    """Moments that say which row and which field they belong to."""
    gaussians = make_gaussians(rng, N)._replace(log_scales=np.log(np.full((N, 3), 0.05)))
    first = gaussians._make(np.zeros_like(f) + np.arange(1, N + 1).reshape(-1, *[1] * (f.ndim - 1)) for f in gaussians)
    second = gaussians._make(10 * f for f in first)
    return TrainState(gaussians, AdamState(first, second, 5), 7, [1, 0], rng, {})


def make_iteration(v_means2d=None, visible_ids=(), *, background=0.0, extent=10.0):
    view = SimpleNamespace(camera=make_camera(40, 20))
    scene = SimpleNamespace(extent=extent, background=np.full(3, background), train_views=(view,))
    return Iteration(scene, view, None, np.array(visible_ids, int), v_means2d)


def test_gradients_are_collected_where_visible(state):
    v_means2d = np.array([[1.0, 0], [np.nan, 0], [0, 1.0], [0, 0]])  # row 1 is not visible
    gaussian_splatting.collect_gradients(state, make_iteration(v_means2d, [0, 2, 3]))
    gaussian_splatting.collect_gradients(state, make_iteration(2 * v_means2d, [2]))
    assert_allclose(state.stats["gradient_sum"], [20, 0, 10 + 20, 0], rtol=CLOSED_FORM)
    assert_array_equal(state.stats["view_count"], [1, 0, 2, 1])


def test_densification_averages_over_the_views_that_saw_it(state):
    """Row 0 was seen once with 3, row 1 twice with 3 in all: only row 0 reaches 2."""
    state.stats = {"gradient_sum": np.array([3.0, 3.0, 0, 0]), "view_count": np.array([1, 2, 0, 1])}
    gaussian_splatting.clone_and_split(state, make_iteration(), threshold=2.0, size_fraction=0.01)
    assert n_rows(state.gaussians) == N + 1
    assert_array_equal(state.gaussians.means[N], state.gaussians.means[0])
    assert_array_equal(state.adam.first.opacity_logits, [1, 2, 3, 4, 0])
    assert_array_equal(state.adam.second.sh_rest[:, 0, 0], [10, 20, 30, 40, 0])
    assert state.stats == {}  # collected again
    assert state.adam.step == 5


def test_size_limit_is_a_fraction_of_the_extent(state):
    state.stats = {"gradient_sum": np.ones(N), "view_count": np.ones(N)}
    gaussian_splatting.clone_and_split(
        state, make_iteration(extent=4.0), threshold=1.0, size_fraction=0.01
    )  # 0.05 > 0.04: split
    assert n_rows(state.gaussians) == 2 * N
    assert_array_equal(state.adam.first.means, np.zeros((2 * N, 3)))
    gaussian_splatting.prune_large(state, make_iteration(extent=0.3), size_fraction=0.1)  # 0.05 / 1.6 > 0.03
    assert n_rows(state.gaussians) == 0


def test_pruning_keeps_moments_and_statistics_in_step(state):
    state.stats = {"view_count": np.arange(N), "is_blurred": np.eye(N, dtype=bool)}
    state.gaussians.opacity_logits[:] = [0.0, -9.0, 0.0, -9.0]
    kept = take(state.gaussians, np.array([0, 2]))
    gaussian_splatting.prune_faint(state, make_iteration(), min_opacity=0.005)
    for field, expected in zip(state.gaussians, kept, strict=True):
        assert_array_equal(field, expected)
    assert_array_equal(state.adam.first.quats[:, 0], [1, 3])
    assert_array_equal(state.stats["view_count"], [0, 2])
    assert_array_equal(state.stats["is_blurred"], np.eye(N, dtype=bool)[[0, 2]])


def test_statistics_follow_parents_but_moments_begin_anew(state):
    state.stats = {"factor": np.arange(1.0, N + 1)}
    parent_ids, is_new = np.array([1, 1, NO_PARENT]), np.array([False, True, True])
    apply_edit(state, Edit(take(state.gaussians, np.array([1, 1, 0])), parent_ids, is_new))
    assert_array_equal(state.adam.first.opacity_logits, [2, 0, 0])
    assert_array_equal(state.stats["factor"], [2, 2, 0])


def test_opacity_reset_forgets_only_the_moments_of_opacity(state):
    gaussian_splatting.reset_opacity(state, make_iteration(), ceiling=0.01)
    assert np.all(1 / (1 + np.exp(-state.gaussians.opacity_logits)) <= 0.01 * (1 + CLOSED_FORM))
    assert not state.adam.first.opacity_logits.any() and not state.adam.second.opacity_logits.any()
    assert_array_equal(state.adam.first.sh_dc[:, 0], [1, 2, 3, 4])


@pytest.mark.parametrize(("background", "is_reset"), [(0.0, False), (1.0, True)])
def test_early_reset_is_for_white_backgrounds(state, background, is_reset):
    before = state.gaussians.opacity_logits.copy()
    note = gaussian_splatting.reset_opacity_on_white(state, make_iteration(background=background), ceiling=0.01)
    assert note == (None if is_reset else "nothing done: the background is not white")
    assert np.any(state.gaussians.opacity_logits != before) == is_reset
