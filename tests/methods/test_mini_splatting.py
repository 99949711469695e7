"""Mini-Splatting and Mini-Splatting2 as whole recipes, and their actions, on a scene of six tiny images."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from minisplat_ref.errors import InputError
from minisplat_ref.methods import RECIPES, gaussian_splatting, mini_splatting, mini_splatting2
from minisplat_ref.methods.mini_splatting import is_culling, measure_importance
from minisplat_ref.rendering import RenderSettings, render, render_vjp
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.strategy import depth_reinit, importance, simplify, visibility
from minisplat_ref.strategy.initialization import gaussians_from_points
from minisplat_ref.strategy.ops import n_rows
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.loop import train
from minisplat_ref.training.recipe_settings import configure, settings_of
from minisplat_ref.training.saved_state import load_state, save_state
from minisplat_ref.training.schedule import At, Every, SmallerViews, firing_steps, scale_recipe
from minisplat_ref.training.smaller_views import halve_large_views
from minisplat_ref.training.state import Iteration, n_pixels
from minisplat_ref.types import Scene, View
from scenes import as_dtype, make_camera, make_gaussians

N_VIEWS, N_GAUSSIANS, ITERATIONS = 6, 60, 90
NEW_RECIPES = [name for name in RECIPES if name.startswith("mini-splatting")]


@pytest.fixture(scope="module")
def scene():
    """Images of 60 Gaussians, and their centres with wrong colours as the points to start from."""
    rng = np.random.default_rng(5)
    truth = as_dtype(make_gaussians(rng, N_GAUSSIANS, sh_degree=0), np.float32)
    views = []
    for i in range(N_VIEWS):
        camera = make_camera(72, 64, fx=90.0, fy=85.0, rng=rng)
        image = render(truth, camera, backend=CPU)[0].image
        views.append(View(f"view{i}", camera, np.round(255 * np.clip(image, 0, 1)).astype(np.uint8), None))
    colors = rng.integers(0, 256, (N_GAUSSIANS, 3), np.uint8)
    return Scene("tiny", tuple(views), (), truth.means.astype(float), colors, np.zeros(3), 1.0)


@pytest.fixture
def state(scene):
    """A little training, so that views see something."""
    return train(scene, RECIPES["3dgs-accel"]._replace(iterations=12, sh_degree=0, events=()), seed=0)


@pytest.fixture
def iteration(scene):
    return Iteration(scene, scene.train_views[0], None, np.arange(0), None, RenderSettings(scene.background))


def compressed(name):
    """The recipe in 90 iterations, with every event.

    Mini-Splatting2's events come as close together as it takes; Mini-Splatting's keep their distance, or pruning, which
    has no time to be undone, would leave nothing.
    """
    recipe = RECIPES[name]
    min_gap = 2 if name.startswith("mini-splatting2") else 5
    events = [e._replace(min_gap=min_gap) if isinstance(e, Every) else e for e in recipe.events]
    recipe = scale_recipe(recipe._replace(events=tuple(events)), ITERATIONS)
    return configure(recipe, min_side=32) if "min_side" in settings_of(recipe) else recipe


# Whole recipes --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NEW_RECIPES)
def test_recipe_runs_to_the_end(scene, name):
    """Every event happens, what they upset is learnt again, and view-dependent colour exists after simplification."""
    recipe = compressed(name)
    losses, degrees, sizes = [], [], []

    def watch(report):
        losses.append(report.loss)
        degrees.append(report.state.gaussians.sh_rest.shape[1])
        sizes.append(report.view.camera.width)

    state = train(scene, recipe, seed=0, on_step=watch)
    rounds = np.reshape(losses, (-1, N_VIEWS)).mean(axis=1)
    assert rounds[-1] < 0.8 * rounds.max()
    assert degrees[0] == 0 and degrees[-1] == 15 and sorted(degrees) == degrees
    n_small = len(firing_steps(recipe, halve_large_views))
    assert n_small == (15 if name.startswith("mini-splatting2") else 0)
    assert sizes == [36] * n_small + [72] * (ITERATIONS - n_small)
    assert all(len(array) == n_rows(state.gaussians) for array in (*state.adam.first, *state.stats.values()))
    assert not is_culling(state)


@pytest.mark.parametrize("name", ["mini-splatting", "mini-splatting2"])
def test_budget_is_kept(scene, name):
    recipe = configure(compressed(name), budget=20)
    counts = []
    train(scene, recipe, seed=0, on_step=lambda report: counts.append(n_rows(report.state.gaussians)))
    simplified = next(event.step for event in recipe.events if "simplify" in repr(event.action))
    assert counts[simplified - 2] > 20 and counts[simplified - 1] == 20 and counts[-1] <= 20


def test_resumed_while_views_are_culled(scene, tmp_path):
    recipe = compressed("mini-splatting2")
    uninterrupted = train(scene, recipe, seed=3)
    state = train(scene, recipe._replace(iterations=40), seed=3)
    assert is_culling(state)
    save_state(tmp_path / "checkpoint.npz", state, recipe)
    resumed = train(scene, recipe, seed=999, state=load_state(tmp_path / "checkpoint.npz", recipe))
    for field, expected in zip(resumed.gaussians, uninterrupted.gaussians, strict=True):
        assert_array_equal(field, expected)


# Culling --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", [REFERENCE, CPU], ids=lambda b: b.name)
def test_culled_rows_have_no_part_in_a_view(rng, backend):
    """The view is that of the others alone, and the gradient of a culled row is zero."""
    gaussians, camera = make_gaussians(rng, 30), make_camera()
    is_visible = rng.random(30) < 0.5
    output, tape = render(gaussians, camera, backend=backend, is_visible=is_visible)
    others, _ = render(gaussians._make(field[is_visible] for field in gaussians), camera, backend=backend)
    assert_array_equal(output.image, others.image)
    assert np.abs(output.image - render(gaussians, camera, backend=backend)[0].image).max() > 0.01
    gradient = render_vjp(tape, rng.normal(size=output.image.shape)).gaussians
    assert all(not field[~is_visible].any() for field in gradient)
    assert gradient.opacity_logits[is_visible].any()


def test_training_uses_the_table(scene, state):
    """A Gaussian that no view sees stays as it is."""
    n = n_rows(state.gaussians)
    state.stats["is_visible"] = np.arange(n)[:, None] * np.ones(N_VIEWS) < n // 2
    before = state.gaussians.means.copy()
    train(scene, RECIPES["3dgs-accel"]._replace(iterations=20, sh_degree=0, events=()), seed=0, state=state)
    has_moved = np.any(state.gaussians.means != before, axis=1)
    assert has_moved[: n // 2].mean() > 0.8 and not has_moved[n // 2 :].any()


def test_gradients_are_lowered_while_views_are_culled(state, scene):
    state.stats["gradient_factor"] = np.full(n_rows(state.gaussians), 0.25, np.float32)
    v_means2d = np.ones((n_rows(state.gaussians), 2))
    ids = np.array([1, 4])
    gaussian_splatting.collect_gradients(
        state, Iteration(scene, scene.train_views[0], None, ids, v_means2d, RenderSettings(scene.background))
    )
    assert state.stats["gradient_sum"][ids] == pytest.approx(0.25 * np.hypot(36, 32))


def test_clone_culls_and_forgets_what_was_collected(state, iteration):
    n = n_rows(state.gaussians)
    state.stats = {"gradient_sum": np.ones(n), "view_count": np.ones(n, int), "is_blurred": np.ones(n, bool)}
    mini_splatting2.aggressive_clone(
        state, iteration, critical=lambda stats: stats.dominant_count > 0, factor=2, tail_mass=0.999, min_views=0
    )
    n = n_rows(state.gaussians)
    assert n > N_GAUSSIANS * 0.9 and state.stats["is_visible"].shape == (n, N_VIEWS)
    assert set(state.stats) == {"is_visible", "gradient_factor"}
    mini_splatting2.stop_culling(state, iteration)
    assert state.stats == {}


# Simplification -------------------------------------------------------------------------------------------------------

HALF = partial(mini_splatting.simplify, metric=importance.indoor, choose=simplify.by_rank, keep_fraction=0.5)
TAIL = partial(mini_splatting.prune_tail, metric=importance.indoor, mass=0.9)
WHERE_ROWS_GO = pytest.mark.parametrize("act", [HALF, TAIL], ids=["simplify", "prune_tail"])


@WHERE_ROWS_GO
def test_the_culling_table_is_measured_anew_where_rows_go(state, iteration, act):
    """An old table, by which everything is visible everywhere, gives way to that of the Gaussians of today."""
    n = n_rows(state.gaussians)
    measured = measure_importance(state, iteration)
    factors = visibility.gradient_factors(measured.is_visible, measured.frustum_count).astype(np.float32)
    old = {"is_visible": np.ones((n, N_VIEWS), bool), "gradient_factor": np.ones(n, np.float32)}
    state.stats = {**old, "row": np.arange(n)}
    act(state, iteration)
    rows = state.stats["row"]
    assert 0 < len(rows) < n and not measured.is_visible[rows].all()
    assert_array_equal(state.stats["is_visible"], measured.is_visible[rows])
    assert_array_equal(state.stats["gradient_factor"], factors[rows])


@WHERE_ROWS_GO
def test_where_rows_go_no_culling_begins(state, iteration, act):
    act(state, iteration)
    assert not is_culling(state) and state.stats == {}


def test_the_share_kept_is_one_of_the_candidates(state, iteration):
    n, n_candidates = n_rows(state.gaussians), np.count_nonzero(measure_importance(state, iteration).dominant_count)
    assert round(0.5 * n_candidates) < round(0.5 * n)  # some are no candidates
    assert HALF(state, iteration) is None
    assert n_rows(state.gaussians) == round(0.5 * n_candidates)


@pytest.mark.parametrize("choose", [simplify.by_sampling, simplify.by_rank, simplify.by_merging])
def test_each_choice_leaves_the_budget(state, iteration, choose):
    mini_splatting.simplify(
        state, iteration, metric=importance.indoor, choose=choose, keep_fraction=0.5, budget=17, min_views=0
    )
    assert n_rows(state.gaussians) == n_rows(state.adam.first) == 17


def test_budget_above_the_candidates(state, iteration):
    """A budget is a ceiling: all candidates stay, in their order, and somebody is told."""
    act = partial(mini_splatting.simplify, metric=importance.indoor, choose=simplify.by_sampling, keep_fraction=0.5)
    stats, said = measure_importance(state, iteration), []
    candidates = stats.dominant_count > 0
    expected = state.gaussians.means[candidates]
    act(state, iteration._replace(say=said.append), budget=1_000)
    np.testing.assert_array_equal(state.gaussians.means, expected)
    n = np.count_nonzero(candidates)
    assert 0 < n < N_GAUSSIANS
    assert said == [f"simplification keeps all {n} Gaussians that matter, fewer than the budget of 1,000"]


def test_budget_below_the_candidates_says_nothing(state, iteration):
    said = []
    act = partial(mini_splatting.simplify, metric=importance.indoor, choose=simplify.by_rank, keep_fraction=0.5)
    act(state, iteration._replace(say=said.append), budget=3)
    assert len(state.gaussians.means) == 3 and said == []


def test_nothing_is_important(state, iteration):
    state.gaussians.opacity_logits[:] = -30.0
    with pytest.raises(InputError, match="no Gaussian matters to any training view"):
        mini_splatting.prune_tail(state, iteration, metric=importance.indoor, mass=0.99)


def test_tail_is_pruned_and_moments_stay(state, iteration):
    stats = measure_importance(state, iteration)
    moment = state.adam.first.means.copy()
    mini_splatting.prune_tail(state, iteration, metric=importance.indoor, mass=0.9)
    kept = importance.mass_mask(np.where(stats.dominant_count > 0, stats.blend_weight_sum, 0), 0.9)
    assert 0 < kept.sum() < len(kept)
    assert_array_equal(state.adam.first.means, moment[kept])


def test_start_again_has_no_past(state, iteration):
    state.stats["is_blurred"] = np.zeros(n_rows(state.gaussians), bool)
    state.view_order = [2, 0]  # in the middle of a round
    means = state.gaussians.means.copy()
    mini_splatting.restart_from_means(state, iteration, sh_degree=2, largest_size=0.1)
    assert_array_equal(state.gaussians.means, means)
    assert state.gaussians.sh_rest.shape[1] == 8 and state.adam.first.sh_rest.shape[1] == 8
    assert not state.adam.second.means.any() and state.adam.step == 0
    assert state.stats == {} and state.view_order == []


# Densification --------------------------------------------------------------------------------------------------------


def test_blur_is_remembered_from_view_to_view(state, scene):
    n = n_rows(state.gaussians)

    def see(counts):
        stats = SimpleNamespace(dominant_count=np.array(counts + [0] * (n - 3)))
        output = SimpleNamespace(stats=stats)
        iteration = Iteration(scene, scene.train_views[0], output, np.arange(0), None, RenderSettings(scene.background))
        mini_splatting.collect_blur(state, iteration, area_fraction=64 / (72 * 64))

    see([65, 64, 0])
    see([0, 64, 70])
    assert_array_equal(np.flatnonzero(state.stats["is_blurred"]), [0, 2])


def test_densification_pauses_above_the_most(state, iteration):
    n = n_rows(state.gaussians)
    act = partial(gaussian_splatting.clone_and_split, threshold=0.0, size_fraction=10.0)
    note = "paused: as many Gaussians as max_per_pixel allows"
    for most, expected, expected_note in ((n - 1, n, note), (n + 1, 2 * n, None)):
        state.stats = {"gradient_sum": np.ones(n), "view_count": np.ones(n), "is_blurred": np.zeros(n, bool)}
        assert act(state, iteration, max_per_pixel=most / n_pixels(iteration.scene)) == expected_note
        assert n_rows(state.gaussians) == expected and (state.stats == {}) == (expected == 2 * n)


def test_depth_gives_as_many_points_as_asked_for(state, iteration):
    recipe = RECIPES["mini-splatting"]
    act = next(event.action for event in recipe.events if "reinitialise_from_depth" in repr(event.action))
    n = n_rows(state.gaussians)
    act(state, iteration, points_per_gaussian=5.0)
    assert n_rows(state.gaussians) == 5 * n // N_VIEWS * N_VIEWS
    assert state.gaussians.sh_rest.shape[1] == 0 and state.adam.step == 0


@pytest.mark.parametrize(("extents", "distance"), [(30.0, 75.0), (None, None)])
def test_depth_is_given_the_settings_in_world_units(state, iteration, monkeypatch, extents, distance):
    """The backdrop is a number of extents away, and the number of points is counted before the tail is pruned."""
    given = {}

    def reinitial_points(model, views, n_points, **settings):
        given.update(settings, n_points=n_points, n_left=n_rows(model.gaussians))
        return np.eye(4, 3), np.zeros((4, 3), np.uint8)

    monkeypatch.setattr(mini_splatting, "reinitial_points", reinitial_points)
    n = n_rows(state.gaussians)
    mini_splatting.reinitialise_from_depth(
        state,
        iteration._replace(scene=iteration.scene._replace(extent=2.5)),
        points_of=depth_reinit.centre_points,
        min_alpha=0.3,
        depth_tolerance=0.07,
        backdrop_extents=extents,
        points_per_gaussian=2.0,
        largest_size=0.1,
        drawn_mass=0.9,
    )
    assert (given["backdrop_distance"], given["min_alpha"], given["depth_tolerance"]) == (distance, 0.3, 0.07)
    assert given["points_of"] is depth_reinit.centre_points and given["rng"] is state.rng
    assert given["n_points"] == 2 * n and 0 < given["n_left"] < n
    assert_array_equal(state.gaussians.means, np.eye(4, 3))


@pytest.mark.parametrize(
    ("recipe", "action"),
    [("mini-splatting2", "reinitialise_from_depth"), ("mini-splatting", "restart_from_means")],
)
def test_few_points_far_away_do_not_become_veils(state, iteration, monkeypatch, rng, recipe, action):
    """Their neighbours are as far away as the cameras: without a limit they would reach them."""
    points = np.vstack([rng.uniform(-0.1, 0.1, (50, 3)), 200.0 * np.eye(3)]).astype(np.float32)
    points_and_colors = points, np.zeros((53, 3), np.uint8)
    state.gaussians = gaussians_from_points(*points_and_colors, sh_degree=0)  # the restart's
    before = np.exp(state.gaussians.log_scales)
    monkeypatch.setattr(mini_splatting, "reinitial_points", lambda *_, **__: points_and_colors)
    act = next(event.action for event in RECIPES[recipe].events if action in repr(event.action))
    act(state, iteration)
    after = np.exp(state.gaussians.log_scales)
    assert_array_equal(after[:50], before[:50])
    assert (before[50:] > 100).all() and (after[50:] < 25).all()


# Bad input ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NEW_RECIPES)
def test_too_few_views(scene, name):
    with pytest.raises(InputError, match=r"tiny has 2 training views.*at least 3.*use 3dgs-accel"):
        initial_state(scene._replace(train_views=scene.train_views[:2]), RECIPES[name], 0)


def test_tiny_images_are_not_halved(scene):
    """Half of 63 pixels would be fewer than 32."""
    views = tuple(
        view._replace(camera=view.camera._replace(width=63), image=view.image[:, :63].copy())
        for view in scene.train_views
    )
    sizes = []
    smaller = SmallerViews(partial(halve_large_views, min_side=32, max_halvings=1), until=2)
    recipe = RECIPES["3dgs"]._replace(iterations=2, events=(smaller,))
    train(scene._replace(train_views=views), recipe, seed=0, on_step=lambda r: sizes.append(r.view.camera.width))
    assert sizes == [63, 63]


def test_recipe_settings_reach_the_event(scene):
    seen = []
    recipe = RECIPES["3dgs"]._replace(
        iterations=1, events=(At(1, partial(lambda *_, budget: seen.append(budget), budget=None)),)
    )
    train(scene, configure(recipe, budget=7), seed=0)
    assert seen == [7]
