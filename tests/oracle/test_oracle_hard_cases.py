import json
from dataclasses import replace

import numpy as np
import pytest

from minisplat_ref.app.cli import main
from minisplat_ref.constants import PROFILES
from minisplat_ref.errors import InputError
from minisplat_ref.oracle import hard_cases
from minisplat_ref.oracle.hard_cases import GROUPS, HARD_CASES, subjects
from minisplat_ref.oracle.hard_cases.run import (
    PRECISIONS,
    Precision,
    by_group,
    run_hard_case,
    run_hard_cases,
    select_cases,
)
from minisplat_ref.oracle.hard_cases.subjects import Call, Parameters, render_subject
from minisplat_ref.oracle.tolerances import ORDINARY
from minisplat_ref.rendering import render_vjp
from minisplat_ref.rendering.backends import BACKENDS, CPU, REFERENCE

BY_NAME = {case.name: case for case in HARD_CASES}

# What a catalogue of hard cases has to have, by a word of its name.
ASKED_FOR = (
    *("needle-1e6", "pancake-1e6", "scale-1e-8", "scale-1e4", "logit-plus-30", "logit-minus-30", "zero-quaternion"),
    *("huge-quaternions", "4000-faint-layers", "equal-depths", "alpha-at-1-of-255", "transmittance-at-the-stop"),
    *("on-the-near-plane", "behind", "beside", "at-the-camera-centre", "clamp-active", "principal-point-off-centre"),
    *("1x1", "3x1000", "no-tile-divides", "world-at-1e6", "singular-without-low-pass", "ssim-flat-equal", "ssim-equal"),
    *("sh-3-at-plus-z", "sh-3-at-minus-z", "empty-scene", "nan-in-means", "inf-in-means"),
    *("opacity-at-alpha-min", "opacity-of-one-byte", "radius-beyond-int32", "wall-facing-a-turned-camera"),
    *("needles-many", "sub-pixel-many", "enormous-many", "of-all-scales-many", "around-the-camera-many", "strip-wide"),
    *("coincident-means", "one-depth", "faint-layers", "focal-huge", "focal-tiny", "focal-unequal", "world-many"),
    *("harmonics", "quaternion-lengths", "log-scales-plus-minus-40", "channels-1", "tile-edges", "everything-many"),
)


@pytest.mark.parametrize("case", HARD_CASES, ids=lambda case: case.name)
def test_hard_case(case):
    result = run_hard_case(case)
    assert result.passed, result.note


def test_digits_lost_in_the_gradient_of_a_logit_are_noticed(monkeypatch):
    """1 - o where 1 / (1 + exp(logit)) is meant: too small to be seen beside other blocks, unless by the opacity."""

    def wrong(tape, v_image, v_alpha):
        v, o = render_vjp(tape, v_image, v_alpha), tape.splats.primitives.opacities
        right = 1 / (1 + np.exp(tape.gaussians.opacity_logits))
        return v._replace(gaussians=v.gaussians._replace(opacity_logits=v.gaussians.opacity_logits * (1 - o) / right))

    monkeypatch.setattr(subjects, "render_vjp", wrong)
    assert "v_opacity_logits" in run_hard_case(BY_NAME["logit-plus-30"]).note


# --- the catalogue ---


def test_catalogue_is_complete():
    assert len(HARD_CASES) >= 60 and len(BY_NAME) == len(HARD_CASES)
    for word in ASKED_FOR:
        assert any(word in name for name in BY_NAME), word
    for case in HARD_CASES:
        assert case.why and case.correct and case.tolerance.reason
        assert "\n" not in case.why + case.correct
    assert all(GROUPS.values())


def test_every_precision_is_given_the_same_numbers():
    for case in (case for case in HARD_CASES if case.refusal is None):
        subject = case.build()
        if isinstance(subject, Parameters):
            arrays = subject.gaussians
        elif isinstance(subject, Call):
            arrays = [array for array in subject.arrays.values() if array.dtype.kind == "f"]
        else:
            continue
        for array in arrays:
            with np.errstate(over="ignore"):
                assert np.array_equal(array.astype(np.float32), array, equal_nan=True), case.name


# --- what is reported ---


def with_composite(change):
    """The CPU backend in float32, its image or a gradient of it changed."""

    def composite(*args, **options):
        output = CPU.composite(*args, **options)
        return output._replace(image=change(output.image))

    return (Precision("f32", replace(CPU, composite=composite), np.float32),)


@pytest.mark.parametrize(
    ("change", "note"),
    [
        (lambda image: image * np.float32(1.001), "image off by"),
        (lambda image: np.where(image == image.max(), np.float32(np.nan), image), "image is not finite"),
    ],
)
def test_wrong_images_fail(change, note):
    result = run_hard_case(BY_NAME["needle-1e3-oblique"], with_composite(change))
    assert not result.passed and note in result.note


def test_wrong_gradients_fail():
    def composite_vjp(*args):
        v = CPU.composite_vjp(*args)
        return v._replace(conics=v.conics * [1, 0.5, 1])

    backend = replace(CPU, composite_vjp=composite_vjp)
    result = run_hard_case(BY_NAME["needle-1e3-oblique"], (Precision("f64", backend, np.float64),))
    assert not result.passed and result.note.count("v_") == 1


def test_float32_conics_would_fail():
    # The gain of conics in float64 and of the sum of squares, in one number.
    def project(*args):
        projection = CPU.project(*args)
        return projection._replace(conics=projection.conics.astype(np.float32).astype(np.float64))

    case = BY_NAME["needle-1e6-tilted"]
    rounded = run_hard_case(case, (Precision("f32", replace(CPU, project=project), np.float32),))
    kept = run_hard_case(case, (PRECISIONS[-1],))
    assert rounded.figures["image f32"] > 30 * kept.figures["image f32"]
    assert not rounded.passed and kept.passed


def test_what_is_drawn_where_it_should_be_refused_fails():
    case = BY_NAME["ball"]._replace(refusal="anything")
    assert "does not refuse" in run_hard_case(case).note
    refused = BY_NAME["nan-in-means"]
    assert "not 'another message'" in run_hard_case(refused._replace(refusal="another message")).note
    result = run_hard_case(refused._replace(refusal=None))
    assert not result.passed and result.note.startswith("refused: scene: means is nan")


def test_cases_that_check_nothing_fail():
    assert "checks nothing" in run_hard_case(BY_NAME["behind"]._replace(is_background=False)).note
    assert "something is drawn" in run_hard_case(BY_NAME["ball"]._replace(is_background=True)).note


def test_flips_are_counted_and_bounded():
    def one_hit_more(image):
        changed = image.copy()
        changed[4, 4] += 0.5  # the pixel on the threshold
        return changed

    case = BY_NAME["alpha-at-1-of-255"]
    figures = run_hard_case(case).figures
    assert figures["on threshold"] == 1 and figures["flips"] <= 1
    result = run_hard_case(case, with_composite(one_hit_more))
    assert not result.passed and "more than one hit" in result.note and result.figures["flips"] == 1


def test_a_threshold_excuses_only_what_its_hits_can_change():
    """At the clamp the gradient jumps, and the image does not."""

    def brighter(image):
        changed = image.copy()
        changed[4, 4] += 1e-3
        return changed

    case = BY_NAME["alpha-at-the-clamp"]
    assert run_hard_case(case).figures["on threshold"] >= 1
    result = run_hard_case(case, with_composite(brighter))
    assert not result.passed and "a pixel on a threshold is off by 1.0e-03" in result.note


def test_tolerances_are_what_decides():
    strict = ORDINARY._replace(image32=0.0)
    assert not run_hard_case(BY_NAME["ball"]._replace(tolerance=strict), (PRECISIONS[-1],)).passed


@pytest.mark.parametrize("backend", BACKENDS.values(), ids=BACKENDS.keys())
def test_drawing_is_in_the_dtype_asked_for(backend):
    drawn = render_subject(BY_NAME["needle-end-on"].build(), backend, np.dtype(np.float32))
    assert {output.dtype for output in drawn.outputs.values()} == {np.dtype(np.float32)}


# --- the command ---


def test_command_prints_and_writes(tmp_path, capsys):
    path = tmp_path / "cases.json"
    assert main(["oracle", "hard-cases", "--only", "quaternion", "--json", str(path)]) == 0
    printed = capsys.readouterr().out
    cases = json.loads(path.read_text())["cases"]
    assert len(cases) == len(select_cases(HARD_CASES, "quaternion")) >= 4
    for case in cases:
        assert case["passed"] is True and case["name"] in printed
        assert set(case) >= {"name", "passed", "note"}
    drawn = next(case for case in cases if case["name"] == "huge-quaternions")
    labels = [f"{kind} {precision.label}" for kind in ("image", "grad") for precision in PRECISIONS]
    assert all(isinstance(drawn[label], float) for label in labels) and drawn["flips"] == drawn["on threshold"] == 0
    assert f"all {len(cases)} cases passed" in printed


def test_command_fails_with_a_planted_error(monkeypatch, capsys):
    planted = BY_NAME["ball"]._replace(name="planted", tolerance=ORDINARY._replace(image64=-1.0))
    monkeypatch.setattr(hard_cases, "HARD_CASES", (BY_NAME["1x1"], planted))
    assert main(["oracle", "hard-cases"]) == 1
    printed = capsys.readouterr().out
    assert "| planted | FAILED" in printed and "worst of each kind" in printed and "1 of 2 cases failed" in printed


def test_command_knows_its_cases(capsys):
    assert main(["oracle", "hard-cases", "--only", "no such case"]) == 2
    assert "no such case" in capsys.readouterr().err
    with pytest.raises(InputError, match="run without --only"):
        select_cases(HARD_CASES, "no such case")
    assert {case.name for case in select_cases(HARD_CASES, "needle-*-oblique")} < set(BY_NAME)


def test_summary_has_the_worst_of_each_kind():
    cases = (BY_NAME["ball"], BY_NAME["needle-1e6-tilted"], BY_NAME["nan-in-means"], BY_NAME["call-skew"])
    report = run_hard_cases(cases)
    shapes, refused = by_group(report, GROUPS).cases
    assert (shapes.name, refused.name) == ("shapes", "bad input")
    assert shapes.figures["image f32"] == max(case.figures["image f32"] for case in report.cases[:2])
    assert (shapes.figures["cases"], shapes.figures["refused"]) == (2, 0) and shapes.passed
    assert refused.figures == {"cases": 2, "refused": 2}


def test_report_has_every_case():
    cases = select_cases(HARD_CASES, "ssim-flat")
    report = run_hard_cases(cases)
    assert [case.name for case in report.cases] == [case.name for case in cases] and report.n_failed == 0
    assert REFERENCE not in [precision.backend for precision in PRECISIONS]


# --- scenes that nobody thought of ---


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_extreme_numbers_stay_finite(dtype, rng):
    n_drawn = 0
    for turn in range(60):
        extreme = rng.choice([1, 3, 8])
        means = rng.normal(size=(20, 3)) * 10 ** rng.uniform(-extreme, extreme, size=(20, 1))
        means[:10, :2] = means[:10, 2:] * rng.uniform(-0.3, 0.3, size=(10, 2))  # these are in the view or behind it
        scales = 10 ** rng.uniform(-2 * extreme, extreme, size=(20, 3)) * (rng.random((20, 3)) > 0.05)
        arrays = {
            "means": means,
            "quats": rng.normal(size=(20, 4)) * 10 ** rng.uniform(-2 * extreme, 2 * extreme, size=(20, 1)),
            "scales": scales,
            "opacities": rng.choice([0, 1 / 255, 0.5, 0.99, 1], size=20),
            "colors": rng.normal(size=(20, 3)),
            "viewmats": np.eye(4)[None],
            "Ks": np.array([[[10 ** rng.uniform(-1, 4), 0, 8], [0, 10 ** rng.uniform(-1, 4), 6], [0, 0, 1]]]),
        }
        options = {
            "eps2d": float(turn % 2) * 0.3,
            "rasterize_mode": ("classic", "antialiased")[turn // 2 % 2],
            "profile": tuple(PROFILES)[turn // 4 % 4],
        }
        subject = Call(arrays, 16, 12, options)
        drawn = render_subject(subject, CPU, np.dtype(dtype))
        v = {name: rng.normal(size=drawn.outputs[name].shape).astype(dtype) for name in drawn.differentiable}
        for name, values in {**drawn.outputs, **drawn.vjp(v)}.items():
            assert np.isfinite(values).all(), (turn, name)
        n_drawn += drawn.outputs["alpha"].any()
    assert n_drawn > 20
