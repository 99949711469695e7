"""What an error looks like: marks and distances by hand, and reports that name the fault that was planted."""

import json

import numpy as np
import pytest

from data_tools import signatures as measuring
from minisplat_ref.app.cli import main
from minisplat_ref.gsplat import call as gsplat_compat
from minisplat_ref.oracle.comparison import signatures
from minisplat_ref.oracle.comparison.measures import Difference
from minisplat_ref.oracle.comparison.signatures import Mark, Trace, distance, likeliest, mark, signature
from minisplat_ref.oracle.comparison.staged import Row, slight
from minisplat_ref.oracle.faults import FAULTS
from minisplat_ref.oracle.faults.backward import scale_gradient
from minisplat_ref.oracle.faults.forward import with_conics
from minisplat_ref.oracle.gradients import inner_product_case
from minisplat_ref.oracle.pieces import tiny_setting
from minisplat_ref.oracle.stages import project_stage, sh_stage
from minisplat_ref.testing import assert_matches_oracle

BY_NAME = {fault.what: fault for fault in FAULTS}
SCENES = ("a", "b")


# --- by hand ---


def test_a_factor_lies_along_the_truth():
    truth = np.array([[3.0, 4.0], [0.0, 12.0]])  # of norm 13
    found = mark(1.5 * truth, truth, is_wrong=True)
    assert found.size == pytest.approx(0.5) and found.along == pytest.approx(1)
    assert found.columns == pytest.approx((9 / 169, 160 / 169))
    halved = mark(0.5 * truth, truth, is_wrong=True)
    assert halved.along == pytest.approx(-1) and halved.size == pytest.approx(0.5)


def test_an_error_across_the_truth():
    found = mark(np.array([3.0, 4.0]), np.array([3.0, 0.0]), is_wrong=True)
    assert found == Mark(True, pytest.approx(4 / 3), 0.0, ())


def test_what_rounding_decides_is_set_aside():
    truth, aside = np.ones((2, 2, 3)), np.array([[True, False], [False, False]])
    given = truth.copy()
    given[0, 0] = 9
    given[1, 1] = 3
    assert mark(given, truth, is_wrong=True, set_aside=aside).size == pytest.approx(np.sqrt(3 * 4 / 12))


def test_right_and_not_a_number():
    assert mark(np.ones(3), np.zeros(3), is_wrong=False) == Mark(False)
    assert mark(np.full(3, np.nan), np.ones(3), is_wrong=True) == Mark(True, 1.0)
    assert mark(np.ones(4), np.zeros(4), is_wrong=True) == Mark(True, 2.0)  # nothing to compare with


def test_a_signature_is_the_mean_over_the_scenes_in_which_an_array_is_wrong():
    marks = {
        "a": {"x": Mark(True, 1.0, 1.0, (1.0, 0.0)), "y": Mark(True, 0.01, 0.5), "z": Mark(False)},
        "b": {"x": Mark(True, 1.0, 0.5, (0.5, 0.5)), "y": Mark(False), "z": Mark(False)},
    }
    found = signature(marks)
    assert found["x"] == Trace(frozenset("ab"), 0.0, 0.75, (0.75, 0.25))
    assert found["y"] == Trace(frozenset("a"), -2.0, 0.5, ())
    assert found["z"] == Trace(frozenset())


def test_distances_by_hand():
    found = {"x": Trace(frozenset("a"), 0.0, 1.0, (1.0, 0.0)), "y": Trace(frozenset())}
    assert distance(found, found, SCENES) == 0
    assert distance(found, {}, SCENES) == pytest.approx(0.5 * (1 / 2 + 1))  # wrong in one of two, and in all of one
    assert distance(found, {"x": Trace(frozenset("b"), 0.0, 1.0, (1.0, 0.0))}, SCENES) == pytest.approx(1)
    other = {"x": Trace(frozenset("a"), -1.0, 0.5, (0.5, 0.5))}
    assert distance(found, other, SCENES) == pytest.approx(0.5 * 0.5 + 0.5 * 0.5 + 0.5)
    assert distance(found, {"x": found["x"]._replace(along=-1.0)}, SCENES) == 0  # the same error, of the other sign
    assert distance(found, {**found, "not given": Trace(frozenset("ab"))}, SCENES) == 0


# --- the faults, and the table ---


def test_every_fault_has_its_words_and_leaves_traces():
    assert len(BY_NAME) == len(FAULTS) > 60
    for mode in ("fed", "unfed"):
        table = signatures.known_signatures(mode)
        assert set(table.faults) == {(fault.what, fault.where) for fault in FAULTS}
        assert all(any(trace.check_step for trace in known.values()) for known in table.faults.values())


SMOOTH = [
    fault
    for fault in FAULTS
    if fault.where in ("projection", "colours") and fault.what != "Gaussians cut at three deviations"
]  # the check of blending watches the thresholds of the right rules


@pytest.mark.parametrize("fault", SMOOTH, ids=lambda fault: fault.what)
def test_a_forward_fault_has_its_own_derivative(fault):
    setting = tiny_setting(sh_degree=2)
    make_stage = sh_stage if fault.where == "colours" else project_stage
    if make_stage is project_stage:
        setting = setting._replace(conventions=setting.conventions._replace(is_antialiased=True))
    case = inner_product_case(make_stage(fault.plant(fault.size), setting), np.random.default_rng(0))
    problems = [problem for problem in case.note.split("; ") if problem and not problem.endswith("is zero")]
    assert not problems  # a rotation or a pose that is left out has no gradient


def test_the_table_is_that_of_the_command(monkeypatch):
    """Three faults of either kind, on all scenes."""
    some = tuple(BY_NAME[name] for name in ("fx and fy exchanged", "a wrong order of the depths"))
    some += (next(f for f in FAULTS if "off-diagonal halved" in f.what),)
    monkeypatch.setattr(measuring, "FAULTS", some)
    stored = json.loads(signatures.FILE.read_text())
    for mode, rows in measuring.measure().items():
        if mode == "scenes":
            assert rows == stored[mode]
            continue
        for row in rows:
            (known,) = [other for other in stored[mode] if other["what"] == row["what"]]
            assert row["arrays"].keys() == known["arrays"].keys()
            for name, (wrong, *numbers, columns) in row["arrays"].items():
                assert wrong == known["arrays"][name][0]
                assert np.allclose(numbers, known["arrays"][name][1:3], atol=0.011)
                assert np.allclose(columns, known["arrays"][name][3], atol=0.011)


CASES = {
    "scales that are off by a factor": 1.05,
    "quaternions read as xyzw": 1.0,
    "the conic's off-diagonal off by a factor in the projection": 0.7,
    "another clamp of alpha": 0.97,
    "the background missing": 0.3,
    "the gradient of the scales off by a factor": 1.2,
    "the quaternion's length left out of its gradient": 1.0,
    "the gradient of the view's rotation transposed": 1.0,
    "the gradient of the base colour off by a factor": -0.4,
}


@pytest.fixture(scope="module")
def other_scenes():
    """Three scenes of another seed, as a function of the way of calling."""
    names = ("ordinary", "odd-size", "sh3")
    return {way: {n: measuring.scenes_of(5, measuring.WAYS[way])[n] for n in names} for way in WAYS}


WAYS = ("every stage", "a function without a meta")


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("way", WAYS)
def test_other_scenes_and_sizes_are_told(name, way, other_scenes):
    """With few scenes and arrays; ``data_tools.signatures --judge`` has the whole."""
    called, scenes = measuring.WAYS[way], other_scenes[way]
    found = measuring.signature_of(measuring.faulty(BY_NAME[name], CASES[name], called), scenes.values())
    likely = likeliest(found, list(scenes), is_fed=called.is_fed)
    assert name in [one.what for one in likely] and len(likely) == 3
    assert [one.distance for one in likely] == sorted(one.distance for one in likely)


def test_judging_counts(monkeypatch):
    background = BY_NAME["the background missing"]
    monkeypatch.setattr(measuring, "FAULTS", (background,))
    monkeypatch.setattr(measuring, "RECIPES", measuring.RECIPES[:1])
    assert measuring.sizes_of(background) == pytest.approx([0.425, 0.935])
    assert measuring.sizes_of(BY_NAME["fx and fy exchanged"]) == [1.0]
    (row,) = measuring.judge(3, "float64", ["every stage"])
    assert row == ["every stage", "float64", "2 of 2 (100%)", "2 of 2 (100%)", "0"]
    gradient = next(fault for fault in FAULTS if fault.where.startswith("gradient"))
    monkeypatch.setattr(measuring, "FAULTS", (background, gradient))
    (row,) = measuring.judge(3, "float64", ["its image alone"])
    assert row[-1] == "3" and " of 2 (" in row[2]  # an image does not show a gradient


# --- reports ---


def test_the_command_names_the_planted_fault(capsys, tmp_path):
    file = tmp_path / "c.json"
    assert main(["oracle", "compare", "planted:half-off-diagonal", "--scene", "sh3", "--json", str(file)]) == 1
    output = capsys.readouterr().out
    assert "v_conics, v_conics_features, " in output and " right: as with\n" in output
    assert "  1. the gradient of the conic's off-diagonal halved, or off by another factor\n" in output
    assert output.count("\n  2. ") == output.count("\n  3. ") == 1
    lines = json.loads(file.read_text())["settings"]["looks_like"]
    assert len(lines) == 4 and lines[1] in output
    assert main(["oracle", "compare", "reference", "--scene", "sh3"]) == 0
    assert "as with" not in capsys.readouterr().out


def ours(backend, has_meta=False):
    def function(means, quats, scales, opacities, colors, viewmats, Ks, width, height, sh_degree, backgrounds, **rest):
        given = (means, quats, scales, opacities, colors, viewmats, Ks, width, height)
        named = {"sh_degree": sh_degree, "backgrounds": backgrounds, **rest}
        result = gsplat_compat.rasterization(*given, backend=backend, **named)
        return result if has_meta else result[:2]

    return function, lambda **given: gsplat_compat.rasterization_vjp(backend=backend, **given)


def message_of(function, vjp):
    with pytest.raises(AssertionError) as error:
        assert_matches_oracle(function, vjp, dtype="float64", scenes=("ordinary", "odd-size"))
    return str(error.value)


def test_without_a_meta_a_wrong_conic_is_not_blamed_on_the_blending_alone():
    text = message_of(*ours(with_conics((1, 0.6, 1))))
    assert "the first stage that diverges is T, in scene" in text
    assert "; or the error is in means2d, depths, conics, " in text.partition("\n")[0]
    assert "  1. the conic's off-diagonal off by a factor in the projection\n" in text
    asked = next(line for line in text.splitlines() if line.startswith("to tell these apart, return "))
    assert "conics" in asked and asked.endswith("as well (a function: in its meta)")
    assert "depths" not in asked  # with none of the three they are wrong


def test_with_it_the_conic_is_named():
    text = message_of(*ours(with_conics((1, 0.6, 1)), has_meta=True))
    assert "the first stage that diverges is conics" in text and "or the error is in" not in text
    assert "conics, " in text and "and means2d, depths, opacities2d, radii, " in text
    assert "  1. the conic's off-diagonal off by a factor in the projection\n" in text


def test_a_pattern_of_gradients_alone():
    """v_means, v_quats and v_scales wrong, v_opacities right: as with a halved off-diagonal of the conic."""
    halved = scale_gradient("composite_vjp", "conics", columns=(0, 1, 0))(0.5)
    text = message_of(*ours(halved))
    assert "v_means, v_quats, v_scales, " in text
    assert "v_opacities, " in text.partition(" right: as with")[0].rpartition(" wrong and ")[2]
    assert "  1. the gradient of the conic's off-diagonal halved" in text


def test_what_no_fault_makes_wrong_looks_like_none():
    found = {"loss": Trace(frozenset(["sh3"]), 0.0, 1.0), "adam_values_after": Trace(frozenset(["sh3"]))}
    assert likeliest(found, ["sh3"], is_fed=True) == []
    assert likeliest({"image": Trace(frozenset(["mine"]))}, ["mine"], is_fed=True) == []


def test_a_few_values_little_above_the_limit_are_called_a_loss_of_precision():
    """gsplat begins its gradient with T = 1 - alpha in float32, which is off by up to 3e-4 where T is 1e-4."""

    def rows(excess, n_over):
        off = Difference(excess * 2e-4, 1e-5, 2.0, 1e-4, n_over, 1000)
        return [Row("sh3", "v_colors", "diverges", off, arrays=("v_colors",)), Row("sh3", "image", "agrees", None)]

    assert slight(rows(4.9, 10)) == [
        "10 of 1,000 values are off, by up to 4.9 times what is allowed: a loss of precision rather than a wrong"
        " formula, which is wrong in most values"
    ]
    assert slight(rows(5.1, 10)) == slight(rows(4.9, 11)) == slight(rows(4.9, 10)[1:]) == []
    assert slight([*rows(4.9, 10), Row("sh3", "radii", "diverges", None)]) == []
