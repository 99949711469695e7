"""What halves of photographs say about displacements, and poses that ``adaptive`` refines by it."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from adaptive_states import HOLDING, iteration_of, state_of
from minisplat_ref.methods.adaptive.evidence import Evidence, Half, displacements, slopes, split_halves, weigh
from minisplat_ref.methods.adaptive.pose import displacement_rotation, hold_mean_pose, turn_held_out
from minisplat_ref.methods.adaptive.recipe import ADAPTIVE
from minisplat_ref.methods.adaptive.switches import switch_pose_on
from minisplat_ref.rendering import render
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.training.calibration import ROTATIONS, SHIFTS, correct_pose
from minisplat_ref.training.loop import train
from minisplat_ref.training.pace import Pace, measured_ids, trained_ids
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.saved_state import load_state, save_state
from minisplat_ref.training.schedule import At, Every
from minisplat_ref.types import Scene, View
from scenes import as_dtype, make_camera, make_gaussians
from tolerances import DISPLACEMENT_PX

BACKGROUND = np.array([0.3, 0.3, 0.3])
N_VIEWS = 10


# Halves ---------------------------------------------------------------------------------------------------------------


def test_half_by_hand():
    """Residuals 1, 2 beside fields 1, 1: x = 3 / 2, and (1/4 + 1/4) is left."""
    half = Half(np.array([[2.0]]), np.array([3.0]), 5.0)
    assert_allclose(half.fitted(), [1.5])
    assert half.squared_residual(np.array([1.5])) == pytest.approx(0.5)
    assert half.squared_residual(np.array([0.0])) == 5.0


def test_evidence_is_told_in_words():
    found = Evidence(0.731, 0.1, np.zeros((3, 1)))
    assert found.describe("cameras turned by 0.43 pixels") == (
        "cameras turned by 0.43 pixels, fitted to one half of each photograph, improve the other half by 0.73 ± 0.10 dB"
    )
    worse = found._replace(gain=-0.03).describe("a sky in place of 9 large Gaussians", "half of them", "the others")
    assert worse == "a sky in place of 9 large Gaussians, fitted to half of them, worsens the others by 0.03 ± 0.10 dB"


def test_a_field_of_zeros_explains_nothing():
    residual, fields = np.ones((4, 6, 3)), np.zeros((1, 4, 6, 3))
    left, right = split_halves(residual, fields, np.ones((4, 6), bool))
    assert_array_equal(left.fitted(), [0.0])
    assert left.energy == right.energy == 36.0


def test_masked_pixels_are_in_neither_half():
    rng = np.random.default_rng(0)
    residual, fields = rng.normal(size=(4, 6, 3)), rng.normal(size=(2, 4, 6, 3))
    mask = rng.random((4, 6)) < 0.5
    poisoned = np.where(mask[..., None], residual, np.nan)
    for half, other in zip(split_halves(poisoned, fields, mask), split_halves(residual, fields, mask), strict=True):
        assert_array_equal(half.normal, other.normal)
        assert half.energy == other.energy


def test_slopes_by_hand():
    """Half the difference of both neighbours, the whole one at a border, and none across a single row or column."""
    row = np.array([[0.0, 1.0, 4.0, 9.0]])[..., None] * np.array([1.0, 0.0, -2.0])
    along_u, along_v = slopes(row)
    assert_array_equal(along_u[0], np.outer([1, 2, 4, 5], [1, 0, -2]))
    assert_array_equal(along_v, np.zeros((1, 4, 3)))
    assert_array_equal(slopes(row.swapaxes(0, 1)), [np.zeros((4, 1, 3)), along_u.swapaxes(0, 1)])


@pytest.mark.parametrize("size", [(1, 24), (24, 1), (1, 1)])
def test_photographs_one_pixel_wide_or_high_are_trained_on(size, rng):
    width, height = size
    cameras = [make_camera(width, height, fx=30.0, fy=30.0, rng=rng) for _ in range(6)]
    images = rng.integers(0, 256, (6, height, width, 3), np.uint8)
    views = tuple(View(f"view{i}", cameras[i], images[i], None, view_id=i) for i in range(6))
    points, colors = make_gaussians(rng, 30).means, np.full((30, 3), 128, np.uint8)
    scene = Scene("slit", views, (), points, colors, BACKGROUND, 1.0)
    state = train(scene, ADAPTIVE._replace(iterations=520, starts_densely=False), seed=0, backend=CPU)
    assert len(state.gaussians.means) > 0 and np.isfinite(state.gaussians.means).all()


def photographs_of(x, noise, rng):
    """Halves of photographs whose residuals are ``x`` [V] times a field of ones, and noise."""
    return [
        split_halves(value + noise * rng.normal(size=(8, 8, 3)), np.ones((1, 8, 8, 3)), np.ones((8, 8), bool))
        for value in x
    ]


def test_gain_by_hand():
    """Without noise but with x = 1, 1, -2 of mean 0: everything is explained, but for what is left to rounding."""
    rng = np.random.default_rng(0)
    evidence = weigh(photographs_of([1.0, 1.0, -2.0], 0.1, rng))
    left = 0.01 * np.array([1, 1, 1])
    expected = np.mean(10 * np.log10((np.array([1.0, 1.0, 4.0]) + left) / left))
    assert evidence.gain == pytest.approx(expected, abs=0.5) and evidence.is_above(0.05)
    assert_allclose(evidence.fitted[:, 0], [1.0, 1.0, -2.0], atol=0.05)
    assert evidence.spread == pytest.approx(np.sqrt(2.0), abs=0.05)


def test_noise_is_no_evidence_and_neither_is_what_all_have_in_common():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        assert not weigh(photographs_of(np.zeros(12), 1.0, rng)).is_above(0.0)
        assert not weigh(photographs_of(np.full(12, 3.0), 1.0, rng)).is_above(0.0)


def test_where_next_to_nothing_is_drawn_no_amount_is_read_from_noise():
    """A half whose field is a thousandth of the others' would say x = 1000 without a ridge."""
    rng = np.random.default_rng(0)
    photographs = photographs_of(np.zeros(12), 0.1, rng)
    faint = split_halves(np.ones((8, 8, 3)), np.full((1, 8, 8, 3), 1e-3), np.ones((8, 8), bool))
    evidence = weigh([*photographs, faint])
    assert np.abs(evidence.fitted).max() < 2.0 and evidence.gain < 0.05


def test_one_standard_error_and_the_least_gain():
    assert Evidence(0.3, 0.2, np.zeros((2, 1))).is_above(0.05)
    assert not Evidence(0.2, 0.2, np.zeros((2, 1))).is_above(0.05)
    assert not Evidence(0.3, 0.2, np.zeros((2, 1))).is_above(0.05, n_errors=3)
    assert not Evidence(0.04, 0.001, np.zeros((2, 1))).is_above(0.05)


# Poses ----------------------------------------------------------------------------------------------------------------


def turned(camera, w):
    R, t = correct_pose(camera.cam_from_world_R, camera.cam_from_world_t, w, np.zeros(3))
    return camera._replace(cam_from_world_R=R, cam_from_world_t=t)


@pytest.fixture(scope="module")
def truth():
    gaussians = as_dtype(make_gaussians(np.random.default_rng(5), 30), np.float32)
    return gaussians._replace(sh_dc=np.clip(gaussians.sh_dc, -0.6, 0.4), sh_rest=0 * gaussians.sh_rest)


def scene_of(truth, pixels):
    """Photographs of the truth, whose images are moved by ``pixels`` [V, 2] against what their cameras say."""
    rng, views = np.random.default_rng(1), []
    for i, displacement in enumerate(pixels):
        camera = make_camera(48, 32, rng=rng)
        seen_by = turned(camera, displacement_rotation(camera, displacement))
        image = render(truth, seen_by, background=BACKGROUND, backend=CPU)[0].image
        bytes_ = np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)
        views.append(View(f"view{i}", camera, bytes_, None, view_id=i))
    colors = np.full((len(truth.means), 3), 128, np.uint8)
    return Scene("tiny", tuple(views), (), truth.means.astype(float), colors, BACKGROUND, 1.0)


@pytest.fixture(scope="module")
def pixels():
    angles = np.random.default_rng(2).uniform(0, 2 * np.pi, N_VIEWS)
    return 0.5 * np.column_stack([np.cos(angles), np.sin(angles)])


@pytest.fixture(scope="module")
def disturbed(truth, pixels):
    return scene_of(truth, pixels)


def test_displacements_are_read_off(disturbed, truth, pixels):
    found = displacements(state_of(disturbed, truth), iteration_of(disturbed), range(N_VIEWS))
    assert_allclose(found, pixels, atol=DISPLACEMENT_PX)


def test_right_poses_switch_nothing_on(truth):
    scene = scene_of(truth, np.zeros((N_VIEWS, 2)))
    state = state_of(scene, truth)
    assert "nothing done" in switch_pose_on(state, iteration_of(scene), min_pose_gain=0.05)
    assert state.shared == {} and state.pace == Pace()
    assert "nothing done" in turn_held_out(state, iteration_of(scene))
    hold_mean_pose(state, iteration_of(scene))


def test_wrong_poses_are_refined_from_their_displacements(disturbed, truth, pixels):
    state = state_of(disturbed, truth)
    iteration = iteration_of(disturbed)
    switch_pose_on(state, iteration, min_pose_gain=0.05)
    ids, held = trained_ids(N_VIEWS, HOLDING.cooling, Pace()), measured_ids(N_VIEWS, 8)
    relative = pixels[ids] - pixels[ids].mean(axis=0)
    expected = [displacement_rotation(disturbed.train_views[i].camera, d) for i, d in zip(ids, relative, strict=True)]
    focal = disturbed.train_views[0].camera.fx
    assert_allclose(state.shared[ROTATIONS][ids] * focal, np.array(expected) * focal, atol=DISPLACEMENT_PX)
    assert not state.shared[ROTATIONS][held].any() and not state.shared[SHIFTS].any()
    assert state.pace.switched_on == ("pose",) and state.pace.decisions[0].gain > 0.05
    assert "are refined" in switch_pose_on(state, iteration, min_pose_gain=0.05)


def test_of_few_views_none_is_turned(disturbed, truth):
    """All are trained on, and their poses with them."""
    state, here = state_of(disturbed, truth), iteration_of(disturbed)._replace(cooling=ADAPTIVE.cooling)
    switch_pose_on(state, here, min_pose_gain=0.05)
    before = state.shared[ROTATIONS].copy()
    assert "no views are held out" in turn_held_out(state, here)
    assert_array_equal(state.shared[ROTATIONS], before)


def test_held_out_views_are_turned_to_the_scene(disturbed, truth, pixels):
    state = state_of(disturbed, truth)
    switch_pose_on(state, iteration_of(disturbed), min_pose_gain=0.05)
    turn_held_out(state, iteration_of(disturbed))
    for index in measured_ids(N_VIEWS, 8):
        camera = disturbed.train_views[index].camera
        found = state.shared[ROTATIONS][index] * camera.fx
        assert_allclose(found, displacement_rotation(camera, pixels[index]) * camera.fx, atol=DISPLACEMENT_PX)


def test_the_mean_correction_stays_zero_in_the_world(disturbed, truth):
    state = state_of(disturbed, truth)
    switch_pose_on(state, iteration_of(disturbed), min_pose_gain=0.05)
    rng = np.random.default_rng(0)
    for name in (ROTATIONS, SHIFTS):
        state.shared[name] += rng.normal(size=3) + 0.1 * rng.normal(size=(N_VIEWS, 3))
    hold_mean_pose(state, iteration_of(disturbed, 601))
    ids = trained_ids(N_VIEWS, HOLDING.cooling, Pace())
    for name in (ROTATIONS, SHIFTS):
        world = [disturbed.train_views[i].camera.cam_from_world_R.T @ state.shared[name][i] for i in ids]
        assert_allclose(np.mean(world, axis=0), np.zeros(3), atol=1e-12)
        assert np.abs(state.shared[name][ids]).max() > 0.01, "what differs from view to view stays"


def early(recipe):
    """The recipe, which looks at the photographs at 160 already, and measures every 20th iteration."""

    def changed(event):
        if isinstance(event, At):
            return event._replace(step=160)
        return event._replace(period=20, start=20) if isinstance(event, Every) else event

    events = tuple(changed(event) for event in recipe.events)
    return configure(recipe._replace(events=events, iterations=320), min_step=10_000)


def test_training_refines_the_poses_and_continues_byte_for_byte(truth, tmp_path):
    angles = np.random.default_rng(2).uniform(0, 2 * np.pi, N_VIEWS)
    scene = scene_of(truth, np.column_stack([np.cos(angles), np.sin(angles)]))
    recipe, saved = early(ADAPTIVE), []

    def save(report):
        if report.step == 190:
            saved.append(tmp_path / "190.npz")
            save_state(saved[-1], report.state, recipe)

    straight = train(scene, recipe, seed=0, on_step=save)
    assert "poses" in [decision.what for decision in straight.pace.decisions]
    again = train(scene, recipe, seed=0, state=load_state(saved[0], recipe))
    assert_array_equal(again.shared[ROTATIONS], straight.shared[ROTATIONS])
    assert_array_equal(again.gaussians.means, straight.gaussians.means)
