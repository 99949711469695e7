"""``oracle replay``: the view in which a training found a NaN, computed again by every backend."""

import json
from dataclasses import replace

import numpy as np
import pytest

from minisplat_ref.app.cli import main
from minisplat_ref.oracle import replay as replaying
from minisplat_ref.rendering.backends import BACKENDS, CPU
from minisplat_ref.training.guard import BadNumbers, Guard
from minisplat_ref.training.loop import train
from tiny_training import RECIPE, scene  # noqa: F401  (a fixture)

N_CASES = 2 * len(BACKENDS)


def broken_project_vjp(*args, **named):
    v = CPU.project_vjp(*args, **named)
    v.scales[3, 1] = np.inf
    return v


@pytest.fixture
def case_file(scene, tmp_path):
    """What a training with a broken stage leaves."""
    backend = replace(CPU, name="cpu", project_vjp=broken_project_vjp)
    with pytest.raises(BadNumbers):
        train(scene, RECIPE, seed=3, backend=backend, guard=Guard(every=1, folder=tmp_path))
    (path,) = tmp_path.iterdir()
    return path


def test_a_mended_backend_is_finite_in_every_precision(case_file, tmp_path, capsys):
    assert main(["oracle", "replay", str(case_file), "--json", str(tmp_path / "replay.json")]) == 0
    output = capsys.readouterr().out
    assert "the training found project_vjp: v_scales is inf in row 3 of 30" in output
    assert f"all {N_CASES} cases passed" in output
    cases = {case["name"]: case for case in json.loads((tmp_path / "replay.json").read_text())["cases"]}
    assert len(cases) == N_CASES
    assert 0 < cases["cpu float64"]["gradient error"] < 1e-9 < cases["cpu float32"]["gradient error"] < 1e-3
    assert cases["reference float64"]["loss"] == pytest.approx(cases["cpu float64"]["loss"], rel=1e-12)


def test_the_broken_backend_is_told_from_the_others(case_file, monkeypatch, capsys):
    """The error as it was: in the kernels only, and so in every precision of those alone."""
    broken = {**BACKENDS, "cpu": replace(CPU, project_vjp=broken_project_vjp)}
    monkeypatch.setattr(replaying, "BACKENDS", broken)
    assert main(["oracle", "replay", str(case_file)]) == 1
    lines = [line for line in capsys.readouterr().out.splitlines() if "FAILED" in line]
    assert len(lines) == 2 and all(line.startswith("| cpu float") for line in lines)
    assert all("project_vjp: v_scales is inf in row 3 of 30" in line for line in lines)


def test_a_bad_parameter_is_bad_for_all(scene, tmp_path, capsys):
    def adam_update(values, *rest):
        CPU.adam_update(values, *rest)
        values[5] = np.nan

    with pytest.raises(BadNumbers):
        train(
            scene,
            RECIPE,
            seed=3,
            backend=replace(CPU, adam_update=adam_update),
            guard=Guard(every=1, folder=tmp_path),
        )
    (path,) = tmp_path.iterdir()
    assert main(["oracle", "replay", str(path)]) == 1
    output = capsys.readouterr().out
    assert output.count("parameters: means is nan in row 5 of 30") == N_CASES


@pytest.mark.parametrize("content", [b"", b"PK"])
def test_another_file_is_refused(tmp_path, capsys, content):
    path = tmp_path / "bad-numbers-1.npz"
    path.write_bytes(content)
    assert main(["oracle", "replay", str(path)]) == 2
    assert str(path) in capsys.readouterr().err
