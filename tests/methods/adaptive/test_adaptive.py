"""``adaptive``: which views it trains on, how it grows, when it ends, and that it continues byte for byte."""

import json

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from adaptive_states import HOLDING
from minisplat_ref.app.cli import main
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError
from minisplat_ref.io.checkpoint import DamagedCheckpoint, load_checkpoint, save_checkpoint
from minisplat_ref.methods import get_recipe
from minisplat_ref.methods.adaptive import growth, prune
from minisplat_ref.methods.adaptive.growth import grow
from minisplat_ref.methods.adaptive.progress import proceed_when_little_is_gained
from minisplat_ref.methods.adaptive.prune import GAP_MIN, N_SLICES, N_UNPRUNED, prune_in_slices, slice_due
from minisplat_ref.methods.adaptive.recipe import ADAPTIVE
from minisplat_ref.methods.mini_splatting import measure_importance
from minisplat_ref.rendering import SPLATTING, RenderSettings
from minisplat_ref.strategy.error_weights import collect_error_weights
from minisplat_ref.strategy.halving import halves
from minisplat_ref.strategy.removal import collect_removal_costs
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.loop import train
from minisplat_ref.training.pace import (
    COOLED,
    FINER,
    Cooling,
    Decision,
    Measurement,
    Pace,
    measured_ids,
    pace_from_json,
    pace_to_json,
    trained_ids,
)
from minisplat_ref.training.recipe_settings import configure, settings_of
from minisplat_ref.training.saved_state import load_state, save_state
from minisplat_ref.training.state import Iteration

OPTIONS = {"n_views": 12, "width": 48, "height": 36, "n_points": 200, "test_every": 6}
COOLING = HOLDING.cooling
FAST = configure(HOLDING._replace(iterations=700), min_gain=1e9, min_step=300)  # ends as soon as it may


@pytest.fixture(scope="module")
def scene():
    return make_scene("room", supersampling=1, **OPTIONS).scene


@pytest.fixture(scope="module")
def reports(scene):
    """Of a whole training, without the images: iteration, view, end, population, pace."""
    seen = []
    state = train(
        scene,
        FAST,
        seed=0,
        on_step=lambda r: seen.append((r.step, r.view.name, r.last_step, len(r.state.gaussians.means))),
    )
    return seen, state


# Which views ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [*range(3, 40), 200])
def test_held_out_views_are_spread_and_leave_most(n):
    ids = measured_ids(n, 8)
    assert len(ids) == len(set(ids)) == max(2, n // 8) and 0 <= min(ids) and max(ids) < n
    gaps = np.diff(ids)
    assert len(gaps) == 0 or gaps.max() - gaps.min() <= 1
    assert sorted(ids + trained_ids(n, COOLING, Pace())) == list(range(n))
    assert trained_ids(n, COOLING, Pace(cooling_from=3)) == trained_ids(n, None, Pace()) == list(range(n))


@pytest.mark.parametrize(("n", "n_trained"), [(5, 5), (15, 15), (16, 14), (24, 21)])
def test_of_few_views_none_is_held_out(n, n_trained):
    """Two of 15 would be more than one in eight."""
    assert len(trained_ids(n, ADAPTIVE.cooling, Pace())) == n_trained


def test_no_step_is_taken_on_held_out_views_before_the_cool_down(scene, reports):
    seen, state = reports
    held = {scene.train_views[k].name for k in measured_ids(len(scene.train_views), COOLING.hold_out_every)}
    constant = {view for step, view, _, _ in seen if step <= state.pace.cooling_from}
    cooling = {view for step, view, _, _ in seen if step > state.pace.cooling_from}
    assert not constant & held and held <= cooling
    assert len(constant) == len(scene.train_views) - len(held)


# When it ends ---------------------------------------------------------------------------------------------------------


def test_it_ends_after_the_cool_down(reports):
    seen, state = reports
    decision, *others = state.pace.decisions
    pruned = [other for other in others if other.what == "prune"]
    assert decision.what == "cool down" and decision.step == state.pace.cooling_from
    assert pruned[0].step == decision.step + 1 + N_UNPRUNED * GAP_MIN
    assert [other.step for other in others if other.what == "bands"] == [decision.step + 1]
    assert {other.what for other in others} == {"prune", "prune ended", "bands"}
    assert state.step == state.pace.last_step == min(700, decision.step + -(-6 * decision.step // 10))
    assert seen[0][2] is None and seen[-1][2] == state.step
    assert [m.step for m in state.pace.measurements] == list(range(200, decision.step + 1, 100))


def test_the_limit_leaves_time_to_cool(scene):
    state = train(scene, configure(ADAPTIVE._replace(iterations=160), min_step=10_000), seed=0)
    assert state.step == 160 and state.pace.cooling_from == 100
    assert "limit of 160 iterations" in state.pace.decisions[0].why


def measured(psnrs_of_steps, **changes):
    """A state that has measured; the work is 1,000 pairs an iteration."""
    pace = Pace(tuple(Measurement(s, p, 10, 1000 * s) for s, p in psnrs_of_steps), n_pairs=1000 * psnrs_of_steps[-1][0])

    class State:
        view_order = (1, 2)

    state = State()
    state.pace = pace._replace(**changes)
    return state


class Photographs:
    """A scene of fifteen training views."""

    train_views = (None,) * 15


def iteration(step, cooling=COOLING):
    return Iteration(Photographs, *[None] * 4, step=step, iterations=30_000, cooling=cooling)


def decide(state, step, cooling=COOLING):
    return proceed_when_little_is_gained(state, iteration(step, cooling), min_gain=0.3, min_step=800)


def test_a_slope_by_hand():
    """The views gain 1 and 0.2 dB a doubling of the work: 0.6 on the mean, with a standard error of 0.4."""
    steps = [800, 1000, 1200, 1400, 1600]
    gains = [(20 + np.log2(s), 25 + 0.2 * np.log2(s)) for s in steps]
    state = measured(list(zip(steps, gains, strict=True)))
    assert decide(state, 1600) == "0.60 dB from twice the work" and state.pace.cooling_from is None
    flat = [(20 + 0.5 * np.log2(s), 25 - 0.1 * np.log2(s)) for s in steps]
    state = measured(list(zip(steps, flat, strict=True)))
    assert "would bring the held-out views 0.20 dB, less than" in decide(state, 1600)
    (decision,) = state.pace.decisions
    assert decision.gain == pytest.approx(0.2) and decision.standard_error == pytest.approx(0.3)
    assert (state.pace.cooling_from, state.pace.last_step, state.view_order) == (1600, 2560, [])


def test_few_views_are_not_asked():
    """However much they gain, as they are trained on; but not before 800, nor with less than four measurements."""
    steep = [(s, (np.log2(s), np.log2(s))) for s in (400, 500, 600, 700, 800)]
    assert decide(measured(steep[:4]), 700, ADAPTIVE.cooling) is None
    assert decide(measured(steep[2:]), 800, ADAPTIVE.cooling) is None
    state = measured(steep)
    assert "15 training views are too few to hold some out, so this comes as soon as it may" in decide(
        state, 800, ADAPTIVE.cooling
    )
    (decision,) = state.pace.decisions
    assert (decision.what, decision.gain, decision.standard_error) == ("cool down", None, None)
    assert (state.pace.cooling_from, state.pace.last_step) == (800, 1280)
    assert decide(measured(steep), 800) == "1.00 dB from twice the work"


def test_only_a_recipe_that_decides_its_length_holds_out():
    assert settings_of(ADAPTIVE)["hold_out_from"] == 16
    with pytest.raises(InputError, match="recipe 3dgs has no hold_out_from to set"):
        configure(get_recipe("3dgs"), hold_out_from=0)


def test_all_of_few_views_are_trained_on(scene):
    """From the first iteration on, until the rates fall."""
    seen = []
    recipe = configure(ADAPTIVE._replace(iterations=100), min_step=10_000)
    train(scene, recipe, seed=0, on_step=lambda r: seen.append((r.last_step, r.view.name)))
    assert {name for last, name in seen if last is None} == {view.name for view in scene.train_views}


def test_no_decision_without_evidence():
    flat = [(s, (20.0, 20.0)) for s in (500, 600, 700)]
    assert decide(measured(flat), 700) is None  # too early
    assert decide(measured([(s + 500, p) for s, p in flat]), 1200) is None  # too few measurements


def test_factors_fall_on_a_line_of_logarithms():
    cooling, pace = Cooling(0.5, 0.1, 0.01, 8), Pace(cooling_from=100, last_step=200)
    assert cooling.factors(80, Pace()) == cooling.factors(80, pace) == (1.0, 1.0)
    assert cooling.factors(150, pace) == pytest.approx((0.1**0.5, 0.1))
    assert cooling.factors(200, pace) == pytest.approx((0.1, 0.01))


def test_a_step_stays_as_many_pixels_when_views_double():
    """Two doublings: a quarter of the rate of the means, before the rates fall and at their end; others as they are."""
    finer = tuple(Decision(step, FINER, "why", 0.1, 0.1) for step in (1000, 1500))
    ended = Decision(2000, COOLED, "why", 0.1, 0.1)
    open_ended, ending = Pace(decisions=finer), Pace(decisions=(*finer, ended), cooling_from=2000, last_step=3000)
    rates, first = ADAPTIVE.rates_at(1600, 2.0, open_ended), ADAPTIVE.rates_at(900, 2.0, Pace())
    last = ADAPTIVE.rates_at(3000, 2.0, ending)
    assert rates["means"] == pytest.approx(first["means"] / 4)
    assert last["means"] == pytest.approx(first["means"] / 400)
    for name in first.keys() - {"means"}:
        assert rates[name] == first[name] and last[name] == pytest.approx(first[name] / 10)


# How it grows ---------------------------------------------------------------------------------------------------------


def test_those_behind_most_error_are_halved_and_not_too_many(scene):
    """Of three above the threshold two: those of largest error, or of largest gradient, which are others."""
    state = initial_state(scene, ADAPTIVE._replace(starts_densely=False), 0)
    before, n = state.gaussians, len(state.gaussians.means)
    here = Iteration(
        scene, scene.train_views[0], None, np.zeros(0, int), None, RenderSettings(scene.background), cooling=COOLING
    )
    trained = [scene.train_views[k] for k in trained_ids(len(scene.train_views), COOLING, state.pace)]
    errors = collect_error_weights(before, trained, RenderSettings(scene.background))
    above = np.argsort(errors)[-3:]
    means, views = np.zeros(n, np.float32), np.full(n, 2, np.int32)
    means[above] = (3e-3, 2e-3, 1e-3)
    settings = {"threshold": 4e-4, "offset": 0.5}
    for error_views, chosen in ((24, above[1:]), (0, above[:2])):
        state.gaussians, state.stats = before, {"gradient_sum": 2 * means, "view_count": views}
        grow(state, here, max_growth=2 / n, error_views=error_views, **settings)
        expected = halves(before, np.sort(chosen), offset=0.5).gaussians
        for field, other in zip(state.gaussians, expected, strict=True):
            assert_array_equal(field, other)
        assert state.stats == {}
    state.pace = state.pace._replace(cooling_from=100)
    assert "falling" in grow(state, here, max_growth=1.0, error_views=0, **settings)


def test_the_error_is_looked_for_from_the_first_view_to_the_last(scene, monkeypatch):
    """Three of the ten that are trained on: the first, the fifth and the tenth; every fourth would be the ninth."""
    state = initial_state(scene, ADAPTIVE._replace(starts_densely=False), 0)
    n, seen = len(state.gaussians.means), []
    here = Iteration(scene, None, None, np.zeros(0, int), None, RenderSettings(scene.background), cooling=COOLING)
    trained = trained_ids(len(scene.train_views), COOLING, state.pace)
    assert len(trained) == 10
    monkeypatch.setattr(growth, "collect_error_weights", lambda model, views, s: seen.extend(views) or np.zeros(n))
    state.stats = {"gradient_sum": np.ones(n, np.float32), "view_count": np.ones(n, np.int32)}
    grow(state, here, threshold=4e-4, max_growth=0.2, offset=0.5, error_views=3)
    assert [view.name for view in seen] == [scene.train_views[trained[k]].name for k in (0, 4, 9)]


def test_a_budget_is_a_ceiling(scene):
    """Also where it is below what the training begins with."""
    for budget in (230, 100):
        counts = []
        recipe = configure(ADAPTIVE._replace(iterations=500), budget=budget, threshold=0.0)
        train(scene, recipe, seed=0, on_step=lambda report, own=counts: own.append(len(report.state.gaussians.means)))
        assert max(counts) == max(budget, 200)


def test_slices_are_spread_over_the_first_part_of_the_cool_down():
    pace = Pace(cooling_from=1000, last_step=1650)
    due = {step: slice_due(pace, step) for step in range(900, 1700) if slice_due(pace, step) is not None}
    assert due == {1161 + 32 * k: k for k in range(-N_UNPRUNED, N_SLICES)}  # 32 is 0.64 * 650 / 13
    assert slice_due(pace._replace(cooling_from=None, last_step=None), 1001) is None
    short = Pace(cooling_from=10, last_step=180)  # they are 20 iterations apart, and none comes after 0.64 of 170
    assert [(step, slice_due(short, step)) for step in (10, 11, 12, 111, 112, 131)] == [
        (10, None),
        (11, -5),
        (12, None),
        (111, 0),
        (112, None),
        (131, None),
    ]


PRUNING = {"min_views": 2, "min_slope": 0.3, "max_pruned": 0.2, "max_psnr_cost": np.inf, "max_ssim_cost": np.inf}


@pytest.fixture
def cooling(scene):
    """A state that begins to cool, and its iteration; the first Gaussian lies far behind the cameras."""
    state = initial_state(scene, ADAPTIVE._replace(starts_densely=False), 0)
    centres = np.array([view.camera.center for view in scene.train_views])
    state.gaussians.means[0] = 100 * (centres.mean(axis=0) - scene.points.mean(axis=0))
    state.pace = Pace(cooling_from=10, last_step=270, is_pruning=True)  # the first slice is due at 111
    here = Iteration(scene, scene.train_views[0], None, np.zeros(0, int), None, RenderSettings(scene.background))
    return state, here._replace(cooling=COOLING)


def test_what_few_views_see_goes_with_the_first_slice(cooling):
    state, here = cooling
    before = state.gaussians
    for step in (110, 112):
        prune_in_slices(state, here._replace(step=step), **PRUNING)
        assert state.gaussians is before
    is_visible = measure_importance(state, here).is_visible
    prune_in_slices(state, here._replace(step=111), **PRUNING | {"min_slope": 0.0})
    assert_array_equal(state.gaussians.means, before.means[is_visible.sum(axis=1) >= 2])
    (decision,) = state.pace.decisions
    assert decision.what == "prune" and "fewer than 2 views" in decision.why


def test_what_the_photographs_would_hardly_miss_goes_in_slices(cooling):
    state, here = cooling
    before, settings = state.gaussians, PRUNING | {"min_views": 0}
    keep_out = collect_removal_costs(state.model, here.scene.train_views, RenderSettings(here.scene.background))
    prune_in_slices(state, here._replace(step=131), **settings | {"min_slope": 1e9})
    assert_array_equal(state.gaussians.means, before.means[np.sort(np.argsort(keep_out.changes, kind="stable")[40:])])
    assert "without 40 of 200 Gaussians the training views lose only" in state.pace.decisions[-1].why
    prune_in_slices(state, here._replace(step=151), **settings | {"min_slope": 1e-9})
    assert len(state.gaussians.means) == 160 and len(state.pace.decisions) == 1  # a slice of less than 1 % is left out


def of_values(psnrs, ssims):
    return [
        Measurement(11 + 20 * k, (p - 1, p + 1), 10, 0, (s, s))
        for k, (p, s) in enumerate(zip(psnrs, ssims, strict=True))
    ]


@pytest.mark.parametrize(
    ("limits", "ends"), [((0.1, np.inf), "0.20 ± 0.00 dB"), ((np.inf, 0.005), "0.0200 ± 0.0000 of SSIM"), ((1, 1), "")]
)
def test_the_prune_ends_where_it_costs_held_out_views_too_much(cooling, monkeypatch, limits, ends):
    """After a slice that cost 0.1 dB and 0.01 of SSIM, the next would make it twice as much; then all train."""
    state, here = cooling
    *unpruned, first, second, third = of_values([20.0] * 6 + [19.9] * 2, [0.50] * 6 + [0.49] * 2)
    state.pace = state.pace._replace(while_cooling=tuple(unpruned))
    values = iter((first, second, third))
    monkeypatch.setattr(prune, "evaluate_measured", lambda *_, **__: next(values))
    settings = PRUNING | {"min_slope": 1e9, "max_psnr_cost": limits[0], "max_ssim_cost": limits[1]}
    n_trained = len(trained_ids(len(here.scene.train_views), here.cooling, state.pace))
    assert n_trained < len(here.scene.train_views)
    prune_in_slices(state, here._replace(step=111), **settings)
    state.view_order = [1, 2]
    prune_in_slices(state, here._replace(step=131), **settings)
    assert state.pace.is_pruning == (not ends) and ends in state.pace.decisions[-1].why
    assert len(trained_ids(len(here.scene.train_views), here.cooling, state.pace)) == (
        len(here.scene.train_views) if ends else n_trained
    )
    assert (state.view_order == []) == bool(ends)
    assert not ends or "the held-out views might lose" in state.pace.decisions[-1].why
    n = len(state.gaussians.means)
    prune_in_slices(state, here._replace(step=151), **settings)
    assert (len(state.gaussians.means) == n) == bool(ends)


def test_of_few_views_the_prune_is_measured_on_two_that_are_trained_on(cooling, monkeypatch):
    """The reason says so, as they are not held out."""
    state, here = cooling
    values = of_values([20.0] * 6 + [19.9], [0.5] * 7)
    state.pace = state.pace._replace(while_cooling=tuple(values[:6]))
    monkeypatch.setattr(prune, "evaluate_measured", lambda *_, **__: values[6])
    limits = PRUNING | {"max_psnr_cost": 0.1}
    prune_in_slices(state, here._replace(step=131, cooling=ADAPTIVE.cooling), **limits)
    assert "the measured training views might lose 0.20 ± 0.00 dB" in state.pace.decisions[-1].why


def test_the_prune_ends_where_no_slice_is_due_anymore(cooling):
    """After 0.64 of 260 iterations, which is 166.4, whether the last slice was one or not."""
    state, here = cooling
    prune_in_slices(state, here._replace(step=177), **PRUNING)
    assert state.pace.is_pruning
    prune_in_slices(state, here._replace(step=178), **PRUNING)
    assert not state.pace.is_pruning


def test_a_renderer_that_does_not_say_is_not_pruned_by_it(cooling):
    state, here = cooling

    def render(model, view, request):
        return SPLATTING.render(model, view, request._replace(wants=request.wants & {"stats"}))

    said = []
    settings = here.render_settings._replace(renderer=SPLATTING._replace(name="silent", render=render))
    silent = here._replace(render_settings=settings, say=said.append)
    prune_in_slices(state, silent._replace(step=111), **PRUNING)
    prune_in_slices(state, silent._replace(step=131), **PRUNING)
    assert len(said) == 1 and "renderer silent does not say" in said[0]
    assert len(state.pace.decisions) == 1


def test_it_grows_until_it_cools(reports):
    seen, state = reports
    counts = dict((step, n) for step, _, _, n in seen)
    assert 200 < counts[1] == counts[199] < counts[200] < counts[state.pace.cooling_from]
    after = [n for step, _, _, n in seen if step > state.pace.cooling_from]
    assert sorted(after, reverse=True) == after  # pruned at most


# It continues ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("at", [250, 350])
def test_continued_byte_for_byte(scene, reports, tmp_path, at):
    """From before and from within the cool-down."""
    straight = reports[1]
    state = initial_state(scene, FAST, 0)

    class Stop(Exception):
        pass

    def stop(report):
        if report.step == at:
            raise Stop

    with pytest.raises(Stop):
        train(scene, FAST, seed=0, state=state, on_step=stop)
    save_state(tmp_path / "state.npz", state, FAST)
    state = load_state(tmp_path / "state.npz", FAST)
    train(scene, FAST, seed=0, state=state)
    assert state.pace == straight.pace
    for field, other in zip(state.gaussians, straight.gaussians, strict=True):
        assert_array_equal(field, other)


def test_the_pace_comes_back_from_json(reports):
    pace = reports[1].pace
    assert pace_from_json(json.loads(json.dumps(pace_to_json(pace)))) == pace and pace.measurements


@pytest.mark.parametrize("pace", [None, {}, {"measurements": [{}]}, 3, {"measurements": [], "decisions": 5}])
def test_a_damaged_pace_is_refused(reports, tmp_path, pace):
    save_state(tmp_path / "state.npz", reports[1], FAST)
    arrays, metadata = load_checkpoint(tmp_path / "state.npz")
    save_checkpoint(tmp_path / "state.npz", arrays, {**metadata, "pace": pace})
    with pytest.raises(DamagedCheckpoint, match="no record of measurements"):
        load_state(tmp_path / "state.npz", FAST)


# From the command line ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes") / "nook"
    write_scene(make_scene("room", supersampling=1, **OPTIONS), folder, OPTIONS)
    return folder


SETTINGS = ["--set", "min_gain=1e9", "--set", "min_step=300", "--set", "hold_out_from=0"]


def test_train_ends_by_itself_and_says_why(scene_folder, tmp_path, capsys):
    run = tmp_path / "run"
    assert (
        main(["train", str(scene_folder), "--recipe", "adaptive", "--test-every", "6", *SETTINGS, "--out", str(run)])
        == 0
    )
    metrics, decisions = (json.loads((run / f"{name}.json").read_text()) for name in ("metrics", "decisions"))
    cooled = decisions["cooling_from"]
    assert cooled in (700, 800)  # with four measurements in the second half of the work: which, the last bits decide
    assert decisions["last_step"] == {700: 1120, 800: 1280}[cooled]  # and the cool-down is 0.6 of what was before
    assert metrics["has_ended_early"] and metrics["iterations"] == decisions["last_step"]
    assert len(decisions["measurements"])
    first, *others = [decision["what"] for decision in decisions["decisions"]]
    assert first == "cool down" and set(others) == {"prune", "prune ended", "bands"} and others.count("bands") == 1
    assert json.loads((run / "config.json").read_text())["settings"]["iterations"] == 30_000
    capsys.readouterr()
    assert main(["info", str(run)]) == 0
    assert "complete" in capsys.readouterr().out
    assert main(["train", "--resume", str(run)]) == 2
    assert "of which the last had falling rates" in capsys.readouterr().err


def test_minutes_are_a_limit(scene_folder, tmp_path, capsys):
    run = tmp_path / "run"
    options = ["--recipe", "adaptive", "--test-every", "6", "--set", "min_step=100000"]
    assert main(["train", str(scene_folder), *options, "--minutes", "0.1", "--out", str(run)]) == 0
    decisions = json.loads((run / "decisions.json").read_text())
    assert decisions["decisions"][0]["why"] == "--minutes 0.1 leaves no more time"
    assert (
        decisions["cooling_from"]
        < decisions["last_step"]
        == json.loads((run / "metrics.json").read_text())["iterations"]
    )
    out = ["--out", str(tmp_path / "other")]
    capsys.readouterr()
    assert main(["train", str(scene_folder), *options, "--minutes", "0.01", *out]) == 2
    assert main(["train", str(scene_folder), "--recipe", "3dgs", "--minutes", "1", *out]) == 2
    short, meaningless = capsys.readouterr().err.splitlines()
    assert "at least 0.1" in short and "means nothing to recipe 3dgs" in meaningless
    assert not (tmp_path / "other").exists()


def test_too_few_views_are_refused(tmp_path, capsys):
    few = {**OPTIONS, "n_views": 2}
    write_scene(make_scene("room", supersampling=1, **few), tmp_path / "few", few)
    assert main(["train", str(tmp_path / "few"), "--recipe", "adaptive", "--out", str(tmp_path / "run")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "2 training views" in line and "adaptive" in line


def test_three_views_are_enough(tmp_path):
    """All are trained on, and two of them measured."""
    few = {**OPTIONS, "n_views": 3}
    write_scene(make_scene("room", supersampling=1, **few), tmp_path / "few", few)
    run, options = tmp_path / "run", ["--recipe", "adaptive", "--test-every", "0", "--iterations", "400"]
    assert main(["train", str(tmp_path / "few"), *options, "--out", str(run)]) == 0
    decisions = json.loads((run / "decisions.json").read_text())
    assert [(measured["step"], len(measured["psnrs"])) for measured in decisions["measurements"]] == [(200, 2)]


def test_its_length_is_a_limit():
    recipe = get_recipe("adaptive", 500)
    assert recipe.iterations == 500 and recipe._replace(iterations=30_000) == ADAPTIVE
    with pytest.raises(InputError, match="at least 1"):
        get_recipe("adaptive", 0)
