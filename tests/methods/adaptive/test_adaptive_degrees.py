"""Bands of the harmonics: who gets them, which are cut, and that a matt scene has hardly any and a shiny one has."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from adaptive_states import iteration_of, state_of
from minisplat_ref.app.runs.simplification import fine_tune
from minisplat_ref.constants import SH_C0, SH_C1
from minisplat_ref.errors import InputError
from minisplat_ref.io.checkpoint import DamagedCheckpoint, load_checkpoint, save_checkpoint
from minisplat_ref.io.ply import load_ply, save_ply
from minisplat_ref.methods.adaptive.degrees import (
    SEEN,
    cut_degrees_when_cooling,
    drop_idle_degrees,
    highest_degree,
    raise_degrees,
)
from minisplat_ref.methods.adaptive.recipe import ADAPTIVE
from minisplat_ref.reference.spherical_harmonics import sh_colors
from minisplat_ref.rendering import RenderSettings, render
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.strategy.ops import take
from minisplat_ref.training.loop import train
from minisplat_ref.training.pace import Pace, measured_ids
from minisplat_ref.training.rates import present_degrees
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.saved_state import load_state, save_state
from minisplat_ref.training.state import DEGREES
from minisplat_ref.types import Camera, Gaussians, Scene, View, view_from
from scenes import as_dtype, make_camera, make_gaussians
from tolerances import CLOSED_FORM

BACKGROUND = np.array([0.3, 0.3, 0.3])
N_VIEWS = 24
SHORT = configure(ADAPTIVE._replace(iterations=600), min_step=10_000, budget=40, hold_out_from=0)


# Grow -----------------------------------------------------------------------------------------------------------------


def test_degrees_by_hand():
    views = np.array([0, 7, 8, 17, 18, 31, 32, 500])
    assert highest_degree(views, 2.0).tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert highest_degree(views, 2.0, most=1).tolist() == [0, 0, 1, 1, 1, 1, 1, 1]
    assert highest_degree(views, 0.5).tolist() == [0, 2, 3, 3, 3, 3, 3, 3]
    assert not highest_degree(views, np.inf).any()


def test_a_view_counts_once_and_only_where_it_shows_something(matt):
    """Of three Gaussians in the frustum the first has no gradient: it is behind the others."""
    scene, truth = matt
    state = state_of(scene, truth)
    v = np.ones((len(truth.means), 2), np.float32)
    v[0] = 0
    for view in (*scene.train_views[:3], scene.train_views[1]):
        here = iteration_of(scene)._replace(view=view, visible_ids=np.array([0, 1, 2]), v_means2d=v)
        raise_degrees(state, here, views_per_coefficient=0.75)
    assert state.stats[SEEN].sum(axis=1)[:4].tolist() == [0, 3, 3, 0]
    assert state.stats[DEGREES][:4].tolist() == [0, 1, 1, 0]


# Cut ------------------------------------------------------------------------------------------------------------------


def around(n, height):
    """Views from a circle around the origin at a height, not level with it."""
    angles = 2 * np.pi * np.arange(n) / n
    centres = np.column_stack([np.cos(angles), np.sin(angles), np.full(n, height)])
    return tuple(view_from(Camera(np.eye(3), -centre, 9.0, 9.0, 4.0, 4.0, 8, 8)) for centre in centres)


def gray(**rest):
    """A Gaussian at the origin, float64, with coefficients above degree 0 by their index from 0."""
    sh_rest = np.zeros((1, 15, 3))
    for k, value in rest.items():
        sh_rest[0, int(k[1:])] = value
    return Gaussians(np.zeros((1, 3)), np.ones((1, 4)), np.zeros((1, 3)), np.zeros(1), np.full((1, 3), 0.1), sh_rest)


def cut(gaussians, degree, least, views):
    is_seen = np.ones((1, len(views)), bool)
    return drop_idle_degrees(gaussians, np.array([degree], np.uint8), views, is_seen, least)


def test_variation_by_hand():
    """On a circle at 45 degrees x is cos(phi) / sqrt 2: k_11 = 1 varies by C1 / 2, from one side of which it goes."""
    views = around(12, 1.0)
    for least, degree in ((SH_C1 / 2 + 1e-9, 0), (SH_C1 / 2 - 1e-9, 1)):
        left, degrees = cut(gray(k2=1.0), 1, least, views)
        assert degrees.tolist() == [degree] and left.sh_rest.any() == bool(degree)


def test_what_does_not_vary_moves_to_degree_0():
    """k_10 is the same from every point of the circle; without it the colours there are what they were."""
    views, g = around(12, 1.0), gray(k1=0.4)
    left, degrees = cut(g, 1, 1e-6, views)
    assert degrees.tolist() == [0] and not left.sh_rest.any() and g.sh_rest.any()
    assert_allclose(left.sh_dc[0] - 0.1, -SH_C1 * 0.4 / np.sqrt(2) / SH_C0, rtol=CLOSED_FORM)  # they look down: z < 0
    for view in views:
        before, after = (
            sh_colors(x.means, x.sh_dc, x.sh_rest, view.camera, 3, np.ones((1, 2), int)) for x in (g, left)
        )
        assert_allclose(after, before, atol=CLOSED_FORM)


def test_lower_bands_stay_below_one_that_varies():
    views = around(12, 1.0)
    varied, degrees = cut(gray(k8=1.0), 3, 0.01, views)  # k_3-3
    assert degrees.tolist() == [3] and varied.sh_rest[0, 8].all()
    _, degrees = cut(gray(k2=1.0, k8=1e-4), 3, 0.01, views)
    assert degrees.tolist() == [1]


def test_only_seen_directions_count():
    """From one side alone there is nothing that varies."""
    views, g = around(12, 1.0), gray(k2=1.0)
    is_seen = np.arange(12)[None] == 3
    _, degrees = drop_idle_degrees(g, np.array([1], np.uint8), views, is_seen, 1e-6)
    assert degrees.tolist() == [0]


def test_it_is_cut_once_and_moments_go_too(matt):
    scene, truth = matt
    state = state_of(scene, truth._replace(sh_rest=truth.sh_rest + np.float32(1e-4)))
    n = len(truth.means)
    state.stats |= {DEGREES: np.full(n, 2, np.uint8), SEEN: np.ones((n, N_VIEWS), bool)}
    state.adam.first.sh_rest[:], state.adam.second.sh_rest[:] = 1, 1
    state.pace = Pace(cooling_from=10, last_step=20)
    for step in (10, 12):
        cut_degrees_when_cooling(state, iteration_of(scene, step), min_variation=0.01)
        assert (state.stats[DEGREES] == 2).all() and SEEN in state.stats
    cut_degrees_when_cooling(state, iteration_of(scene, 11), min_variation=0.01)
    assert not state.stats[DEGREES].any() and not state.gaussians.sh_rest.any() and SEEN not in state.stats
    assert not state.adam.first.sh_rest.any() and not state.adam.second.sh_rest.any()
    (decision,) = state.pace.decisions
    assert decision.what == "bands" and decision.why.startswith("100% of the Gaussians have one colour from all sides")


# Trained --------------------------------------------------------------------------------------------------------------


def scene_of(truth):
    """Photographs from an arc of 120 degrees around the middle of :func:`make_gaussians`."""
    views = []
    for i, a in enumerate(np.linspace(-np.pi / 3, np.pi / 3, N_VIEWS)):
        R = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
        centre = np.array([3 * np.sin(a), 0, 3 - 3 * np.cos(a)])
        camera = make_camera(24, 16)._replace(cam_from_world_R=R, cam_from_world_t=-R @ centre)
        image = render(truth, camera, background=BACKGROUND, backend=CPU)[0].image
        pixels = np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)
        views.append(View(f"view{i}", camera, pixels, None, view_id=i))
    colors = np.full((len(truth.means), 3), 128, np.uint8)
    return Scene("tiny", tuple(views), (), truth.means.astype(float), colors, BACKGROUND, 1.0)


@pytest.fixture(scope="module")
def matt():
    truth = as_dtype(make_gaussians(np.random.default_rng(5), 30), np.float32)
    truth = truth._replace(sh_dc=np.clip(truth.sh_dc, -0.6, 0.4), sh_rest=0 * truth.sh_rest)
    return scene_of(truth), truth


@pytest.fixture(scope="module")
def trained(matt):
    """Of the matt scene, and of one whose colours change with the direction."""
    scene, truth = matt
    shiny = truth._replace(sh_rest=truth.sh_rest.copy())
    shiny.sh_rest[:, :3] = np.random.default_rng(2).normal(size=(30, 3, 3)) * 0.3
    return [train(s, SHORT, seed=0, state=state_of(s, truth)) for s in (scene, scene_of(shiny))]


def test_a_matt_scene_has_hardly_any_bands_and_a_shiny_one_has(trained):
    shares = [np.mean(state.stats[DEGREES] > 0) for state in trained]
    assert shares[0] < 0.2 and shares[1] > 0.7


def test_absent_bands_are_zeros_for_every_viewer(trained, tmp_path):
    state = trained[1]
    degrees = state.stats[DEGREES]
    assert len(np.unique(degrees)) > 1
    is_absent = np.arange(15) >= ((degrees.astype(int) + 1) ** 2 - 1)[:, None]
    for rows in (state.gaussians, state.adam.first, state.adam.second):
        assert not rows.sh_rest[is_absent].any() and rows.sh_rest[~is_absent].any()
    save_ply(tmp_path / "a.ply", state.gaussians)
    gaussians = load_ply(tmp_path / "a.ply")
    camera = make_camera(24, 16)
    own = render(state.gaussians, camera, sh_degree=degrees)[0].image
    assert_array_equal(render(gaussians, camera)[0].image, own)


def test_no_band_for_fewer_views_than_it_needs(matt):
    """Four of six views are trained on before the cool-down, and six are needed for degree 1."""
    scene, truth = matt
    few = scene._replace(train_views=scene.train_views[::4])
    assert len(few.train_views) - len(measured_ids(6, 8)) == 4
    state = train(few, SHORT._replace(iterations=60), seed=0, state=state_of(few, truth))
    assert not state.stats[DEGREES].any() and not state.gaussians.sh_rest.any()


def test_fine_tuning_leaves_absent_bands_absent(matt, trained):
    scene, degrees = matt[0], trained[1].stats[DEGREES]
    run = SimpleNamespace(
        model=trained[1].model,
        recipe=SHORT,
        settings=SimpleNamespace(seed=0),
        scene=scene,
        render_settings=RenderSettings(),
    )
    gaussians = take(run.model.gaussians, np.arange(len(degrees)))
    tuned = fine_tune(run, gaussians, 5, views=range(3), on_step=lambda: None).gaussians.sh_rest
    assert_array_equal(present_degrees(tuned), degrees)
    assert (tuned != trained[1].gaussians.sh_rest)[degrees > 1][:, 3:].any()


def test_a_negative_number_of_views():
    with pytest.raises(InputError, match="views_per_coefficient is -1"):
        highest_degree(np.array([3]), -1.0)


@pytest.mark.parametrize("wrong", [np.full(30, 4, np.uint8), np.zeros(30, np.int64), np.zeros((30, 1), np.uint8)])
def test_degrees_of_a_damaged_checkpoint(matt, tmp_path, wrong):
    scene, truth = matt
    state = state_of(scene, truth)
    state.stats[DEGREES] = np.full(30, 3, np.uint8)
    save_state(tmp_path / "a.npz", state, ADAPTIVE)
    assert_array_equal(load_state(tmp_path / "a.npz", ADAPTIVE).stats[DEGREES], 3)
    arrays, metadata = load_checkpoint(tmp_path / "a.npz")
    save_checkpoint(tmp_path / "b.npz", {**arrays, f"stats.{DEGREES}": wrong}, metadata)
    with pytest.raises(DamagedCheckpoint, match="no degrees of the stored harmonics"):
        load_state(tmp_path / "b.npz", ADAPTIVE)
