"""Errors against 50 digits: small where they should be, and large where a formula is wrong or loses digits."""

import builtins
import dataclasses
import json

import numpy as np
import pytest

from minisplat_ref.app.cli import main
from minisplat_ref.errors import InputError
from minisplat_ref.oracle import truth
from minisplat_ref.reference.covariance import rotation_matrices

pytest.importorskip("mpmath", reason="needs mpmath: pip install 'minisplat_ref[peers]'")


@pytest.fixture(scope="module")
def figures():
    report = truth.check_truth()
    assert report.n_failed == 0
    return {case.name: case.figures for case in report.cases}


def test_the_reference_has_thirteen_digits_on_ordinary_gaussians(figures):
    for name in ("covariance, ordinary", "means2d, ordinary", "conics, ordinary", "transmittance, libm's exp"):
        assert 0 < figures[name]["reference f64"] <= 1e-13


def test_the_kernels_formulas_gain_digits_in_float32(figures):
    # a c - b^2 cancels for needles, R mu + t far from the origin
    assert figures["conics, needles"]["gain"] > 1e4 and figures["conics, needles"]["textbook f32"] > 1e-3
    assert figures["means2d, far world"]["gain"] > 1e4 and figures["means2d, far world"]["textbook f32"] > 1e-3
    assert figures["conics, needles"]["cpu f32"] < 1e-5 and figures["means2d, far world"]["cpu f32"] < 1e-5


def test_the_exponential_costs_what_it_says(figures):
    assert figures["transmittance, libm's exp"]["cpu f32"] < figures["transmittance, cpu's exp"]["cpu f32"] < 1e-5


def test_the_sandwich_is_the_rotation(rng):
    quat = rng.normal(size=4)
    R = np.array(truth.true_rotation(quat).tolist(), dtype=float)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(R, rotation_matrices(quat[None])[0], atol=1e-15)


def test_a_wrong_formula_is_far_from_the_truth(monkeypatch):
    def project(*args):
        p = truth.CPU.project(*args)
        return p._replace(conics=p.conics * p.conics.dtype.type(1 + 1e-4))

    monkeypatch.setattr(truth, "REFERENCE", dataclasses.replace(truth.REFERENCE, project=project))
    failed = [case.name for case in truth.check_truth().cases if not case.passed]
    assert "conics, ordinary" in failed and not any(name.startswith(("means2d", "covariance")) for name in failed)


def test_the_command_writes_its_table(tmp_path, capsys):
    assert main(["oracle", "truth", "--json", str(tmp_path / "truth.json")]) == 0
    report = json.loads((tmp_path / "truth.json").read_text())
    assert len(report["cases"]) == len({case["name"] for case in report["cases"]}) >= 9
    assert all(case["passed"] for case in report["cases"])
    assert "conics, needles" in capsys.readouterr().out


def test_without_mpmath_there_is_one_line(monkeypatch):
    imported = builtins.__import__

    def importer(name, *args, **kwargs):
        if name.startswith("mpmath"):
            raise ImportError(name)
        return imported(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", importer)
    truth._mpmath.cache_clear()
    with pytest.raises(InputError, match=r"minisplat_ref\[peers\]"):
        truth.check_truth()
