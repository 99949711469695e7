"""Fair comparisons: what a relative adopts from its base, what is refused, and the table from the command line."""

import copy
import json
from functools import partial

import numpy as np
import pytest

from data_tools.claims import relatives
from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.kit.alike import DENSITY_CONTROL, HARMONICS, RATES, adopt, refuse_unlike, unlike_conditions
from data_tools.claims.kit.claim import FIGURE, RESULT
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.methods.gaussian_splatting import prune_faint, reset_opacity
from minisplat_ref.training.losses import LossTerm
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.schedule import During, without

BASE = find_recipe("3dgs-accel", 300)


def idle(state, iteration, *, amount):
    """Return what an event of a mechanism would note."""


def nothing(rendered, *, sharpness):
    raise AssertionError("not trained here")


RELATIVE = BASE._replace(
    name="relative",
    losses=(*BASE.losses, LossTerm("own", partial(nothing, sharpness=2.0), 0.5)),
    events=(During(partial(idle, amount=1)), *BASE.events),
    learning_rates=BASE.learning_rates.change(textures=0.01),
)


def test_a_mechanism_is_no_difference():
    """A loss, an event and a parameter that the base does not have; the order in which events stand may differ."""
    assert unlike_conditions(BASE, RELATIVE) == []
    assert adopt(BASE, RELATIVE) == RELATIVE
    refuse_unlike(BASE, RELATIVE)
    assert unlike_conditions(BASE, find_recipe("3dgs-accel", 300)) == []


@pytest.mark.parametrize(
    ("change", "condition"),
    [
        ({"iterations": 301}, "length"),
        ({"sh_milestones": (1, 2, 3)}, HARMONICS),
        ({"has_random_background": True}, "background"),
        ({"starts_densely": True}, "dense start"),
        ({"dropout": 0.2}, "dropout"),
        ({"exposure": "tracks"}, "exposures"),
        ({"learning_rates": RELATIVE.learning_rates.change(quats=0.5)}, RATES),
        ({"adam": BASE.adam._replace(is_visible_only=not BASE.adam.is_visible_only)}, "optimiser"),
    ],
)
def test_each_condition_is_found_and_adopted(change, condition):
    changed = RELATIVE._replace(**change)
    assert unlike_conditions(BASE, changed) == [condition]
    with pytest.raises(InputError, match=f"relative and 3dgs-accel differ in {condition}, besides the mechanism"):
        refuse_unlike(BASE, changed)
    refuse_unlike(BASE, changed, own={condition})
    adopted = adopt(BASE, changed)
    assert unlike_conditions(BASE, adopted) == []
    assert adopted.losses[-1] == RELATIVE.losses[-1] and adopted.events[0] == RELATIVE.events[0]
    assert adopted.learning_rates.of["textures"] == 0.01


def test_settings_of_density_control_loss_and_calibrations():
    for setting, condition in (
        ({"min_opacity": 0.3}, DENSITY_CONTROL),
        ({"dssim_weight": 0.5}, "photometric loss"),
        ({"sky": True}, "calibrations"),
    ):
        changed = configure(RELATIVE, **setting)
        assert unlike_conditions(BASE, changed) == [condition]
        assert unlike_conditions(BASE, adopt(BASE, changed)) == []
    later = RELATIVE._replace(
        events=tuple(
            event._replace(start=7) if getattr(event.action, "func", None) is prune_faint else event
            for event in RELATIVE.events
        )
    )
    assert unlike_conditions(BASE, later) == [DENSITY_CONTROL]
    assert adopt(BASE, later) == RELATIVE


def test_an_action_that_is_missing_is_not_adopted():
    """Nothing says when it would act beside the others; so the arms are refused."""
    lacking = without(RELATIVE, reset_opacity)
    assert unlike_conditions(BASE, adopt(BASE, lacking)) == [DENSITY_CONTROL]
    with pytest.raises(InputError, match="density control"):
        relatives.arms_of("3dgs-accel", BASE, {"relative": lacking})


def test_a_rate_of_zero_is_no_condition():
    """Of a parameter that follows from others; its own conditions stay, too."""
    still = RELATIVE._replace(learning_rates=RELATIVE.learning_rates.change(means=0.0, quats=0.5))
    assert unlike_conditions(BASE, still) == [RATES]
    assert adopt(BASE, still).learning_rates.of["means"] == 0.0
    assert adopt(BASE, still).learning_rates.of["quats"] == BASE.learning_rates.of["quats"]
    assert adopt(BASE, still, own={RATES}).learning_rates == still.learning_rates


def test_arms_of_the_relatives_of_surfels():
    """``mvg`` differs from surfels in the mechanism alone; Ref-Gaussian's release in three conditions besides."""
    base = find_recipe("surfels", 2000)
    arms = relatives.arms_of(
        "surfels", base, {text: find_recipe(text, 2000) for text in ("mvg", "reflective", "discretized-sdf")}
    )
    assert list(arms)[:3] == ["surfels", "mvg", "reflective"]
    assert arms["reflective, as released"].unlike == (HARMONICS, DENSITY_CONTROL, RATES)
    assert arms["discretized-sdf, as released"].unlike == ("background", RATES)
    alone = arms["reflective"].recipe
    assert alone.sh_milestones == base.sh_milestones and alone.learning_rates.of["sh_dc"] == 0.0025
    assert alone.learning_rates.of.keys() == find_recipe("reflective", 2000).learning_rates.of.keys()


def test_differences_by_hand():
    rows = [
        {"arm": arm, "seed": seed, "corrected": value}
        for arm, values in (("a", (20.0, 21.0)), ("b", (21.0, 20.5)))
        for seed, value in enumerate(values)
    ]
    text = relatives.describe_differences(rows, ["a", "b"])
    assert text == "b minus a: +0.25 dB after colour correction (by seed: +1.00, -0.50)"


@pytest.fixture
def room(tmp_path):
    size = {"n_views": 6, "width": 40, "height": 30, "n_points": 200}
    write_scene(make_scene("room", supersampling=1, **size), tmp_path / "room", size)
    return str(tmp_path / "room")


def test_from_the_command_line(room, tmp_path, capsys):
    command = ["relatives", room, "--base", "3dgs-accel", "--relatives", "textured", "--iterations", "10"]
    command += ["--seeds", "0,1", "--out", str(tmp_path / "out")]
    assert measure_claim([*command, "--settings", "sky=true"]) == 0
    printed = capsys.readouterr().out
    assert "textured minus 3dgs-accel: " in printed and "sky=true" in printed
    result = json.loads((tmp_path / "out" / RESULT).read_text())
    assert [(r["arm"], r["seed"]) for r in result["records"]] == [
        (arm, seed) for arm in ("3dgs-accel", "textured") for seed in (0, 1)
    ]
    assert all(r["unlike"] == "-" and r["psnr"] > 5 and r["floats"] > r["n_primitives"] for r in result["records"])
    assert (tmp_path / "out" / FIGURE).stat().st_size > 5000
    with pytest.MonkeyPatch.context() as patch:  # all records are there
        patch.setattr(relatives, "train", None)
        assert measure_claim([*command, "--settings", "sky=true"]) == 0
    assert measure_claim(command) == 2


def test_arms_that_continue(room, tmp_path, monkeypatch):
    """Both continue from one model, whose number stays, and the base is the relative with one texel."""
    starts = []

    def train(scene, recipe, *, seed, state=None):
        starts.append(None if state is None else copy.deepcopy(state.gaussians))
        return trained(scene, recipe, seed=seed, state=state)

    trained = relatives.train
    monkeypatch.setattr(relatives, "train", train)
    command = ["relatives", room, "--base", "texture-splat+texels=1", "--relatives", "texture-splat+texels=2"]
    command += ["--after", "reflective", "--iterations", "8", "--seeds", "0", "--out", str(tmp_path / "out")]
    assert measure_claim(command) == 0
    base, relative = json.loads((tmp_path / "out" / RESULT).read_text())["records"]
    assert (base["arm"], relative["arm"]) == ("texture-splat+texels=1", "texture-splat+texels=2")
    assert base["n_primitives"] == relative["n_primitives"] and base["floats"] < relative["floats"]
    assert np.isfinite([base["psnr"], relative["psnr"]]).all()
    assert starts[0] is None and len(starts) == 3  # the model is trained once, and no arm changes it
    for name in ("means", "opacity_logits", "sh_dc"):
        assert np.array_equal(getattr(starts[1], name), getattr(starts[2], name))
