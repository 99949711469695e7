"""``--set exposure=``: none, those that the tracks show, which stay as they are, or exposures that are trained."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.app.cli import main
from minisplat_ref.app.runs.decisions_report import decisions_section
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError
from minisplat_ref.methods import get_recipe
from minisplat_ref.strategy.track_gains import store_gains
from minisplat_ref.training.calibration import EXPOSURES, exposures_of_gains
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.loop import train
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.saved_state import load_state, save_state
from minisplat_ref.types import view_from
from scenes import make_camera

SETTINGS = {"n_views": 12, "width": 80, "height": 60, "n_points": 2000}
PLANTED = np.array([0.2, -0.2, 0.1, -0.1, 0.0, 0.15, -0.15, 0.05, -0.05, 0.2, -0.2, 0.0])


def recipe_with(source, iterations=6):
    return configure(get_recipe("3dgs-accel", iterations), exposure=source)


def plant(views):
    """Multiply photographs by exp(PLANTED), darker altogether, so that nothing is clipped."""
    return tuple(
        v._replace(image=np.rint(0.7 * np.exp(g) * v.image).clip(0, 255).astype(np.uint8))
        for v, g in zip(views, PLANTED, strict=False)
    )


@pytest.fixture(scope="module")
def room():
    return make_scene("room", supersampling=1, **SETTINGS).scene


@pytest.fixture(scope="module")
def exposed(room):
    return room._replace(train_views=plant(room.train_views))


def test_maps_of_gains_by_hand():
    """Gains of ln 2, 0 and ln 0.5 of the channels: a diagonal of 2, 1 and 0.5; without a gain the identity."""
    view = view_from(make_camera(4, 4))
    maps = exposures_of_gains([view, view._replace(log_gain=np.log([2.0, 1.0, 0.5]))])[EXPOSURES]
    assert maps.dtype == np.float32
    assert_array_equal(maps[0], np.eye(3, 4))
    assert_allclose(maps[1], [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0.5, 0]], rtol=1e-7)


def test_exposures_of_tracks_stay_as_they_are(exposed):
    """They are the planted ones, from the first iteration to the last; the decision is recorded."""
    state = train(exposed, recipe_with("tracks"), seed=0)
    gains = np.log(state.shared[EXPOSURES][:, range(3), range(3)])
    assert_allclose(gains, np.tile((PLANTED - PLANTED.mean())[: len(gains), None], 3), atol=0.05)
    assert_array_equal(state.shared[EXPOSURES], initial_state(exposed, recipe_with("tracks"), 0).shared[EXPOSURES])
    assert state.pace.switched_on == ("exposure",)
    (decision,) = state.pace.decisions
    assert (decision.step, decision.what) == (0, "exposures") and "differ by 1" in decision.why
    told = decisions_section(state.pace, 6, has_schedule=True)
    assert told.count("each photograph got its own exposure") == told.count(decision.why) == 1 and "<p>" not in told


def test_trained_exposures_leave_the_identity(exposed):
    state = train(exposed, recipe_with("learned"), seed=0)
    assert (state.shared[EXPOSURES] != np.eye(3, 4)).any() and state.pace.decisions == ()


@pytest.mark.parametrize("source", ["none", "tracks"])
def test_where_exposures_do_not_differ_there_are_none(room, source):
    state = initial_state(room, recipe_with(source), 0)
    assert EXPOSURES not in state.shared and state.pace.switched_on == ()


def test_no_exposures_on_request(exposed):
    assert EXPOSURES not in initial_state(exposed, recipe_with("none"), 0).shared


def test_a_training_with_the_exposures_of_tracks_is_nearer_to_the_photographs(exposed):
    """The same photographs, seed and iterations: the loss on the last ones is lower by a twentieth at least."""
    losses = {}
    for source in ("none", "tracks"):
        reports = []
        train(exposed, recipe_with(source, 60), seed=0, on_step=lambda report, seen=reports: seen.append(report.loss))
        losses[source] = np.mean(reports[-20:])
    assert losses["tracks"] < 0.95 * losses["none"]


def test_a_continued_training_has_the_same_bytes(exposed, tmp_path):
    recipe = recipe_with("tracks", 8)
    whole = train(exposed, recipe, seed=1)
    save_state(tmp_path / "half.npz", train(exposed, recipe._replace(iterations=4), seed=1), recipe)
    continued = train(exposed, recipe, seed=1, state=load_state(tmp_path / "half.npz", recipe))
    assert_array_equal(continued.gaussians.means, whole.gaussians.means)
    assert_array_equal(continued.shared[EXPOSURES], whole.shared[EXPOSURES])


def test_gains_are_stored_with_the_photographs_once(exposed, room):
    """Held-out photographs have theirs, too; a scene that has gains stays, as one does that needs none."""
    views = exposed.train_views
    split = exposed._replace(train_views=views[1:], test_views=views[:1])
    stored = store_gains(split)
    assert all(view.log_gain is not None for view in (*stored.train_views, *stored.test_views))
    difference = stored.test_views[0].log_gain - stored.train_views[0].log_gain
    assert_allclose(difference, PLANTED[0] - PLANTED[1], atol=0.06)
    assert store_gains(stored) is stored and store_gains(room) is room


def test_an_unknown_source_is_refused():
    with pytest.raises(InputError, match="exposure=guessed: choose from none, tracks, refined, learned"):
        recipe_with("guessed")


def test_from_the_command_line(room, tmp_path, capsys):
    """A folder with planted exposures: trained, reported, and measured in three ways; ``eval`` says the same."""
    folder, out = tmp_path / "nook", tmp_path / "run"
    made = make_scene("room", supersampling=1, **SETTINGS)
    planted = made.scene._replace(train_views=plant(made.scene.train_views), test_views=plant(made.scene.test_views))
    write_scene(made._replace(scene=planted), folder, SETTINGS)
    options = ["--recipe", "3dgs-accel", "--iterations", "20", "--set", "exposure=tracks", "--test-every", "4"]
    assert main(["train", str(folder), "--out", str(out), *options]) == 0
    assert "with the exposures that their tracks show" in capsys.readouterr().out
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["psnr_exposed"] > metrics["psnr"] + 0.5
    assert metrics["psnr_corrected"] > metrics["psnr"]
    report = (out / "report.html").read_text()
    assert "exposures: each photograph got its own exposure<" in report and "colours fitted" in report
    assert main(["eval", str(out), "--color-corrected"]) == 0
    assert "PSNR dB  exposed  corrected" in capsys.readouterr().out
    assert json.loads((out / "metrics.json").read_text())["psnr_exposed"] == metrics["psnr_exposed"]
