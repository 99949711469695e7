"""Exposures that ``adaptive`` switches on where the photographs need them, and where they do not, leaves off."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from adaptive_states import iteration_of, state_of
from minisplat_ref.io.checkpoint import DamagedCheckpoint, load_checkpoint, save_checkpoint
from minisplat_ref.methods.adaptive.exposure import hold_mean_exposure, log_gains
from minisplat_ref.methods.adaptive.prune import take_all_views
from minisplat_ref.methods.adaptive.recipe import ADAPTIVE
from minisplat_ref.methods.adaptive.switches import switch_exposure_on
from minisplat_ref.rendering import render
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.training.calibration import EXPOSURES
from minisplat_ref.training.loop import train
from minisplat_ref.training.pace import Pace, held_out_ids, trained_ids
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.saved_state import load_state, save_state
from minisplat_ref.training.schedule import At, Every
from minisplat_ref.types import Scene, View
from scenes import as_dtype, make_camera, make_gaussians

GAINS = np.array([0.7, 1.2, 1.0, 0.8, 1.1, 0.9, 1.3, 1.0])
ROUNDED = 0.01  # of a brightness: photographs are bytes, here of 13 to 250
BACKGROUND = np.array([0.3, 0.3, 0.3])


def scene_of(truth, gains):
    rng = np.random.default_rng(1)
    views = []
    for i, gain in enumerate(gains):
        camera = make_camera(24, 16, rng=rng)
        image = render(truth, camera, background=BACKGROUND, backend=CPU)[0].image
        pixels = np.round(255 * np.clip(gain * np.clip(image, 0, 1), 0, 1)).astype(np.uint8)
        views.append(View(f"view{i}", camera, pixels, None, view_id=i))
    colors = np.full((len(truth.means), 3), 128, np.uint8)
    return Scene("tiny", tuple(views), (), truth.means.astype(float), colors, BACKGROUND, 1.0)


@pytest.fixture(scope="module")
def truth():
    gaussians = as_dtype(make_gaussians(np.random.default_rng(5), 30), np.float32)
    return gaussians._replace(sh_dc=np.clip(gaussians.sh_dc, -0.6, 0.4), sh_rest=0 * gaussians.sh_rest)


@pytest.fixture
def disturbed(truth):
    return scene_of(truth, GAINS)


def test_gains_are_read_off(disturbed, truth):
    gains = log_gains(state_of(disturbed, truth), iteration_of(disturbed), range(8))
    assert_allclose(gains, np.log(GAINS), atol=ROUNDED)


def test_pixels_outside_the_mask_say_nothing(disturbed, truth):
    first = disturbed.train_views[0]
    image = first.image.copy()
    image[:8] = 200
    mask = np.ones(image.shape[:2], bool)
    mask[:8] = False
    views = (first._replace(image=image, mask=mask), *disturbed.train_views[1:])
    masked = disturbed._replace(train_views=views)
    assert_allclose(log_gains(state_of(masked, truth), iteration_of(masked), [0]), np.log(0.7), atol=ROUNDED)
    black = disturbed._replace(train_views=(first._replace(image=0 * image), *disturbed.train_views[1:]))
    assert_array_equal(log_gains(state_of(black, truth), iteration_of(black), [0]), [0.0])


def test_equal_exposures_switch_nothing_on(truth):
    scene = scene_of(truth, np.ones(8))
    state = state_of(scene, truth)
    assert "nothing done" in switch_exposure_on(
        state, iteration_of(scene), min_exposure_gain=0.05, min_antialiasing_gain=0.05
    )
    assert state.shared == {} and state.pace == Pace()


def test_different_exposures_switch_them_on(disturbed, truth):
    """They begin with the gains, relative to the geometric mean; held-out views begin with the identity."""
    state = state_of(disturbed, truth)
    iteration = iteration_of(disturbed)
    switch_exposure_on(state, iteration, min_exposure_gain=0.05, min_antialiasing_gain=0.05)
    ids, held = trained_ids(8, ADAPTIVE.cooling, Pace()), held_out_ids(8, 8)
    relative = np.log(GAINS[ids]) - np.log(GAINS[ids]).mean()
    exposures = state.shared[EXPOSURES]
    assert_allclose(exposures[ids, 0, 0], np.exp(relative), atol=ROUNDED)
    assert_array_equal(exposures[held], np.tile(np.eye(3, 4), (len(held), 1, 1)))
    assert state.pace.switched_on == ("exposure",) and state.pace.decisions[0].what == "exposures"
    assert not state.shared_adam.first[EXPOSURES].any() and state.shared_adam.second[EXPOSURES].shape == (8, 3, 4)
    assert "are on" in switch_exposure_on(state, iteration, min_exposure_gain=0.05, min_antialiasing_gain=0.05)


def test_the_mean_stays_the_identity(disturbed, truth):
    state = state_of(disturbed, truth)
    hold_mean_exposure(state, iteration_of(disturbed))  # nothing to hold
    switch_exposure_on(state, iteration_of(disturbed), min_exposure_gain=0.05, min_antialiasing_gain=0.05)
    ids, held = trained_ids(8, ADAPTIVE.cooling, Pace()), held_out_ids(8, 8)
    state.shared[EXPOSURES] += np.float32(0.1)
    before = state.shared[EXPOSURES].copy()
    hold_mean_exposure(state, iteration_of(disturbed, 601))
    after = state.shared[EXPOSURES]
    assert_allclose(after[ids].mean(axis=0), np.eye(3, 4), atol=1e-6)
    assert_allclose(after[ids] - after[ids[0]], before[ids] - before[ids[0]], atol=1e-6)
    state.pace = state.pace._replace(cooling_from=700, last_step=900, is_pruning=True)
    hold_mean_exposure(state, iteration_of(disturbed, 701))
    assert_array_equal(state.shared[EXPOSURES][held], before[held])
    take_all_views(state, iteration_of(disturbed, 750))
    hold_mean_exposure(state, iteration_of(disturbed, 751))
    joined = state.shared[EXPOSURES]
    assert_allclose(joined.mean(axis=0), np.eye(3, 4), atol=1e-6)
    ratios = joined[held, 0, 0] / joined[held[0], 0, 0]
    assert_allclose(ratios, GAINS[held] / GAINS[held[0]], rtol=0.05)  # read off a scene that is too dark by the mean


def early(recipe):
    """The recipe, which asks at a fifth of the iterations, measures every 20th, and keeps opacities as they are."""

    def changed(event):
        if isinstance(event, At):
            return event._replace(step=event.step // 5)
        return event._replace(period=20, start=20) if isinstance(event, Every) else event

    events = tuple(changed(event) for event in recipe.events)
    return configure(recipe._replace(events=events, iterations=320), min_step=10_000, min_antialiasing_gain=np.inf)


def test_training_recovers_the_gains_and_continues_byte_for_byte(disturbed, tmp_path):
    recipe = early(ADAPTIVE)
    saved = []

    def save(report):
        if report.step in (150, 250):  # with exposures, before the cool-down and in it
            saved.append(tmp_path / f"{report.step}.npz")
            save_state(saved[-1], report.state, recipe)

    straight = train(disturbed, recipe, seed=0, on_step=save)
    whats = [decision.what for decision in straight.pace.decisions]
    assert whats[:2] == ["exposures", "cool down"] and set(whats[2:]) == {"prune", "prune ended", "bands"}
    found = straight.shared[EXPOSURES][:, :, :3].trace(axis1=1, axis2=2) / 3
    assert np.corrcoef(found, GAINS)[0, 1] > 0.95
    for path in saved:
        state = train(disturbed, recipe, seed=0, state=load_state(path, recipe))
        for field, other in zip(state.gaussians, straight.gaussians, strict=True):
            assert_array_equal(field, other)
        assert_array_equal(state.shared[EXPOSURES], straight.shared[EXPOSURES])
    arrays, metadata = load_checkpoint(saved[0])
    pace = {**metadata["pace"], "switched_on": ["fog"]}
    save_checkpoint(saved[0], arrays, {**metadata, "pace": pace})
    with pytest.raises(DamagedCheckpoint, match="calibration that does not exist"):
        load_state(saved[0], recipe)
