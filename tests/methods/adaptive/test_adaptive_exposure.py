"""``adaptive`` gives photographs the exposures that tracks show, before the first iteration, held-out ones too."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from adaptive_states import HOLDING, iteration_of
from minisplat_ref.app.cli import main
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.io.checkpoint import DamagedCheckpoint, load_checkpoint, save_checkpoint
from minisplat_ref.methods import get_recipe
from minisplat_ref.methods.adaptive.recipe import ADAPTIVE
from minisplat_ref.training.calibration import EXPOSURES, LEARNED, NONE
from minisplat_ref.training.exposure_gauge import hold_mean_exposure
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.loop import train
from minisplat_ref.training.pace import Pace, measured_ids, trained_ids
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.saved_state import load_state, save_state
from minisplat_ref.training.schedule import At, Every

SETTINGS = {"n_views": 12, "width": 64, "height": 48, "n_points": 1000}
GAINS = np.array([0.7, 1.2, 1.0, 0.8, 1.1, 0.9, 1.3, 1.0, 0.75, 1.25, 0.95, 1.05])
DARKER = 0.7  # factor of all photographs, so that nothing is clipped
IDENTITY = np.eye(3, 4)


def disturb(views):
    """Multiply photographs by gains."""
    return tuple(
        view._replace(image=np.rint(DARKER * gain * view.image).clip(0, 255).astype(np.uint8))
        for view, gain in zip(views, GAINS, strict=False)
    )


def early(recipe):
    """The recipe, which asks at a fifth of the iterations, and measures every 20th."""

    def changed(event):
        if isinstance(event, At):
            return event._replace(step=event.step // 5)
        return event._replace(period=20, start=20) if isinstance(event, Every) else event

    events = tuple(changed(event) for event in recipe.events)
    return configure(recipe._replace(events=events, iterations=480), min_step=10_000)


@pytest.fixture(scope="module")
def walls():
    """A room whose walls are bare: texture would blur what its few pixels show of a point."""
    return make_scene("plain-wall", supersampling=1, test_every=1000, **SETTINGS).scene


@pytest.fixture(scope="module")
def disturbed(walls):
    return walls._replace(train_views=disturb(walls.train_views))


def test_all_photographs_have_the_planted_exposures(disturbed):
    """Held-out training views as well; relative to their mean, which the scene's colours take."""
    state, n = initial_state(disturbed, ADAPTIVE, 0), len(disturbed.train_views)
    planted = np.log(GAINS[:n] / GAINS[:n].mean())
    held = measured_ids(n, HOLDING.cooling.hold_out_every)
    found = np.log(state.shared[EXPOSURES][:, range(3), range(3)])
    assert len(held) >= 2 and np.abs(planted[held]).max() > 0.02
    assert_allclose(found, np.tile(planted[:, None], 3), atol=0.03)
    assert_allclose(state.shared[EXPOSURES].mean(axis=0), IDENTITY, atol=1e-6)
    assert state.pace.switched_on == ("exposure",) and state.pace.decisions[0].step == 0


def test_the_mean_is_held_by_the_views_in_training(disturbed):
    """Twelve views, two of them held out; all maps 0.1 too large, so that those in training give 0.12 each."""
    state, n = initial_state(disturbed, ADAPTIVE, 0), len(disturbed.train_views)
    held, trained = measured_ids(n, HOLDING.cooling.hold_out_every), trained_ids(n, HOLDING.cooling, Pace())
    before = state.shared[EXPOSURES].copy()
    hold_mean_exposure(state, iteration_of(disturbed))
    assert_array_equal(state.shared[EXPOSURES], before)  # the mean is where it should be
    state.shared[EXPOSURES] += np.float32(0.1)
    hold_mean_exposure(state, iteration_of(disturbed))
    assert (n, len(held)) == (12, 2)
    assert_allclose(state.shared[EXPOSURES][held] - before[held], 0.1, atol=1e-6)
    assert_allclose(state.shared[EXPOSURES][trained] - before[trained], 0.1 - 0.12, atol=1e-6)
    state.shared = {}
    hold_mean_exposure(state, iteration_of(disturbed))
    assert state.shared == {}


@pytest.mark.parametrize("without", ["gains", "tracks", "request"])
def test_no_exposures_without_evidence(walls, disturbed, without):
    """Photographs that do not differ, that have no tracks, or whose exposures nobody wants."""
    views = tuple(view._replace(point_ids=None) for view in disturbed.train_views)
    scene = {"gains": walls, "tracks": disturbed._replace(train_views=views), "request": disturbed}[without]
    state = initial_state(scene, configure(ADAPTIVE, exposure=NONE) if without == "request" else ADAPTIVE, 0)
    assert state.shared == {} and state.pace == Pace()


def test_training_refines_the_gains_and_continues_byte_for_byte(disturbed, tmp_path):
    recipe = early(ADAPTIVE)
    saved = []

    def save(report):
        if report.step in (150, 350):  # before the cool-down, and in it before the first slice, which comes at 401
            saved.append(tmp_path / f"{report.step}.npz")
            save_state(saved[-1], report.state, recipe)

    straight = train(disturbed, recipe, seed=0, on_step=save)
    assert straight.pace.decisions[0].what == "exposures"
    assert {"cool down", "prune"} <= {decision.what for decision in straight.pace.decisions}
    assert (straight.shared[EXPOSURES] != initial_state(disturbed, recipe, 0).shared[EXPOSURES]).any(axis=(1, 2)).all()
    assert_allclose(straight.shared[EXPOSURES].mean(axis=0), IDENTITY, atol=1e-5)
    found = straight.shared[EXPOSURES][:, :, :3].trace(axis1=1, axis2=2) / 3
    assert np.corrcoef(found, GAINS[: len(found)])[0, 1] > 0.95
    for path in saved:
        state = train(disturbed, recipe, seed=0, state=load_state(path, recipe))
        for field, other in zip(state.gaussians, straight.gaussians, strict=True):
            assert_array_equal(field, other)
        assert_array_equal(state.shared[EXPOSURES], straight.shared[EXPOSURES])
        assert state.pace == straight.pace
    arrays, metadata = load_checkpoint(saved[0])
    pace = {**metadata["pace"], "switched_on": ["fog"]}
    save_checkpoint(saved[0], arrays, {**metadata, "pace": pace})
    with pytest.raises(DamagedCheckpoint, match="calibration that does not exist"):
        load_state(saved[0], recipe)


def test_held_out_views_are_measured_better_with_their_exposures(disturbed):
    """By several decibels: their gains are from 0.8 to 1.25 of the mean."""
    psnrs = {}
    for recipe in (early(HOLDING), early(configure(HOLDING, exposure=NONE))):
        state = train(disturbed, recipe._replace(iterations=160), seed=0)
        psnrs[recipe.exposure] = state.pace.measurements[-1].psnr
    assert psnrs["refined"] > psnrs["none"] + 1


def test_learned_exposures_begin_with_the_identity_and_held_out_views_keep_it(disturbed):
    """Until the rates fall and they are trained on, too."""
    recipe = configure(early(HOLDING), exposure=LEARNED)
    seen = []
    train(
        disturbed,
        recipe._replace(iterations=60),
        seed=0,
        on_step=lambda report: seen.append((report.step, report.state.pace, report.state.shared[EXPOSURES].copy())),
    )
    n, every = len(disturbed.train_views), HOLDING.cooling.hold_out_every
    step, pace, exposures = [each for each in seen if each[1].cooling_from is None][-1]
    assert step > n and pace.decisions == ()
    assert_array_equal(exposures[measured_ids(n, every)], np.tile(IDENTITY, (len(measured_ids(n, every)), 1, 1)))
    assert (exposures[trained_ids(n, HOLDING.cooling, Pace())] != IDENTITY).any(axis=(1, 2)).all()
    assert (seen[-1][2][measured_ids(n, every)] != IDENTITY).any()


def test_the_default_recipe_says_so(tmp_path):
    """Its decision is in the file and in the report, unless exposures are turned off."""
    folder, made = tmp_path / "nook", make_scene("plain-wall", supersampling=1, test_every=6, **SETTINGS)
    scene = made.scene._replace(train_views=disturb(made.scene.train_views))
    write_scene(made._replace(scene=scene), folder, SETTINGS)
    for out, options, whats in (("refined", [], ["exposures"]), ("none", ["--set", "exposure=none"], [])):
        command = ["train", str(folder), "--iterations", "24", "--test-every", "6", "--out", str(tmp_path / out)]
        assert main([*command, *options]) == 0
        decisions = json.loads((tmp_path / out / "decisions.json").read_text())
        assert [each["what"] for each in decisions["decisions"] if each["step"] == 0] == whats
        report = (tmp_path / out / "report.html").read_text()
        assert ("exposures: each photograph got its own exposure" in report) == bool(whats)
    assert get_recipe("adaptive", 24).exposure == "refined"
