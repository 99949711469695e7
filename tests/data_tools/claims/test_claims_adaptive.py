"""The claim ``adaptive``: its conditions, its rules, its table, and a measurement that was interrupted."""

import numpy as np
import pytest

from data_tools.claims import adaptive
from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.kit.conditions import get_condition
from data_tools.claims.kit.records import RUNS
from measured_claims import read_result
from minisplat_ref.datasets import named_scenes
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.errors import InputError
from minisplat_ref.methods.adaptive.recipe import ADAPTIVE
from minisplat_ref.training.recipe_settings import settings_of
from minisplat_ref.training.schedule import action_name
from scenes import make_gaussians


@pytest.fixture(scope="module")
def scene():
    return make_scene("room", n_views=8, width=48, height=36, supersampling=1, n_points=150).scene


def test_conditions(scene):
    few, gains, both = (get_condition(name)(scene) for name in ("few", "gains", "few-gains"))
    assert [view.name for view in few.train_views] == [view.name for view in scene.train_views[::5]]
    assert few.test_views is scene.test_views and gains.test_views is scene.test_views
    ratios = [
        np.median(new.image[old.image > 50] / old.image[old.image > 50])
        for new, old in zip(gains.train_views, scene.train_views, strict=True)
    ]
    assert 0.69 < min(ratios) < 0.9 < 1.1 < max(ratios) < 1.41
    assert [view.name for view in both.train_views] == [view.name for view in few.train_views]
    assert all((new.image != old.image).any() for new, old in zip(both.train_views, few.train_views, strict=True))


def test_each_rule_is_taken_out():
    recipes = {name: change(ADAPTIVE) for name, change in adaptive.RULES.items()}
    names = {name: [action_name(event) for event in recipe.events] for name, recipe in recipes.items()}
    assert recipes["adaptive"] == ADAPTIVE and "grow" in names["adaptive"]
    assert "grow" not in names["no growth"] and len(names["no growth"]) == len(names["adaptive"]) - 1
    assert [n.replace("clones_while_growing", "grow") for n in names["clones of 3DGS"]] == names["adaptive"]
    assert recipes["rates of 3DGS"].learning_rates.at(9, 1.0)["means"] == 1.6e-4
    assert recipes["faster means"].learning_rates.at(9, 1.0)["means"] == pytest.approx(2.24**2 * 1.6e-4)
    assert recipes["no cool-down"].cooling.last_per_extent == 1.0
    assert recipes["all bands"].sh_milestones and len(names["all bands"]) == len(names["adaptive"]) - 2
    assert settings_of(recipes["no bands"])["views_per_coefficient"] == np.inf
    assert settings_of(recipes["no cut of bands"])["min_variation"] == 0.0
    assert settings_of(recipes["no prune"])["min_slope"] == 0.0
    assert settings_of(recipes["largest gradients first"])["error_views"] == 0
    assert settings_of(recipes["no sky"])["min_sky_gain"] == np.inf
    assert settings_of(recipes["no exposures"])["exposure"] == "none" != settings_of(ADAPTIVE)["exposure"]
    assert settings_of(recipes["no poses"])["min_pose_gain"] == np.inf
    for recipe in recipes.values():
        assert recipe.cooling.hold_out_every == ADAPTIVE.cooling.hold_out_every


def test_rows_by_hand():
    def run(recipe, seed, psnrs):
        curve = [
            {"step": 10 * k, "seconds": 2.0 * k, "psnr": p, "n_gaussians": 5, "n_numbers": 70}
            for k, p in enumerate(psnrs, 1)
        ]
        return {"condition": "whole", "recipe": recipe, "seed": seed, **curve[-1], "curve": curve}

    runs = [run("a", 0, [20, 25, 24]), run("a", 1, [21, 22]), run("b", 0, [23.9, 24.5, 24.4]), run("b", 1, [22, 22.6])]
    first, second = adaptive.summarise(runs)
    assert (first["psnr"], first["difference"], first["fall"], first["until"]) == (23.0, 0.0, 0.5, 4.0)
    assert second["difference"] == pytest.approx(0.5) and second["standard_error"] == pytest.approx(0.1)
    assert second["fall"] == pytest.approx(0.05) and second["until"] == 2.0
    never = adaptive.summarise([*runs[:1], run("b", 0, [20, 21])])[1]
    assert never["until"] is None and never["standard_error"] is None


def test_numbers_of_bands_that_are_there():
    """14 for degree 0; a Gaussian with a coefficient of degree 2 has all eight up to it, of three colours."""
    gaussians = make_gaussians(np.random.default_rng(0), 3)
    assert adaptive.n_numbers(gaussians) == 3 * 59
    gaussians.sh_rest[1:] = 0
    assert adaptive.n_numbers(gaussians) == 59 + 2 * 14
    gaussians.sh_rest[2, 3, 1] = 1e-9
    assert adaptive.n_numbers(gaussians) == 59 + 14 + 14 + 24
    assert adaptive.n_numbers(gaussians._replace(sh_rest=gaussians.sh_rest[:, :0])) == 3 * 14


def test_regret_by_hand():
    def run(recipe, seed, psnr, n):
        return {"condition": "whole", "recipe": recipe, "seed": seed, "psnr": psnr, "n_gaussians": n}

    runs = [
        run("few", 0, 24.0, 50),
        run("adaptive", 0, 24.8, 100),
        run("many", 0, 24.95, 300),
        run("most", 0, 25.0, 900),
    ]
    assert adaptive.regret(runs) == pytest.approx((0.2, 100 / 300))
    better = [run("adaptive", 1, 25.0, 400), run("few", 1, 24.95, 100)]
    assert adaptive.regret(better) == (0.0, 4.0)
    assert "costs 0.10 dB, and is 2.17 times" in adaptive.describe_regret([*runs, *better])


def test_the_sweep_goes_from_little_growth_to_much():
    settings = [settings_of(change(ADAPTIVE)) for change in adaptive.SWEEP.values()]
    growth = [(-each["threshold"], each["max_growth"]) for each in settings]
    assert len(growth) == 8 and growth == sorted(set(growth))
    assert adaptive.SWEEP["adaptive"](ADAPTIVE) == ADAPTIVE
    for each in settings:
        others = {"threshold": 4e-4, "max_growth": 0.2}
        assert {**each, **others} == settings_of(ADAPTIVE), "nothing else differs"


def test_a_rule_can_be_asked_for_by_its_name():
    named = adaptive._recipes_by_name(["3dgs", "large views at once", "adaptive"])
    assert list(named) == ["3dgs", "large views at once", "adaptive"] and named["adaptive"] == ADAPTIVE
    sides = [settings_of(named[name])["min_side"] for name in ("large views at once", "adaptive")]
    assert sides[0] == np.inf > sides[1]
    with pytest.raises(InputError, match="recipe 'small views' does not exist"):
        adaptive._recipes_by_name(["small views"])


def test_measured_and_its_continuation(tmp_path, capsys, scene, monkeypatch):
    monkeypatch.setattr(named_scenes, "make_scene", lambda name: make_scene("room", **SMALL))
    monkeypatch.setattr(adaptive, "ITERATIONS", 48)
    monkeypatch.setattr(adaptive, "ADAPTIVE", ADAPTIVE._replace(iterations=40))
    out = tmp_path / "out"
    command = ["adaptive", "room", "--out", str(out), "--recipes", "3dgs,adaptive", "--seeds", "0"]
    assert measure_claim([*command, "--conditions", "whole,gains"]) == 0
    printed = capsys.readouterr().out
    assert "| gains     | adaptive" in printed and "until 3dgs - 0.1 dB" in printed
    result = read_result(out, RUNS)
    assert [(row["condition"], row["recipe"], row["step"]) for row in result["summary"]] == [
        *(("whole", "3dgs", 48), ("whole", "adaptive", 40), ("gains", "3dgs", 48), ("gains", "adaptive", 40))
    ]
    assert result["runs"][1]["decisions"][0]["what"] == "cool down"
    monkeypatch.setattr(adaptive, "measure", lambda *_: pytest.fail("all is there"))
    assert measure_claim([*command, "--conditions", "whole"]) == 0
    assert measure_claim([*command, "--conditions", "night"]) == 2
    assert "condition 'night' does not exist" in capsys.readouterr().err


SMALL = {"n_views": 8, "width": 48, "height": 36, "supersampling": 1, "n_points": 150}
