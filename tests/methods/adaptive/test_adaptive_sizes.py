"""``adaptive`` trains on halved views first: how small, until when, and that a run continues and ends in time."""

import json

import pytest
from numpy.testing import assert_array_equal

from minisplat_ref.app.cli import main
from minisplat_ref.app.runs.decisions_report import decisions_section, story
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError
from minisplat_ref.methods.adaptive.recipe import ADAPTIVE
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.loop import train
from minisplat_ref.training.pace import COOLED, FINER, Decision, Measurement, Pace
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.saved_state import load_state, save_state
from minisplat_ref.training.smaller_views import halve_large_views

OPTIONS = {"n_views": 12, "width": 48, "height": 36, "n_points": 200, "test_every": 6}
TWICE = configure(ADAPTIVE._replace(iterations=3000), min_gain=1e9, min_step=300, min_side=18)
SMALL, WHOLE = (24, 18), (48, 36)


@pytest.fixture(scope="module")
def scene():
    return make_scene("room", supersampling=1, **OPTIONS).scene


@pytest.fixture(scope="module")
def trained(scene):
    """The size of each iteration's view in a whole training, and its end."""
    sizes = []
    state = train(scene, TWICE, seed=0, on_step=lambda r: sizes.append((r.view.camera.width, r.view.camera.height)))
    return sizes, state


@pytest.mark.parametrize(
    ("width", "height", "min_side", "times"),
    [
        (270, 480, 120, 1),
        (600, 240, 120, 1),
        (600, 239, 120, 0),
        (960, 540, 120, 2),
        (800, 533, 16, 5),
        (9, 9, 16, 0),
    ],
)
def test_no_side_of_any_view_becomes_shorter(scene, width, height, min_side, times):
    first, *_ = scene.train_views
    large, small = (first._replace(camera=first.camera._replace(width=k * width, height=k * height)) for k in (3, 1))
    scene = scene._replace(train_views=(large, small))
    assert halve_large_views(scene, min_side=min_side) == times
    assert halve_large_views(scene, min_side=min_side, max_halvings=1) == min(times, 1)


@pytest.mark.parametrize("min_side", [0, -5, 15.9, float("nan")])
def test_a_size_of_nothing_is_refused(scene, min_side):
    with pytest.raises(InputError, match=r"min_side is .*: give at least 16 pixels"):
        train(scene, configure(TWICE, min_side=min_side), seed=0)


def test_views_grow_before_the_rates_fall(trained):
    """After the first iteration, in which it is decided, views are small until the held-out ones gain too little."""
    sizes, state = trained
    finer, cooled = state.pace.decisions[:2]
    assert (finer.what, cooled.what) == (FINER, COOLED) and state.pace.cooling_from == cooled.step
    assert sizes[0] == WHOLE and set(sizes[1 : finer.step]) == {SMALL} and set(sizes[finer.step :]) == {WHOLE}
    assert len(sizes) == state.step == state.pace.last_step and state.pace.n_finer == 1


def test_each_size_is_judged_by_its_own_measurements(trained):
    _, state = trained
    finer, cooled = state.pace.decisions[:2]
    assert min(m.step for m in state.pace.before(cooled).recent()) > finer.step
    assert cooled.step - finer.step >= 400  # four measurements


@pytest.mark.parametrize("at", [150, 1000])
def test_continued_byte_for_byte(scene, trained, tmp_path, at):
    """From among the small views and from among the whole ones."""
    _, straight = trained

    class Stop(Exception):
        pass

    def stop(report):
        if report.step == at:
            raise Stop

    state = initial_state(scene, TWICE, 0)
    with pytest.raises(Stop):
        train(scene, TWICE, seed=0, state=state, on_step=stop)
    save_state(tmp_path / "state.npz", state, TWICE)
    state = load_state(tmp_path / "state.npz", TWICE)
    assert state.pace.n_finer == (at == 1000)
    train(scene, TWICE, seed=0, state=state)
    assert state.pace == straight.pace
    for field, other in zip(state.gaussians, straight.gaussians, strict=True):
        assert_array_equal(field, other)


def test_the_limit_leaves_small_views_behind(scene):
    sizes = []
    recipe = configure(TWICE._replace(iterations=160), min_step=10_000)
    state = train(scene, recipe, seed=0, on_step=lambda r: sizes.append((r.view.camera.width, r.view.camera.height)))
    assert state.pace.cooling_from == 100 and set(sizes[1:100]) == {SMALL} and set(sizes[100:]) == {WHOLE}


def test_from_the_command_line_in_time(tmp_path, capsys):
    folder, run = tmp_path / "nook", tmp_path / "run"
    write_scene(make_scene("room", supersampling=1, **OPTIONS), folder, OPTIONS)
    options = ["--test-every", "6", "--set", "min_step=100000", "--set", "min_side=18"]
    assert main(["train", str(folder), *options, "--minutes", "0.1", "--out", str(run)]) == 0
    decisions = json.loads((run / "decisions.json").read_text())
    finer, cooled = decisions["decisions"][:2]
    assert (finer["what"], cooled["what"]) == (FINER, COOLED)
    assert finer["why"] == "--minutes 0.1 leaves no more time"
    assert 0 < finer["step"] < cooled["step"]
    events = [json.loads(line) for line in (run / "events.jsonl").read_text().splitlines()]
    (halved,) = [event for event in events if event["action"] == "halve_large_views"]
    assert halved["note"] == "to 1/2 of their size"
    assert "views of twice the width and height were shown" in (run / "report.html").read_text()


def test_the_report_does_not_compare_sizes():
    """PSNR falls where larger views show more detail: each size is told, and drawn, by itself."""
    measurements = tuple(
        Measurement(100 * k, (20.0 + k, 21.0 + k) if k <= 4 else (15.0 + k, 16.0 + k), 10, 100 * k) for k in range(1, 9)
    )
    decisions = (Decision(400, FINER, "little", 0.1, 0.1), Decision(800, COOLED, "little", 0.2, 0.1))
    pace = Pace(measurements, decisions, 800, 800, 1280)
    assert (
        "from 21.50 dB after 100 iterations to 24.50 dB after 400, at twice the size from 20.50 dB after 500 iterations"
        " to 23.50 dB after 800." in story(pace, 1280)
    )
    page = decisions_section(pace, 1280)
    assert page.count("<svg") == 2 and "A red line" in page and "their own line" in page
    assert pace.before(decisions[1]).recent() == list(measurements[4:])
