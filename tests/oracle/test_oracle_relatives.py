"""The gradient proof of an extension: every backend, its loss terms, and a check of nothing fails."""

import importlib
import re
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from minisplat_ref import extensions
from minisplat_ref.app.cli import main
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.extensions import extension
from minisplat_ref.extensions.analytic import kernels as analytic_kernels
from minisplat_ref.extensions.extension import load_extension
from minisplat_ref.extensions.geometry import losses as geometric_losses
from minisplat_ref.extensions.micro import recipe as micro
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.loss_terms import loss_cases, loss_stage, own_terms
from minisplat_ref.oracle.pieces import tiny_setting
from minisplat_ref.oracle.relatives import Relative, check_relative_gradients
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering.backends import BACKENDS, CPU, REFERENCE
from minisplat_ref.training.calibration import EXPOSURES, expose_vjp
from minisplat_ref.training.losses import Cotangents, LossTerm
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.representation import GAUSSIANS

GUIDE = (Path(__file__).parents[2] / "docs" / "EXTENDING.md").read_text(encoding="utf-8")


def proof(capsys, name, *arguments):
    code = main(["oracle", "gradients", "--extension", name, *arguments])
    return code, capsys.readouterr().out


def check(term):
    return loss_cases(term, REFERENCE, GSPLAT_MAIN, GAUSSIANS)


# --- all backends ---


@pytest.fixture
def wrong_kernels(monkeypatch):
    """The gradient of the integrals with respect to the angle has the wrong sign in the kernels alone."""
    right = analytic_kernels._records_vjp

    def wrong(projection, v_records):
        flipped = v_records.copy()
        flipped[:, analytic_kernels.COS] *= -1
        return right(projection, flipped)

    monkeypatch.setattr(analytic_kernels, "_records_vjp", wrong)
    analytic_kernels.pixel_response.cache_clear()
    yield
    analytic_kernels.pixel_response.cache_clear()


def test_a_sign_in_the_kernels_alone_is_found(small_proof, wrong_kernels, capsys):
    code, output = proof(capsys, "analytic")
    assert code == 1
    failed = re.findall(r"^\| (\S+): render .*FAILED", output, re.MULTILINE)
    assert set(failed) == {"cpu", "cpu-exact"} and re.search(r"\| reference: render .*passed", output)
    assert "d image / d quats is wrong" in output


def test_every_backend_is_checked_unless_one_is_named(small_proof, capsys):
    code, output = proof(capsys, "velocity")
    assert code == 0 and "all 8 cases passed" in output
    assert all(f"| {name}: render moving Gaussians: Jacobian" in output for name in BACKENDS)
    assert output.count("render moving Gaussians: as on reference") == len(BACKENDS) - 1
    assert "all 2 cases passed" in proof(capsys, "velocity", "--backend", "cpu")[1]


def of_values(shift):
    """Return stages with one of two outputs, whose backends differ by ``shift`` in the second, as no gradient shows."""

    def stages(backend, setting, rng):
        def function(values):
            return Point((values, values + (shift if backend is CPU else 0.0)))

        return (Stage("copies", {"values": rng.normal(size=3)}, ("right", "shifted"), function, lambda v, w: (v + w,)),)

    return stages


def test_backends_that_differ_by_a_constant_are_found():
    relative = Relative("shifted", GAUSSIANS, (), (), of_values(1e-6))
    report = check_relative_gradients((REFERENCE, CPU), GSPLAT_MAIN, relative)
    assert [case.name for case in report.cases if not case.passed] == ["cpu: copies: as on reference"]
    assert report.cases[-1].note == "shifted not as on reference" and report.cases[-1].figures["error"] > 1e-7
    alone = check_relative_gradients((CPU,), GSPLAT_MAIN, relative)
    assert alone.n_failed == 0 and len(alone.cases) == 2
    same = relative._replace(stages=of_values(0.0))
    assert check_relative_gradients((REFERENCE, CPU), GSPLAT_MAIN, same).n_failed == 0


def test_a_shape_of_its_own_is_a_difference():
    def stages(backend, setting, rng):
        n = 2 if backend is CPU else 1

        def function(values):
            return Point((np.tile(values, n),))

        def vjp(v):
            return (v.reshape(n, -1).sum(axis=0),)

        return (Stage("tiled", {"values": rng.normal(size=3)}, ("tiles",), function, vjp),)

    report = check_relative_gradients((REFERENCE, CPU), GSPLAT_MAIN, Relative("tiled", GAUSSIANS, (), (), stages))
    assert report.n_failed == 1 and report.cases[-1].figures["error"] == np.inf


# --- loss terms ---


@pytest.fixture
def guide(tmp_path, monkeypatch):
    """Return a function that makes an extension of the guide's last example, with one piece of its text replaced."""
    text = re.findall(r"```python\n(.*?)```", GUIDE, re.DOTALL)[-1]
    folder = tmp_path / "mine" / "round"
    folder.mkdir(parents=True)
    monkeypatch.setattr(extensions, "__path__", [*extensions.__path__, str(folder.parent)])

    def make(right, wrong):
        assert text.count(right) == 1
        (folder / "__init__.py").write_text(text.replace(right, wrong))
        importlib.invalidate_caches()

    yield make
    sys.modules.pop("minisplat_ref.extensions.round", None)


@pytest.mark.parametrize("factor", [1, 7])
def test_the_guides_example(guide, small_proof, factor, capsys):
    """On each backend a Jacobian and inner products; where both are wrong, on compiled ones as on the reference."""
    guide("log_scales.sum(axis=1)", f"{factor} * log_scales.sum(axis=1)")
    code, output = proof(capsys, "round")
    n = 3 * len(BACKENDS) - 1
    n_wrong = 0 if factor == 1 else 2 * len(BACKENDS)
    assert code == (factor != 1) and (f"{n_wrong} of {n} cases" if n_wrong else f"all {n} cases") in output
    assert output.count("d image / d log_radii is wrong") == (0 if factor == 1 else len(BACKENDS))


def test_a_term_of_a_recipe_is_checked(monkeypatch, capsys):
    right = micro.trace_penalty_vjp
    monkeypatch.setattr(micro, "trace_penalty_vjp", lambda *args: 1.001 * right(*args))
    code, output = proof(capsys, "micro", "--backend", "cpu")
    assert code == 1
    assert re.search(r"loss term trace: Jacobian .*FAILED", output)
    assert re.search(r"trace_penalty: Jacobian .*passed", output)  # the stage has a function of its own


@pytest.mark.parametrize("left_out", ["channels", "alpha"])
def test_a_derivative_that_is_left_out_is_found(left_out, capsys):
    term = geometric_losses.LOSSES[1]

    def partly(rendered):
        value, v = term.function(rendered)
        return value, v._replace(**{left_out: {} if left_out == "channels" else None})

    name = {"channels": "depth", "alpha": "alpha"}[left_out]
    tiny, larger = check(term._replace(function=partly))
    assert f"d loss / d {name} is wrong" in tiny.note and f"the gradient with respect to {name} is zero" in larger.note


def test_a_term_without_an_error_passes():
    cases = check(geometric_losses.LOSSES[1])
    assert len(cases) == 2 and all(case.passed for case in cases)


def test_a_kink_is_no_error():
    """An absolute value and a hinge have one at every pixel; the differences do not cross them."""

    def kinked(rendered):
        image = rendered.channel("rgb")
        excess = np.maximum(np.abs(image - 0.5) - 0.2, 0)
        v = np.where(excess > 0, np.sign(image - 0.5), 0)
        return float(excess.sum()), Cotangents({"rgb": v})

    cases = check(LossTerm("kinked", kinked, 0.0))
    assert len(cases) == 2 and all(case.passed for case in cases), cases


def test_a_term_that_does_nothing_does_not_pass():
    (case,) = check(LossTerm("idle", lambda rendered: (0.0, Cotangents()), 1.0, start=4))
    assert not case.passed and case.note == "it is zero in iterations 5 to 36, so that nothing was checked"


def test_a_term_that_acts_now_and_then_is_checked_when_it_acts():
    def sometimes(rendered):
        if rendered.step % 7:
            return 0.0, Cotangents()
        means = rendered.model.gaussians.means
        return float(np.sum(means**2)), Cotangents(gaussians={"means": 3 * means})

    tiny, _ = check(LossTerm("sometimes", sometimes, 1.0))
    assert tiny.note == "d loss / d means is wrong"


def test_a_term_that_needs_a_larger_image_is_checked_on_one():
    term = own_terms(load_extension("multi-scale").recipes[0].losses, GS_ACCEL.losses)[-1]
    assert term.name == "coarse"
    (case,) = loss_cases(term, REFERENCE, GSPLAT_MAIN, load_extension("multi-scale").representation)
    assert case.name == "loss term coarse: inner products" and case.passed


def test_terms_of_the_core_are_not_the_extensions_own():
    photometric, again = GS_ACCEL.losses[0], GS_ACCEL.losses[0]._replace(name="again", weight=3.0)
    own = LossTerm("own", partial(max, 1), 1.0)
    assert own_terms([photometric, own, again, own], GS_ACCEL.losses) == (own,)


def test_held_fields_and_unused_ones_are_no_inputs():
    def of_scales(rendered):
        scales = rendered.model.gaussians.log_scales
        return float(scales.sum()), Cotangents(gaussians={"log_scales": np.ones_like(scales)})

    stage = loss_stage(LossTerm("s", of_scales, 1.0), CPU, tiny_setting(), GAUSSIANS, np.random.default_rng(0))
    assert list(stage.inputs) == ["log_scales"]


# --- parameters of photographs ---


def with_exposure(source):
    recipe = configure(GS_ACCEL, exposure=source)._replace(name="exposed")
    return Relative("exposed", GAUSSIANS, (), (recipe,), None)


def test_calibrations_of_a_recipe_are_checked(small_proof, monkeypatch):
    report = check_relative_gradients((REFERENCE,), GSPLAT_MAIN, with_exposure("learned"))
    assert [case.name for case in report.cases] == [
        f"render gaussians with exposure: {way}" for way in ("Jacobian", "inner products")
    ]
    assert report.n_failed == 0

    def wrong(colors, exposure, v):
        v_colors, v_exposure = expose_vjp(colors, exposure, v)
        return v_colors, v_exposure.T.reshape(v_exposure.shape)

    monkeypatch.setattr("minisplat_ref.training.calibration.expose_vjp", wrong)
    report = check_relative_gradients((REFERENCE,), GSPLAT_MAIN, with_exposure("learned"))
    assert report.n_failed == 2 and EXPOSURES in report.cases[0].note
    assert (
        check_relative_gradients((REFERENCE,), GSPLAT_MAIN, with_exposure("none")).n_failed == 1
    )  # nothing was checked


# --- nothing ---


@pytest.mark.parametrize("name", ["compression", "proxies"])
def test_what_has_nothing_of_its_own_fails(name, capsys):
    code, output = proof(capsys, name)
    assert code == 1 and "1 of 1 cases failed" in output
    assert f"nothing was checked: {name} has no renderer, loss term or stage of its own" in output


def test_an_extension_without_anything_fails(monkeypatch, capsys):
    monkeypatch.setattr(extension, "load_extension", lambda name: extension.Extension("empty"))
    assert proof(capsys, "empty")[0] == 1
