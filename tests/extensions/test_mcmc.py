"""MCMC densification: copies that render as one, noise, the means and their gradients, the actions, whole trainings."""

import json
from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad
from scipy.special import comb, expit

from actions import act, scene_of, state_of
from gradcheck import check_jacobian
from minisplat_ref.app.cli import main
from minisplat_ref.app.runs.start import make_start
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.mcmc.model import (
    COPIES_MAX,
    OPACITY_MAX,
    OPACITY_MIN,
    draw_noise,
    mean_opacity,
    mean_opacity_vjp,
    mean_scale,
    mean_scale_vjp,
    share_among_copies,
)
from minisplat_ref.extensions.mcmc.recipe import add_copies, add_noise, relocate
from minisplat_ref.io import load_scene
from minisplat_ref.io.ply import load_ply
from minisplat_ref.reference.covariance import covariances
from minisplat_ref.rendering import render
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.strategy.ops import take
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.loop import train
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.saved_state import load_state, save_state
from minisplat_ref.training.schedule import During, firing_steps
from minisplat_ref.training.state import Iteration
from minisplat_ref.types import Gaussians
from scenes import as_dtype, make_camera
from tolerances import CLOSED_FORM, SAMPLE_MEAN


def logits(opacities):
    o = np.asarray(opacities, float)
    return np.log(o) - np.log1p(-o)


def population(opacities, scales=(0.1, 0.2, 0.3), dtype=np.float64):
    n = len(opacities)
    quats = np.tile([0.9, 0.1, -0.3, 0.2], (n, 1))
    g = Gaussians(
        np.arange(3.0 * n).reshape(n, 3),
        quats,
        np.tile(np.log(scales), (n, 1)),
        logits(opacities),
        np.arange(3.0 * n).reshape(n, 3),
        np.zeros((n, 0, 3)),
    )
    return as_dtype(g, dtype)


# --- copies ---


def test_two_copies_by_hand():
    """Of opacity 0.75 two have 0.5 each; the sum is 2 * 0.5 - 0.25 / sqrt(2) = 0.823223."""
    x, log_s = share_among_copies(logits([0.75]), np.log([[0.1, 0.2, 0.4]]), np.array([2]))
    assert_allclose(expit(x), 0.5, rtol=CLOSED_FORM)
    assert_allclose(np.exp(log_s), np.array([[0.1, 0.2, 0.4]]) * 0.75 / (1 - 0.25 / np.sqrt(2)), rtol=CLOSED_FORM)


def test_the_sum_is_the_double_sum_of_the_paper():
    for n, o in ((1, 0.3), (2, 0.3), (3, 0.9), (7, 0.99)):
        copy = 1 - (1 - o) ** (1 / n)
        double = sum(
            comb(i - 1, k) * (-1) ** k * copy ** (k + 1) / np.sqrt(k + 1) for i in range(1, n + 1) for k in range(i)
        )
        _, log_s = share_among_copies(logits([o]), np.zeros((1, 3)), np.array([n]))
        assert_allclose(np.exp(log_s), o / double, rtol=CLOSED_FORM)


@pytest.mark.parametrize(("n", "opacity"), [(1, 0.7), (2, 0.9), (5, 0.35), (50, 0.999)])
def test_copies_have_the_opacity_at_the_centre_and_the_integral_of_one(n, opacity):
    """On a line through the centre, by numerical integration of what N layers stop."""
    x, log_s = share_among_copies(logits([opacity]), np.log([[0.2, 0.2, 0.2]]), np.array([n]))
    o, s = expit(x[0]), np.exp(log_s[0, 0])
    assert_allclose(1 - (1 - o) ** n, opacity, rtol=CLOSED_FORM)
    of_one, _ = quad(lambda t: opacity * np.exp(-((t / 0.2) ** 2) / 2), -3, 3, points=[0], epsabs=1e-12)
    of_all, _ = quad(lambda t: 1 - (1 - o * np.exp(-((t / s) ** 2) / 2)) ** n, -3, 3, points=[0], epsabs=1e-12)
    assert_allclose(of_all, of_one, rtol=1e-9)


def test_two_copies_render_as_one_did():
    """The same at the centre, and the same sum along a row through it; the sum over the image is not promised."""
    camera = make_camera(101, 101, fx=160.0, fy=160.0)  # deviations of 10 px
    one = Gaussians(
        np.array([[0.0, 0, 4]]),
        np.array([[1.0, 0, 0, 0]]),
        np.full((1, 3), np.log(0.25)),
        logits([0.8]),
        np.full((1, 3), 0.7),
        np.zeros((1, 0, 3)),
    )
    x, log_s = share_among_copies(one.opacity_logits, one.log_scales, np.array([2]))
    two = take(one._replace(opacity_logits=x, log_scales=log_s), np.array([0, 0]))
    plain = take(one, np.array([0, 0]))
    images = [render(g, camera, backend=REFERENCE)[0].image[..., 0] for g in (one, two, plain)]
    row = [image[50] for image in images]
    assert_allclose(row[1][50], row[0][50], rtol=1e-9)
    assert_allclose(row[1].sum(), row[0].sum(), rtol=5e-3)  # footprints end where alpha is 1 / 255
    assert row[2].sum() > 1.1 * row[0].sum()
    assert abs(images[1].sum() / images[0].sum() - 1) > 0.01


def test_limits_of_copies():
    """More copies than the table has count as the most it has; opacities stay within the released range."""
    many = share_among_copies(logits([0.5]), np.zeros((1, 3)), np.array([1_000]))
    most = share_among_copies(logits([0.5]), np.zeros((1, 3)), np.array([COPIES_MAX]))
    assert_array_equal(many[0], most[0])
    assert COPIES_MAX == 50
    assert_allclose(expit(share_among_copies(logits([0.006]), np.zeros((1, 3)), np.array([9]))[0]), OPACITY_MIN)
    x, log_s = share_among_copies(np.array([40.0, 16.0]), np.zeros((2, 3)), np.array([1, 50]))
    assert np.isfinite(x).all() and np.isfinite(log_s).all() and x[0] == logits([OPACITY_MAX])
    assert_allclose(log_s[0], 0, atol=1e-9)
    nothing = share_among_copies(np.zeros(0, np.float32), np.zeros((0, 3), np.float32), np.zeros(0, int))
    assert [array.shape for array in nothing] == [(0,), (0, 3)] and nothing[0].dtype == np.float32


# --- noise ---


def test_noise_has_the_square_of_the_covariance():
    """Its covariance is (size gate)^2 Sigma^2, and at the opacity 0.005 the gate is one half."""
    n = 8_000
    g = population(np.full(n, 0.005))
    moves = draw_noise(g, 3.0, np.random.default_rng(5))
    Sigma = covariances(g.quats[:1], np.exp(g.log_scales[:1]))[0]
    expected = 1.5**2 * Sigma @ Sigma
    assert_allclose(np.cov(moves.T), expected, atol=SAMPLE_MEAN * expected.max())
    assert_allclose(moves.mean(axis=0), 0, atol=SAMPLE_MEAN * np.sqrt(expected.max()))


class Ones:
    """A generator whose normal numbers are one."""

    def standard_normal(self, shape):
        return np.ones(shape)


def test_what_is_opaque_stays():
    """The gate is 1 / (1 + exp(100 (o - 0.005))): a half at 0.005, e^-1 / (1 + e^-1) at 0.015, 3e-22 at 0.5."""
    opacities = np.array([0.5, 0.015, 0.005, 0.0001])
    g = population(opacities)
    moves = draw_noise(g, 2.0, Ones())
    whole = covariances(g.quats, np.exp(g.log_scales)) @ np.ones(3)
    gates = 1 / (1 + np.exp(100 * (opacities - 0.005)))
    assert_allclose(moves, 2 * gates[:, None] * whole, rtol=1e-11)  # 1 - o cancels
    assert draw_noise(as_dtype(g, np.float32), 2.0, Ones()).dtype == np.float32


def test_noise_follows_the_rate_of_the_means(rng):
    """In the recipe the size is 5e5 times the rate, which falls with the iteration and rises with the extent."""
    recipe = find_recipe("mcmc")
    (event,) = (e for e in recipe.events if e.action.func is add_noise)
    state = state_of(population([0.005, 0.005]))
    expected = state.gaussians.means + draw_noise(state.gaussians, 5e5 * 3e-7, np.random.default_rng(0))
    event.action(state, Iteration(scene_of(), *[None] * 4, rates=lambda: {"means": 3e-7}))
    assert_array_equal(state.gaussians.means, expected)


# --- regularisers ---


@pytest.mark.parametrize(
    ("function", "vjp", "shape"), [(mean_opacity, mean_opacity_vjp, 6), (mean_scale, mean_scale_vjp, (6, 3))]
)
def test_gradients_of_the_regularisers(function, vjp, shape, rng):
    x = rng.normal(size=shape)
    check_jacobian(lambda x: (np.asarray(function(x)),), lambda v: (vjp(x, float(v)),), [x], names=["x"])
    assert vjp(x.astype(np.float32)).dtype == np.float32
    nothing = np.zeros((0, 3))
    assert function(nothing) == 0 and vjp(nothing).shape == (0, 3)


def test_regularisers_by_hand():
    assert_allclose(mean_opacity(logits([0.2, 0.6])), 0.4, rtol=CLOSED_FORM)
    assert_allclose(mean_opacity_vjp(logits([0.2, 0.6]), 3.0), [0.16 * 1.5, 0.24 * 1.5], rtol=CLOSED_FORM)
    assert_allclose(mean_scale(np.log([[1.0, 2, 3], [2, 2, 2]])), 2, rtol=CLOSED_FORM)
    assert_allclose(mean_scale_vjp(np.log([[1.0, 2, 3]]), 3.0), [[1, 2, 3]], rtol=CLOSED_FORM)


# --- actions ---


def test_dead_gaussians_move_to_live_ones():
    """Row 1 is dead, row 0 nearly always drawn: both have half of its optical depth, its place and its colour."""
    state = state_of(population([0.9, 0.0049, 0.0051]))
    for moment in (state.adam.first, state.adam.second):
        for field in moment:
            field[:] = 7.0
    note = act(find_recipe("mcmc"), relocate, state, scene_of())
    g, before = state.gaussians, population([0.9, 0.0049, 0.0051])
    assert note == "1 relocated" and len(g.means) == 3
    x, log_s = share_among_copies(logits([0.9]), before.log_scales[:1], np.array([2]))
    for row in (0, 1):
        assert_allclose(g.means[row], before.means[0])
        assert_allclose(g.sh_dc[row], before.sh_dc[0])
        assert_allclose(g.opacity_logits[row], x[0], rtol=CLOSED_FORM)
        assert_allclose(g.log_scales[row], log_s[0], rtol=CLOSED_FORM)
    assert_array_equal(g.means[2], before.means[2])
    for moment in (state.adam.first, state.adam.second):
        assert_array_equal(moment.opacity_logits, [0, 7, 7])  # as released: the source forgets, the copy does not


@pytest.mark.parametrize("opacities", [[0.9, 0.5], [0.001, 0.0049], []])
def test_without_dead_or_without_live_ones_nothing_happens(opacities):
    state = state_of(population(opacities))
    before = state.gaussians
    assert act(find_recipe("mcmc"), relocate, state, scene_of()).startswith("nothing done")
    assert state.gaussians is before


def test_sources_are_drawn_by_opacity():
    """Of 8,000 dead ones three quarters go where the opacity is three times the other's."""
    state = state_of(population([0.6, 0.2] + [0.001] * 8_000))
    act(find_recipe("mcmc"), relocate, state, scene_of())
    share = (state.gaussians.means[2:, 0] == 0).mean()
    assert abs(share - 0.75) < SAMPLE_MEAN * np.sqrt(0.75 * 0.25)


def test_growth_is_five_percent_up_to_the_cap():
    recipe = configure(find_recipe("mcmc"), budget=107)
    state = state_of(population(np.full(100, 0.5)))
    act(recipe, add_copies, state, scene_of())
    assert len(state.gaussians.means) == 105
    assert len(state.adam.first.means) == 105
    act(recipe, add_copies, state, scene_of())
    assert len(state.gaussians.means) == 107
    assert act(recipe, add_copies, state, scene_of()) == "nothing done: the cap is 107"
    assert len(state.gaussians.means) == 107
    copies = np.bincount((state.gaussians.means[:, 0] / 3).round().astype(int))
    assert copies.sum() == 107 and (copies > 1).sum() >= 4


def test_without_a_budget_pixels_give_the_cap():
    """0.03 of 20 x 10 pixels in two views is 12."""
    state = state_of(population(np.full(11, 0.5)))
    act(find_recipe("mcmc"), add_copies, state, scene_of([make_camera(20, 10)] * 2))
    assert len(state.gaussians.means) == 11  # 5 % of 11 is less than one
    state = state_of(population(np.full(100, 0.5)))
    assert (
        act(find_recipe("mcmc"), add_copies, state, scene_of([make_camera(20, 10)] * 2))
        == "nothing done: the cap is 12"
    )


# --- schedule ---


@pytest.mark.parametrize("iterations", [30_000, 7_000, 3_000, 2_000, 997, 300])
def test_runs_of_any_length_keep_the_order_and_end_long_after_the_last_relocation(iterations):
    recipe = find_recipe("mcmc", iterations)
    moved, grown = (firing_steps(recipe, action) for action in (relocate, add_copies))
    assert moved == grown
    assert moved[0] > 500 * iterations / 30_000 - 1
    assert iterations - moved[-1] >= iterations / 6
    assert min(b - a for a, b in pairwise(moved)) >= 10 * (iterations >= 300) - 1
    assert firing_steps(recipe, add_noise) == list(range(1, iterations))


def test_it_starts_small_and_half_opaque():
    scene = make_scene("room", n_views=3, width=16, height=12, supersampling=1, n_points=50).scene
    plain, ours = (initial_state(scene, find_recipe(name), 0).gaussians for name in ("3dgs", "mcmc"))
    assert_allclose(expit(ours.opacity_logits), 0.5)
    assert_allclose(np.exp(ours.log_scales - plain.log_scales), 0.1, rtol=1e-5)
    assert_array_equal(ours.means, plain.means)


@pytest.mark.parametrize("settings", [{"initial_opacity": 1.0}, {"initial_opacity": 0.0}, {"initial_size": 0.0}])
def test_a_start_without_a_logarithm_is_refused(settings):
    scene = make_scene("room", n_views=3, width=16, height=12, supersampling=1, n_points=50).scene
    with pytest.raises(InputError, match="give an opacity between 0 and 1, and a size above 0"):
        initial_state(scene, configure(find_recipe("mcmc"), **settings), 0)


# --- whole trainings ---


@pytest.fixture(scope="module")
def scene():
    return make_scene("room", n_views=4, width=24, height=18, supersampling=1, n_points=120).scene


def short(iterations):
    return configure(find_recipe("mcmc", iterations), budget=140)


def test_actions_find_the_rates_of_their_iteration(scene):
    """The rate of the means falls from 1.6e-4 extents to a hundredth of that, and is multiplied by the extent."""
    found = []

    def note_rate(state, iteration):
        found.append(iteration.rates()["means"])

    train(scene, short(4)._replace(events=(During(note_rate),)), seed=0)
    assert_allclose(found, [1.6e-4 * 0.01 ** (k / 4) * scene.extent for k in (1, 2, 3, 4)], rtol=CLOSED_FORM)


def test_a_resumed_run_has_the_same_bytes(scene, tmp_path):
    recipe = short(60)
    whole = train(scene, recipe, seed=3)
    save_state(tmp_path / "state.npz", train(scene, recipe._replace(iterations=31), seed=3), recipe)
    resumed = train(scene, recipe, seed=99, state=load_state(tmp_path / "state.npz", recipe))
    again = train(scene, recipe, seed=3)
    other = train(scene, recipe, seed=4)
    for name, field in whole.gaussians._asdict().items():
        assert field.tobytes() == getattr(resumed.gaussians, name).tobytes() == getattr(again.gaussians, name).tobytes()
    assert len(whole.gaussians.means) == 140 and not np.array_equal(whole.gaussians.means, other.gaussians.means)


def test_the_command_line(tmp_path):
    size = {"n_views": 6, "width": 24, "height": 18, "n_points": 120}
    write_scene(make_scene("room", supersampling=1, **size), tmp_path / "scene", size)
    out = tmp_path / "run"
    arguments = ["train", str(tmp_path / "scene"), "--recipe", "mcmc", "--iterations", "60", "--budget", "130"]
    further = ["--extension", "geometry", "--set", "sfm_depth=0.1", "--set", "scale_reg=0.02"]
    assert main([*arguments, *further, "--out", str(out)]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["n_gaussians"] == 130
    described = json.loads((out / "config.json").read_text())["recipe"]
    weights = {term["name"]: term["weight"] for term in described["losses"]}
    assert weights == {"photometric": 1, "opacity_reg": 0.01, "scale_reg": 0.02, "sfm_depth": 0.1}
    assert main(["eval", str(out)]) == 0


def test_a_model_of_3dgs_is_continued_as_it_is(tmp_path):
    """Points begin small and half opaque; what a run has trained does not begin again."""
    size = {"n_views": 4, "width": 24, "height": 18, "n_points": 60}
    write_scene(make_scene("room", supersampling=1, **size), tmp_path / "scene", size)
    run = tmp_path / "run"
    assert main(["train", str(tmp_path / "scene"), "--recipe", "3dgs", "--iterations", "2", "--out", str(run)]) == 0
    ours = make_start(run, load_scene(tmp_path / "scene"), find_recipe("mcmc"), seed=0).state.gaussians
    for name, field in load_ply(run / "point_cloud.ply")._asdict().items():
        assert_array_equal(getattr(ours, name), field)


def test_the_oracle_checks_the_regularisers_and_that_alone(capsys):
    """3DGS renders these Gaussians; in the oracle's scene those that begin small would be all but invisible."""
    assert main(["oracle", "gradients", "--extension", "mcmc", "--backend", "reference"]) == 0
    printed = capsys.readouterr().out
    assert "opacity_reg: Jacobian" in printed and "scale_reg: inner" in printed and "render" not in printed
