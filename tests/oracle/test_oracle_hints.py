"""What a difference looks like: planted faults are named with size and place, and nothing that the data cannot show."""

import json
from pathlib import Path

import numpy as np
import pytest

from data_tools import hints as judging
from minisplat_ref.app.cli import main
from minisplat_ref.gsplat import call as gsplat_compat
from minisplat_ref.oracle.comparison.hints import Hint
from minisplat_ref.oracle.comparison.measures import Difference
from minisplat_ref.oracle.comparison.staged import Row, compare_scene, hints_of, slight
from minisplat_ref.oracle.comparison.trials import Evidence, Trace, fit_of, run_fault, traces_of
from minisplat_ref.oracle.faults import FAULTS
from minisplat_ref.oracle.faults.backward import scale_gradient
from minisplat_ref.oracle.faults.forward import with_conics
from minisplat_ref.oracle.golden.scenes import RECIPES, inputs, truth
from minisplat_ref.oracle.gradients import inner_product_case
from minisplat_ref.oracle.pieces import tiny_setting
from minisplat_ref.oracle.renderer import ComparedRenderer
from minisplat_ref.oracle.stages import project_stage, sh_stage
from minisplat_ref.testing import assert_matches_oracle


def fault_of(what, where):
    (found,) = [fault for fault in FAULTS if fault.what == what and fault.where == where]
    return found


@pytest.fixture(scope="module")
def scene():
    return truth(inputs(next(recipe for recipe in RECIPES if recipe.name == "sh3")), zeros=("v_depths",))


# --- by hand ---


def trace(given, expected, *, is_wrong, unit=1e-3):
    given, expected = np.array(given, float), np.array(expected, float)
    return Trace("image", is_wrong, given, expected, np.ones(given.shape, bool), unit)


def test_misfits_by_hand(scene):
    """Of an error of 4 + 0, a fault that leaves 1 leaves a quarter; the truth leaves all, the same array nothing."""
    (x,) = [trace([5.0, 2.0], [1.0, 2.0], is_wrong=True)]
    assert fit_of([x], {"image": np.array([4.0, 2.0])}, scene) == (0.25, False)
    assert fit_of([x], {"image": np.array([5.0, 2.0])}, scene) == (0.0, True)
    assert fit_of([x], {"image": np.array([1.0, 2.0])}, scene) == (1.0, False)
    assert fit_of([x], {"image": np.array([np.nan, 2.0])}, scene) == (2.0, False)  # no better than twice the error


def test_a_right_array_may_not_be_spoiled(scene):
    right = trace([1.0, 2.0], [1.0, 2.0], is_wrong=False)
    wrong = trace([5.0, 2.0], [1.0, 2.0], is_wrong=True)
    fit = fit_of([wrong, right._replace(name="view")], {"image": np.array([5.0, 2]), "view": np.array([1, 2.5])}, scene)
    assert not fit.is_exact and fit.misfit == pytest.approx(0.5)  # the mean of 0 and 5 x 1/2, of which 1 counts


def test_words():
    assert Hint("scales times 2", ("projection",), 1.0, True).words == "scales times 2, in the projection"
    both = Hint("the exponent times 2", ("projection", "blending"), 0.5, False)
    assert both.words == "the exponent times 2, in the projection or in the blending (explains 50% of the error)"
    assert Hint("v times 2", ("gradient of colours",), 1.0, True).words == "v times 2"


# --- the faults ---


IMAGES = ("image", "alpha", "feature_image", "accumulated_depth", "view")


def is_changed(fault, size, scene):
    arrays = run_fault(fault, size, scene, is_fed=False)
    return not all(np.allclose(arrays[name], scene.arrays[name], atol=1e-9) for name in IMAGES)


def test_every_fault_of_images_changes_some_and_none_at_its_null_size(scene):
    known = [recipe for recipe in RECIPES if recipe.name in ("antialiased", "odd-size", "planes")]
    scenes = [scene, *(truth(inputs(recipe), zeros=("v_depths",)) for recipe in known)]
    for fault in FAULTS:
        if fault.is_forward:
            assert any(is_changed(fault, fault.sizes[0], s) for s in scenes), fault.what
            assert fault.null is None or not is_changed(fault, fault.null, scene), fault.what


DIFFERENTIATED = (
    ("another low-pass", "the low-pass at {} px^2 in place of 0.3", "projection"),
    ("quaternions", "quaternions read as xyzw", "projection"),
    ("scales", "scales times {}", "projection"),
    ("unsquared", "scales that are not squared", "projection"),
    ("conic", "the conic's off-diagonal times {}", "projection"),
    ("distances", "distances from the camera in place of depths", "projection"),
    ("slopes", "the limits of the Jacobian's slopes times {}", "projection"),
    ("bands", "harmonics of degree 1 times {}", "colours"),
    ("coefficient", "harmonic Y_2,0 times {}", "colours"),
    ("negative", "colours that are not clamped at 0", "colours"),
)


@pytest.mark.parametrize(("what", "where"), [case[1:] for case in DIFFERENTIATED], ids=[c[0] for c in DIFFERENTIATED])
def test_a_forward_fault_that_says_so_has_its_own_derivative(what, where):
    setting, fault = tiny_setting(sh_degree=2), fault_of(what, where)
    make_stage = sh_stage if where == "colours" else project_stage
    case = inner_product_case(make_stage(fault.plant(fault.sizes[-1]), setting), np.random.default_rng(0))
    assert not [problem for problem in case.note.split("; ") if problem and not problem.endswith("is zero")]


# --- other scenes and sizes ---

JUDGED = {
    "pixel centres at {} in place of 0.5, in x and y": ("blending", 0.0),
    "pixel centres at {} in place of 0.5, in x": ("projection", 0.3),
    "the low-pass at {} px^2 in place of 0.3": ("projection", 0.0),
    "quaternions read as xyzw": ("projection", 1.0),
    "harmonic Y_3,1 times {}": ("colours", -1.0),
    "harmonic Y_2,0 times {}": ("colours", 2.5),
    "no stop of the transmittance": ("blending", 1.0),
    "the background times {}": ("blending", 0.3),
    "the gradient of the scales times {}": ("gradient of projection", 1.2),
    "what is behind a hit forgotten in the gradient of alpha": ("gradient of blending", 1.0),
}


@pytest.fixture(scope="module")
def other_scenes():
    return {name: judging.scenes_of(5, way, ("off-centre", "sh3")) for name, way in judging.WAYS.items()}


@pytest.mark.parametrize("what", JUDGED)
@pytest.mark.parametrize("way", ["every stage", "a function without a meta"])
def test_other_scenes_and_sizes_are_told(what, way, other_scenes):
    where, size = JUDGED[what]
    fault, called = fault_of(what, where), judging.WAYS[way]
    hints = judging.hints_for(judging.faulty(fault, size, called), other_scenes[way])
    assert judging.is_named(hints[0], fault, size), [hint.words for hint in hints]
    assert hints[0].is_exact and all(hint.is_exact for hint in hints)


def test_images_alone_are_never_explained_by_gradients(other_scenes):
    way = judging.WAYS["its image alone"]
    for what in ("harmonic Y_3,1 times {}", "pixel centres at {} in place of 0.5, in y"):
        fault = next(fault for fault in FAULTS if fault.what == what)
        hints = judging.hints_for(judging.faulty(fault, fault.sizes[0], way), other_scenes["its image alone"])
        assert hints and not [hint for hint in hints if hint.places[0].startswith("gradient")]


def test_nothing_is_named_that_explains_nothing(scene):
    """Noise is no fault."""
    rng = np.random.default_rng(0)
    noisy = {"image": scene.arrays["image"] + 0.1 * rng.normal(size=scene.arrays["image"].shape)}
    rows = compare_scene(ComparedRenderer("noisy", "float64", False, lambda _: noisy), scene)
    hints, lines = hints_of(rows)
    assert hints == [] and lines[0].startswith("image wrong: unlike all ")


def test_what_no_fault_changes_has_no_hints(scene):
    given = {"loss": scene.arrays["loss"] + 1, "adam_values_after": scene.arrays["adam_values_after"] + 1}
    rows = compare_scene(ComparedRenderer("other", "float64", False, lambda _: given), scene)
    assert rows and hints_of(rows) == ([], [])


def test_bounds_without_effect_are_no_evidence(scene):
    radii = scene.arrays["radii"] + 5 * (scene.arrays["radii"] > 0)
    evidence = Evidence({"radii": radii, "image": scene.arrays["image"]}, scene, {}, "float64", False)
    assert [trace.name for trace in traces_of(evidence, frozenset(["image"]), is_forward=True)] == ["image"]


def test_judging_counts():
    background = fault_of("the background times {}", "blending")
    assert judging.size_of(background) == pytest.approx(0.15)
    assert judging.size_of(fault_of("fx and fy exchanged", "projection")) == 1.0
    gradient = next(fault for fault in FAULTS if not fault.is_forward)
    assert judging.judge("every stage", 3, [background])[1:] == ["1 of 1 (100%)", "1 of 1 (100%)", "0"]
    assert judging.judge("its image alone", 3, [gradient])[-1] == "1"  # an image does not show a gradient


# --- reports ---


def test_the_command_names_the_planted_fault(capsys, tmp_path):
    file = tmp_path / "c.json"
    assert main(["oracle", "compare", "planted:half-off-diagonal", "--scene", "sh3", "--json", str(file)]) == 1
    output = capsys.readouterr().out
    assert "v_conics, v_conics_features, " in output and " right: as with\n" in output
    assert "  1. the gradient of the conic's off-diagonal times 0.5\n" in output
    lines = json.loads(file.read_text())["settings"]["looks_like"]
    assert len(lines) == 2 and lines[1] in output
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
        assert_matches_oracle(function, vjp, dtype="float64", scenes=("off-centre", "odd-size"))
    return str(error.value)


def test_without_a_meta_a_wrong_conic_may_be_in_two_places():
    text = message_of(*ours(with_conics((1, 0.6, 1))))
    assert "the first stage that diverges is T, in scene" in text
    assert "; or the error is in means2d, depths, conics, " in text.partition("\n")[0]
    assert "  1. the conic's off-diagonal times 0.6, in the projection or in the blending" in text
    asked = next(line for line in text.splitlines() if line.startswith("to tell these apart, return "))
    assert "conics" in asked and asked.endswith("as well (a function: in its meta)")
    assert "depths" not in asked  # with either they are right


def test_with_it_the_conic_is_named():
    text = message_of(*ours(with_conics((1, 0.6, 1)), has_meta=True))
    assert "the first stage that diverges is conics" in text and "or the error is in" not in text
    assert "conics, " in text and "and means2d, depths, opacities2d" in text
    assert "  1. the conic's off-diagonal times 0.6, in the projection" in text and "in the blending" not in text


def test_a_pattern_of_gradients_alone():
    """v_means, v_quats and v_scales wrong, v_opacities right: as with a halved off-diagonal of the conic."""
    halved = scale_gradient("composite_vjp", "conics", columns=(0, 1, 0))(0.5)
    text = message_of(*ours(halved))
    assert "v_means, v_quats, v_scales, " in text
    assert "v_opacities, " in text.partition(" right: as with")[0].rpartition(" wrong and ")[2]
    assert "  1. the gradient of the conic's off-diagonal times 0.5" in text


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


def test_the_page_says_what_is_printed():
    """The example in docs/ORACLE.md."""
    text = (Path(__file__).parents[2] / "docs" / "ORACLE.md").read_text()
    assert str(sum(fault.is_forward for fault in FAULTS)) in text and f"{len(FAULTS)} planted faults" in text
