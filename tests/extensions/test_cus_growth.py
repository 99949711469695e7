"""The growing of anchors in CUS-GS: collected gradients, voxels, levels and dates by hand, and a run that grows."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.app.cli import main
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.extensions import cus
from minisplat_ref.extensions.cus.model import ANCHORS, as_anchors, at_rest, voxel_side
from minisplat_ref.extensions.cus.recipe import (
    COUNT,
    SUM,
    THRESHOLD,
    collect_gradients_of_children,
    find_candidates,
    grow,
    grow_anchors,
    prune_insignificant,
)
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.strategy.clone_split import screen_gradient_norms
from minisplat_ref.strategy.initialization import initial_gaussians
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.schedule import does, firing_steps
from minisplat_ref.training.state import Iteration
from minisplat_ref.types import Model, RenderOutput, view_from
from scenes import make_camera, make_gaussians
from tolerances import CLOSED_FORM

SMALL = {"children": 2, "latent": 3, "hidden": 4, "embedding": 2, "query": 3}
FAR = 100.0  # where the anchors are whose Gaussians are near the origin


class Merciful:
    """Eliminates nothing."""

    def __init__(self, rng):
        self.uniform = rng.uniform

    def random(self, n):
        return np.ones(n)


def anchors_of(points, rng):
    """One anchor far away for every two points, at which its Gaussians are."""
    points = np.asarray(points, float).reshape(-1, 6)
    n = len(points)
    centers = np.full((n, 3), FAR) + np.arange(n)[:, None]
    made = at_rest(centers, rng.normal(size=(n, 3)), rng.normal(size=(n, 4)), 1.0, 2, rng)
    return made._replace(offsets=points - np.tile(centers, 2))  # spread over a voxel of side 1


def iteration_of(scene, v_means2d):
    output = RenderOutput(np.zeros((1, 1, 3)), np.zeros((1, 1)), None, None)
    return Iteration(scene, scene.train_views[0], output, np.zeros(0, np.int64), v_means2d)


@pytest.fixture(scope="module")
def scene():
    return make_scene("room", n_views=6, width=48, height=40, supersampling=1, n_points=60).scene


@pytest.fixture
def state(scene):
    return initial_state(scene, configure(find_recipe("cus"), **SMALL), seed=0)


# Gradients


def test_gradients_of_children_are_those_of_their_gaussians(rng):
    g = as_anchors(make_gaussians(rng, 6, sh_degree=0), rng, voxel=1.0, children=3, latent=2)
    view, request = view_from(make_camera()), Request(backend=CPU)
    output, tape = ANCHORS.renderer.render(Model(g), view, request)
    v_image = rng.normal(size=output.image.shape)
    _, plain = SPLATTING.render(Model(tape.decoded.gaussians), view, request)
    expected = SPLATTING.render_vjp(plain, v_image, None).means2d
    found = ANCHORS.renderer.render_vjp(tape, v_image, None).means2d
    assert_array_equal(found.reshape(-1, 2), expected)
    assert np.abs(expected).max() > 0.01 and found.shape == (len(g.means), 6)


def test_density_control_of_3dgs_sees_the_sum_over_children():
    v = np.array([[1.0, 2, 3, -1], [0, 0, 0.5, 0]])
    assert_allclose(screen_gradient_norms(v, 10, 20), [np.hypot(5 * 4, 10 * 1), 2.5], rtol=CLOSED_FORM)


def test_gradients_are_collected_by_hand(scene, state):
    """Photographs are 48 x 40: a gradient of 2 per pixel along a row is 48, one of 1 along a column 20."""
    v = np.zeros((len(state.gaussians.means), 4))
    v[3] = [2, 0, 0, -1]
    collect_gradients_of_children(state, iteration_of(scene, v), growth_threshold=1e-3)
    v[3] = [0, 0, 0, 0.5]
    v[5] = [1, 0, 0, 0]
    collect_gradients_of_children(state, iteration_of(scene, v), growth_threshold=1e-3)
    assert_allclose(state.stats[SUM][[3, 5]], [[48, 30], [24, 0]], rtol=CLOSED_FORM)
    assert_array_equal(state.stats[COUNT][[3, 5]], [[1, 2], [1, 0]])
    assert state.stats[SUM].sum() == 102 and state.stats[COUNT].sum() == 4


# The rule


def test_voxels_by_hand():
    """Voxels of side 2 have their centres at even places; the mean of two gradients counts, not their sum."""
    points = np.array([[0.9, 0, 0], [-0.9, 0.2, 0], [2.1, 0, 0], [2.2, 0, 0], [4.0, 0, -3.1], [6, 0, 0]])
    gradients = np.array([1.0, 3, 4, 2, 2.1, 9])
    found = find_candidates(points, gradients, np.array([[6.9, 0.9, 0]]), 2.0, 2.0)
    assert_allclose(found.centers, [[2, 0, 0], [4, 0, -4]])  # the first has a mean of 2, the last an anchor
    assert_array_equal(found.parent_ids, [2, 4])
    lower = find_candidates(points, gradients, np.zeros((0, 3)), 2.0, 1.9)
    assert_allclose(lower.centers, [[0, 0, 0], [2, 0, 0], [4, 0, -4], [6, 0, 0]])
    assert_array_equal(lower.parent_ids, [1, 2, 4, 5])


def test_levels_by_hand(rng):
    """Sides are 16, 4 and 1, thresholds 1, 2 and 4; Gaussians that no view saw have no voice."""
    points = [[5.9, 0, 0], [30, 0, 0], [50.6, 0, 0], [49, 0, 0]]  # the last, unseen, in the third's voxel
    anchors = anchors_of(points, rng)
    gradients = np.array([[5.0, 3.0], [1.5, np.nan]])
    edit = grow(anchors, gradients, 1.0, 1.0, Merciful(rng))
    # at the second level the place 30 / 4 = 7.5 is rounded to 8, where the first level has put an anchor
    centers = [[0, 0, 0], [32, 0, 0], [48, 0, 0], [4, 0, 0], [6, 0, 0]]
    assert_allclose(edit.gaussians.means[2:], centers, atol=CLOSED_FORM)
    assert_allclose(2 * np.exp(edit.gaussians.log_scales[2:, 0]), [16, 16, 16, 4, 1], rtol=CLOSED_FORM)
    parents = [0, 0, 1, 0, 0]
    assert_array_equal(edit.parent_ids, [0, 1, *parents])
    assert_array_equal(edit.is_new, [False] * 2 + [True] * 5)
    assert_array_equal(edit.gaussians.latents[2:], anchors.latents[parents])
    assert_array_equal(edit.gaussians.sh_dc[2:], anchors.sh_dc[parents])
    assert (np.abs(edit.gaussians.offsets[2:]) <= 1 / 2).all()
    assert_array_equal(edit.gaussians.offsets[:2], anchors.offsets)


def test_chance_eliminates_a_half_a_quarter_and_an_eighth(rng):
    """Of 2,000 voxels at each level; five standard deviations are at most 112."""
    n = 2000
    points = 64.0 * np.arange(n)[:, None] * [1, 0, 0] + [5.3, 0, 0]
    edit = grow(anchors_of(points, rng), np.full((n // 2, 2), 9.0), 1.0, 1.0, rng)
    sides = np.round(2 * np.exp(edit.gaussians.log_scales[n // 2 :, 0]))
    for side, share in ((16, 1 / 2), (4, 3 / 4), (1, 7 / 8)):
        assert abs(np.sum(sides == side) - share * n) < 5 * np.sqrt(n * share * (1 - share))


def test_the_state_grows(scene, state):
    """A Gaussian with a gradient above all thresholds is away from all anchors; moments of the new ones are zero."""
    n = len(state.gaussians.means)
    state.adam.first.latents[:] = 1.0
    side = voxel_side(initial_gaussians(scene, 0, np.random.default_rng(0)), 1.0)
    spread = 2 * np.exp(state.gaussians.log_scales[4])
    state.gaussians.offsets[4, :3] = 1000 * side / spread  # where there is no voxel with an anchor
    v = np.zeros((n, 4))
    for row in (4, 5):
        v[row, :2] = 1.0
    for _ in range(3):  # chance may eliminate it at all levels, one time in 64
        collect_gradients_of_children(state, iteration_of(scene, v), growth_threshold=1e-3)
    assert grow_anchors(state, iteration_of(scene, v), voxel=1.0, growth_threshold=1e-3) is None
    new = state.gaussians.means[n:]
    assert 1 <= len(new) <= 6 and COUNT not in state.stats and SUM not in state.stats
    assert len(state.adam.first.latents) == n + len(new) and (state.adam.first.latents[n:] == 0).all()
    finest = new[2 * np.exp(state.gaussians.log_scales[n:, 0]) < 1.01 * side]
    assert_allclose(finest / side, np.round(finest / side), atol=2e-3)  # float32 a thousand sides away
    collect_gradients_of_children(state, iteration_of(scene, np.zeros((n + len(new), 4))), growth_threshold=1e-3)
    note = grow_anchors(state, iteration_of(scene, v), voxel=1.0, growth_threshold=1e-3)
    assert note == "nothing done: no voxel has a gradient above its threshold"
    collect_gradients_of_children(state, iteration_of(scene, np.ones((n + len(new), 4))), growth_threshold=None)
    assert COUNT not in state.stats and SUM not in state.stats
    assert grow_anchors(state, iteration_of(scene, v), voxel=1.0, growth_threshold=None).endswith("is none")
    assert len(state.gaussians.means) == n + len(new)


def test_growth_is_by_the_mean_over_the_views_that_saw_a_gaussian(scene, state, monkeypatch):
    """Two of five views saw the first Gaussian, none the second."""
    n, asked = len(state.gaussians.means), []

    def remembered(anchors, gradients, side, threshold, rng):
        asked.append(gradients)
        return grow(anchors, np.zeros_like(gradients), side, 1.0, rng)

    monkeypatch.setattr("minisplat_ref.extensions.cus.recipe.grow", remembered)
    sums, counts = np.zeros((n, 2)), np.zeros((n, 2), int)
    sums[0, 0], counts[0, 0] = 3.0, 2
    state.stats |= {SUM: sums, COUNT: counts}
    grow_anchors(state, iteration_of(scene, None), voxel=1.0, growth_threshold=1e-3)
    assert asked[0][0, 0] == 1.5 and np.isnan(asked[0][0, 1])


def test_dates_by_hand():
    """As in the release: from 1,500 to 15,000 of 30,000, every hundredth; a short run leaves a hundred in between."""
    recipe = find_recipe("cus", 30_000)
    assert firing_steps(recipe, grow_anchors) == list(range(1_600, 15_000, 100))
    assert firing_steps(recipe, collect_gradients_of_children) == list(range(501, 15_000))
    assert firing_steps(find_recipe("cus", 600), grow_anchors) == [100, 200]
    prune, grows = (
        next(i for i, event in enumerate(recipe.events) if does(event, action))
        for action in (prune_insignificant, grow_anchors)
    )
    assert prune < grows and THRESHOLD == 2e-4


# A run


@pytest.fixture
def often(monkeypatch):
    """The extension with a recipe in which growing may come every ten iterations instead of every hundred."""
    recipe = find_recipe("cus")
    events = tuple(e._replace(min_gap=10) if does(e, grow_anchors) else e for e in recipe.events)
    recipe = recipe._replace(events=events)
    monkeypatch.setattr(cus, "EXTENSION", cus.EXTENSION._replace(recipes=(recipe,)))


def test_a_run_grows(often, tmp_path, capfd):
    sizes = ["--views", "6", "--width", "48", "--height", "40", "--points", "60", "--supersampling", "1"]
    assert main(["synthetic", "room", "--out", str(tmp_path / "room"), *sizes]) == 0
    sets = [word for name, value in SMALL.items() for word in ("--set", f"{name}={value}")]
    words = ["train", str(tmp_path / "room"), "--recipe", "cus", "--iterations", "24", *sets]
    assert main([*words, "--set", "growth_threshold=1e-4", "--out", str(tmp_path / "run")]) == 0
    fired = [json.loads(line) for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    grown = [event for event in fired if event["action"] == "grow_anchors"]
    assert grown and grown[0]["n_after"] > grown[0]["n_before"]
