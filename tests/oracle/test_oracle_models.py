"""The gradient proof of a whole model: any representation, nothing unseen, and a command."""

import json
from typing import NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from minisplat_ref.app.cli import main
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.extensions import extension
from minisplat_ref.oracle.models import check_model_gradients, model_stage
from minisplat_ref.oracle.pieces import tiny_setting
from minisplat_ref.oracle.stages import project_stage
from minisplat_ref.rendering import SPLATTING, Renderer
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import GAUSSIANS, Representation
from minisplat_ref.types import Gaussians, Model


class Tape(NamedTuple):
    inner: object
    gain: np.ndarray
    image: np.ndarray


def amplified(error=1.0, with_sky=False):
    """3DGS whose channels are multiplied by a shared gain [4]; with a sky, over black whatever the background is."""

    def render(model, view, request):
        request = request._replace(background=np.zeros(3)) if with_sky else request
        output, tape = SPLATTING.render(Model(model.gaussians), view, request)
        gain = model.shared["gain"]
        return output._replace(image=output.image * gain), Tape(tape, gain, output.image)

    def render_vjp(tape, v_image, v_alpha):
        v = SPLATTING.render_vjp(tape.inner, v_image * tape.gain, v_alpha)
        v_gain = error * (v_image * tape.image).sum(axis=(0, 1))
        background = 0 * v.background if with_sky else v.background
        return v._replace(shared={"gain": v_gain}, background=background)

    return GAUSSIANS._replace(
        name="amplified",
        shared=lambda scene, rng: {"gain": np.ones(4 * len(scene.train_views), np.float32)},
        renderer=Renderer("amplified", render, render_vjp, SPLATTING.channels),
    )


@pytest.mark.parametrize("with_sky", [False, True])
def test_shared_parameters_are_checked(with_sky, small_proof):
    report = check_model_gradients(REFERENCE, GSPLAT_MAIN, amplified(with_sky=with_sky))
    assert report.n_failed == 0, report.cases
    stage = model_stage(REFERENCE, tiny_setting(), amplified(with_sky=with_sky), np.random.default_rng(0))
    assert "gain" in stage.inputs and ("background" in stage.inputs) == (not with_sky)
    assert stage.inputs["gain"].dtype == np.float64 and (stage.inputs["gain"] != 1).all()


def test_a_wrong_shared_gradient_is_found(small_proof):
    report = check_model_gradients(REFERENCE, GSPLAT_MAIN, amplified(error=1 + 1e-7))
    assert [case.passed for case in report.cases] == [False, False] and "gain is wrong" in report.cases[0].note


def test_a_parameter_that_does_nothing_is_no_proof(small_proof):
    representation = GAUSSIANS._replace(shared=lambda scene, rng: {"idle": np.ones(2)})
    report = check_model_gradients(REFERENCE, GSPLAT_MAIN, representation)
    assert "nothing was checked about idle" in report.cases[0].note and report.n_failed == 2


def test_gaussians_stay_where_they_are_drawn():
    """The six fields keep the branches that the setting has by design."""
    setting = tiny_setting()
    stage = model_stage(REFERENCE, setting, GAUSSIANS, np.random.default_rng(0))
    for name, field in setting.gaussians._asdict().items():
        assert_array_equal(stage.inputs[name], field, strict=True)


@pytest.mark.parametrize("backend", [REFERENCE, CPU], ids=lambda b: b.name)
@pytest.mark.parametrize(("field", "value"), [("means", 50.0), ("opacity_logits", -9.0), ("sh_dc", -9.0)])
def test_thresholds_are_seen(backend, field, value):
    """A Gaussian that leaves the image, one that is too faint, a colour below zero: each changes a side."""
    stage = model_stage(backend, tiny_setting(), GAUSSIANS, np.random.default_rng(0))
    moved = stage.inputs[field].copy()
    moved[0] = value
    sides, others = (
        [np.ravel(side) for side in stage.function(*inputs.values()).sides]
        for inputs in (stage.inputs, {**stage.inputs, field: moved})
    )
    assert len(sides) == len(others)
    assert any(not np.array_equal(a, b) for a, b in zip(sides, others, strict=True))


def test_stages_of_an_extension_are_checked_too(small_proof):
    def stages(backend, setting, rng):
        return (project_stage(backend, setting)._replace(name="mine"),)

    report = check_model_gradients(REFERENCE, GSPLAT_MAIN, GAUSSIANS, stages)
    names = [case.name for case in report.cases]
    assert names == [
        f"{stage}: {way}" for way in ("Jacobian", "inner products") for stage in ("render gaussians", "mine")
    ]
    assert report.n_failed == 0


def test_a_stage_named_like_the_renderer_replaces_it(small_proof):
    def stages(backend, setting, rng):
        return (project_stage(backend, setting)._replace(name="render gaussians"),)

    report = check_model_gradients(REFERENCE, GSPLAT_MAIN, GAUSSIANS, stages)
    assert [case.name for case in report.cases] == ["render gaussians: Jacobian", "render gaussians: inner products"]
    assert "mean alpha" not in report.cases[0].figures


def test_the_command(tmp_path, capsys):
    path = tmp_path / "cases.json"
    assert main(["oracle", "gradients", "--extension", "velocity", "--backend", "cpu", "--json", str(path)]) == 0
    assert "all 2 cases passed" in capsys.readouterr().out
    report = json.loads(path.read_text())
    assert [case["name"].partition(":")[0] for case in report["cases"]] == ["render moving Gaussians"] * 2
    assert report["settings"]["backend"] == "cpu" and report["settings"]["time"] == 0.7
    assert all(0 < case["error"] <= case["limit"] == 1e-8 for case in report["cases"])


def test_the_command_fails_when_a_gradient_is_wrong(monkeypatch, capsys, small_proof):
    wrong = extension.Extension("velocity", representation=amplified(error=1.01))
    monkeypatch.setattr(extension, "load_extension", lambda name: wrong)
    assert main(["oracle", "gradients", "--extension", "velocity"]) == 1
    assert "gain is wrong" in capsys.readouterr().out


def test_a_field_of_learning_rate_zero_is_held(small_proof):
    """A bound that only selects has no derivative: without a rate of 0 it is said that nothing was checked about it."""

    fields = {name: np.ndarray for name in (*Gaussians._fields, "bounds")}
    Bounded = NamedTuple("Bounded", fields.items())

    def extend(gaussians, rng):
        return Bounded(*gaussians, np.zeros(len(gaussians.means)))

    representation = Representation("bounded", population=Bounded, extend=extend)
    report = check_model_gradients(REFERENCE, GSPLAT_MAIN, representation)
    assert "nothing was checked about bounds" in report.cases[0].note
    held = representation._replace(rates=Rates({"bounds": 0.0}, frozenset()))
    assert check_model_gradients(REFERENCE, GSPLAT_MAIN, held).n_failed == 0


def test_a_stage_with_the_renderers_name_takes_its_place(small_proof):
    def stages(backend, setting, rng):
        return (model_stage(backend, setting, GAUSSIANS, rng)._replace(vjp=lambda *v: 1 / 0),)

    with pytest.raises(ZeroDivisionError):
        check_model_gradients(REFERENCE, GSPLAT_MAIN, GAUSSIANS, stages)
