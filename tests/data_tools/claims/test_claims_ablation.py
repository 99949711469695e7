"""The claim ``ablation``: what each variant lacks, and a measurement that was interrupted."""

import json
from functools import partial

import numpy as np
import pytest

from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.ablation import ablation
from data_tools.claims.ablation.variants import (
    DEVIATIONS,
    FULL,
    MECHANISMS,
    reinitialise_from_culled,
    variants_of,
    with_lost_steps,
    with_settings,
)
from data_tools.claims.kit import conditions
from data_tools.claims.kit.claim import RESULT
from data_tools.claims.kit.records import RUNS
from measured_claims import read_result
from minisplat_ref.datasets import named_scenes
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.errors import InputError
from minisplat_ref.methods import RECIPES, gaussian_splatting, mini_splatting
from minisplat_ref.methods.mini_splatting import reinitialise_from_depth
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.strategy.blur_split import principal_axis_children
from minisplat_ref.strategy.clone_split import random_children
from minisplat_ref.training.loop import train
from minisplat_ref.training.recipe_settings import configure, settings_of
from minisplat_ref.training.schedule import At, action_name, does, firing_steps
from minisplat_ref.training.state import Iteration
from minisplat_ref.types import number_views


def tiny_room():
    return make_scene("room", n_views=8, width=48, height=36, supersampling=1, n_points=150)


@pytest.fixture
def room():
    scene = tiny_room().scene
    return scene._replace(train_views=number_views(scene.train_views))


def names_of(recipe):
    return [action_name(event) for event in recipe.events]


def test_each_variant_lacks_one_thing():
    recipe = RECIPES["mini-splatting2"]
    variants = variants_of(recipe, 18_000)
    assert variants[FULL] == recipe._replace(short_run_exponent=0.0)
    assert set(variants) == set(MECHANISMS) - {"restart"} | {FULL}
    assert "collect_blur" in names_of(recipe) and "collect_blur" not in names_of(variants["blur split"])
    assert "reinitialise_from_depth" not in names_of(variants["reinitialisation"])
    assert settings_of(variants["culling"])["visibility_mass"] == 1.0 and settings_of(variants["clone"])["factor"] == 1
    assert not settings_of(variants["intersection preservation"])["is_intersecting"]
    assert "halve_large_views" in names_of(recipe)
    assert "halve_large_views" not in names_of(variants["half-size warm-up"])
    for name, variant in variants.items():
        changed = [f for f in recipe._fields if getattr(variants[FULL], f) != getattr(variant, f)]
        assert changed == ([] if name == FULL else ["events"])
    assert {"restart", "sampling"} < set(variants_of(RECIPES["mini-splatting"], 30_000))
    assert "clone" not in variants_of(RECIPES["mini-splatting"], 30_000)


@pytest.mark.parametrize("name", ["mini-splatting-d", "mini-splatting2"])
def test_the_four_forms_of_blur_split(name):
    """They differ in blur split and children alone."""
    recipe = RECIPES[name]
    variants = variants_of(recipe, recipe.iterations)
    forms = {
        FULL: (True, random_children),
        "random children": (True, principal_axis_children),
        "blur split": (False, random_children),
        "blur split and random children": (False, principal_axis_children),
    }
    for form, (has_blur_split, children) in forms.items():
        events = variants[form].events
        assert any(does(event, mini_splatting.collect_blur) for event in events) == has_blur_split
        assert len(recipe.events) - len(events) == (not has_blur_split)
        (split,) = [event for event in events if does(event, gaussian_splatting.clone_and_split)]
        assert split.action.keywords["draw_children"] is children


def test_deviations_are_taken_back():
    variants = variants_of(RECIPES["mini-splatting2"], 3_000, DEVIATIONS)
    assert set(variants) == set(DEVIATIONS) - {"size limit by distance", "no bias correction"} | {FULL}
    assert settings_of(variants["cap of the population"])["max_per_pixel"] == np.inf
    rates = [variants[name].learning_rates.of["sh_dc"] for name in ("raised rates", FULL)]
    assert rates[0] == RECIPES["3dgs"].learning_rates.of["sh_dc"] < rates[1]
    published = variants_of(RECIPES["mini-splatting"], 30_000, DEVIATIONS)
    assert "raised rates" not in published and "prune_large" in names_of(published["size limit by distance"])
    assert published.keys().isdisjoint({"depths of whole views"})  # Mini-Splatting culls no view
    of_3dgs = variants_of(RECIPES["3dgs-accel"], 30_000, DEVIATIONS)
    assert set(of_3dgs) == {FULL, "no step lost", "no bias correction"}


def test_fewer_events_are_a_deviation_of_short_runs():
    assert "fewer events" not in variants_of(RECIPES["mini-splatting2"], 18_000, DEVIATIONS)
    variants = variants_of(RECIPES["mini-splatting2"], 1_800, DEVIATIONS)
    steps = {name: firing_steps(variants[name], gaussian_splatting.clone_and_split) for name in (FULL, "fewer events")}
    assert steps["fewer events"] == [step // 10 for step in range(600, 3_000, 100) if step != 2_000]
    assert set(steps[FULL]) < set(steps["fewer events"]) and len(steps[FULL]) == 1
    assert settings_of(variants["size limit of new points"])["largest_size"] == np.inf


def test_steps_that_the_released_code_loses(room):
    """Of six steps the one with an event that may change the population, and the last, change nothing."""
    events = (At(3, partial(gaussian_splatting.prune_faint, min_opacity=1e-9)),)
    recipe = with_lost_steps(RECIPES["3dgs-accel"]._replace(iterations=6, events=events))
    ends = {}
    state = train(
        room, recipe, seed=0, on_step=lambda report: ends.update({report.step: report.state.gaussians.means.copy()})
    )
    assert [step for step in range(2, 7) if not np.array_equal(ends[step], ends[step - 1])] == [2, 4, 5]
    assert state.adam.step == 4


def test_depths_are_drawn_of_what_the_culling_table_says(room):
    def begun_anew(act, is_visible):
        state = train(room, RECIPES["3dgs-accel"]._replace(iterations=12, events=()), seed=0)
        state.stats["is_visible"] = np.full((len(state.gaussians.means), len(room.train_views)), is_visible)
        iteration = Iteration(room, room.train_views[0], None, np.arange(0), None, RenderSettings(room.background))
        event = next(e for e in RECIPES["mini-splatting2"].events if action_name(e) == "reinitialise_from_depth")
        partial(act, **{**event.action.keywords, "drawn_mass": None})(state, iteration)
        return state.gaussians.means

    assert np.array_equal(begun_anew(reinitialise_from_culled, True), begun_anew(reinitialise_from_depth, False))
    with pytest.raises(InputError, match="no pixel of any view shows a surface"):
        begun_anew(reinitialise_from_culled, False)


def test_what_never_acts_has_no_row():
    """In 3 iterations nothing of the first sixth of Mini-Splatting2 has room."""
    few = variants_of(RECIPES["mini-splatting2"], 3)
    assert {"clone", "culling", "blur split", "half-size warm-up"}.isdisjoint(few)
    assert few.keys() < variants_of(RECIPES["mini-splatting2"], 18_000).keys()


@pytest.fixture
def small(monkeypatch):
    scene = tiny_room()
    monkeypatch.setattr(named_scenes, "make_scene", lambda name: scene)


def test_measured_and_its_continuation(tmp_path, capsys, small, monkeypatch):
    kept = {name: MECHANISMS[name] for name in ("restart", "sampling")}
    monkeypatch.setattr(ablation, "MECHANISMS", kept)
    out = tmp_path / "out"
    command = ["ablation", "room", "--out", str(out), "--iterations", "60", "--recipe", "mini-splatting"]
    assert measure_claim([*command, "--seeds", "0,1"]) == 0
    result = read_result(out, RUNS)
    assert len(result["runs"]) == 6 and result["acts"]["sampling"] == 1 and result["acts"]["restart"] == 1
    assert result["summary"][FULL]["difference"] == [0, 0]
    by_run = {(run["without"], run["seed"]): run for run in result["runs"]}
    differences = [by_run["sampling", seed]["psnr"] - by_run[FULL, seed]["psnr"] for seed in (0, 1)]
    assert result["summary"]["sampling"]["difference"][0] == pytest.approx(sum(differences) / 2)

    lines = (out / RUNS).read_text().splitlines()
    (out / RUNS).write_text("\n".join(lines[:-2]) + "\n")  # as if it had been interrupted
    trained = []
    measure = ablation.measure
    monkeypatch.setattr(ablation, "measure", lambda *a: trained.append(a[2]) or measure(*a))
    capsys.readouterr()
    assert measure_claim([*command, "--seeds", "0,1"]) == 0
    assert trained == [1, 1] and "- sampling" in capsys.readouterr().out
    again = json.loads((out / RESULT).read_text())["runs"]
    assert [{**run, "seconds": 0} for run in again] == [{**run, "seconds": 0} for run in result["runs"]]

    assert measure_claim([*command, "--seeds", "0", "--downscale", "1", "--iterations", "61"]) == 2
    assert "holds trainings of" in capsys.readouterr().err


def test_what_has_not_fired_has_no_row(tmp_path, capsys, small, monkeypatch):
    """Photographs of 48 x 36 pixels are never halved, though the recipe has a date until which they should be."""
    names = ("half-size warm-up", "last prune")
    monkeypatch.setattr(ablation, "MECHANISMS", {name: MECHANISMS[name] for name in names})
    monkeypatch.setattr(conditions, "FEW", 2)
    out = tmp_path / "out"
    command = ["ablation", "room", "--out", str(out), "--recipe", "mini-splatting2", "--condition", "few"]
    assert measure_claim([*command, "--iterations", "12", "--seeds", "0"]) == 0
    printed = capsys.readouterr().out
    assert "room, 4 training views" in printed and "12 iterations, condition few" in printed
    assert f"never acted, so that nothing can be said of it: {names[0]}" in printed and f"- {names[0]}" not in printed
    result = json.loads((out / RESULT).read_text())
    assert set(result["summary"]) == {FULL, names[1]} and result["acts"] == {names[0]: 0, names[1]: 1}


def test_a_claim_of_what_has_not_fired_is_refused(tmp_path, capsys, small, monkeypatch):
    monkeypatch.setattr(ablation, "MECHANISMS", {"half-size warm-up": MECHANISMS["half-size warm-up"]})
    out = tmp_path / "out"
    command = ["ablation", "room", "--out", str(out), "--recipe", "mini-splatting2"]
    assert measure_claim([*command, "--iterations", "12", "--seeds", "0"]) == 2
    said = capsys.readouterr()
    assert said.out == "" and "nothing that can be taken out ever acted (half-size warm-up): give more iter" in said.err
    assert not (out / RESULT).exists()


def test_what_has_fired_without_effect_has_no_row(tmp_path, capsys, small, monkeypatch):
    """No Gaussian of these photographs has the area from which on blur is split: the four rows were equal."""
    forms = ("blur split", "random children", "blur split and random children")
    command = ["ablation", "room", "--recipe", "mini-splatting", "--iterations", "400", "--seeds", "0"]
    monkeypatch.setattr(ablation, "MECHANISMS", {name: MECHANISMS[name] for name in forms})
    assert measure_claim([*command, "--out", str(tmp_path / "three")]) == 0
    printed = capsys.readouterr().out
    assert (
        f"{forms[0]!r} measured exactly what {FULL!r} did, {forms[2]!r} measured exactly what {forms[1]!r}" in printed
    )
    assert f"- {forms[1]} " in printed and "| - blur split" not in printed
    monkeypatch.setattr(ablation, "MECHANISMS", {forms[0]: MECHANISMS[forms[0]]})
    assert measure_claim([*command, "--out", str(tmp_path / "one")]) == 2
    said = capsys.readouterr()
    assert said.out == "" and f"{forms[0]!r} measured exactly what {FULL!r} did: what distinguishes" in said.err


def test_bad_input_is_one_line(tmp_path, capsys, small):
    out = tmp_path / "out"
    assert measure_claim(["ablation", "room", "--out", str(out), "--recipe", "3dgs", "--iterations", "60"]) == 2
    assert "recipe 3dgs has nothing to take out: choose from mini-splatting, " in capsys.readouterr().err
    condition = ["--condition", "night"]
    assert measure_claim(["ablation", "room", "--out", str(out), "--iterations", "60", *condition]) == 2
    assert "condition 'night' does not exist: choose from whole, few, " in capsys.readouterr().err
    assert not out.exists()
    out.mkdir()
    assert measure_claim(["ablation", "room", "--out", str(out), "--iterations", "60"]) == 2
    assert "is not of this claim" in capsys.readouterr().err


def test_settings_that_a_recipe_lacks_change_nothing():
    assert with_settings(factor=1)(RECIPES["3dgs"]) is RECIPES["3dgs"]
    assert configure(RECIPES["mini-splatting2"], factor=1) != RECIPES["mini-splatting2"]
