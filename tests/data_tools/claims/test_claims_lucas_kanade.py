"""Lucas-Kanade: the body that turns and grows, by hand, and small runs of both claims."""

import numpy as np
from numpy.testing import assert_allclose

from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.lucas_kanade import body as bodies
from data_tools.claims.lucas_kanade import trainings as claim
from measured_claims import measured
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.rendering import activate


def test_the_body_turns_and_grows(rng):
    """Its Gaussians at time 1 are those at 0, turned by one radian and a quarter larger, as covariances too."""
    body = bodies.make_body(rng)
    start, end = body.at(0.0), body.at(1.0)
    assert_allclose(np.linalg.norm(end.means, axis=1), 1.25 * np.linalg.norm(start.means, axis=1), rtol=1e-5)
    across = [g.means - np.outer(g.means @ bodies.AXIS, bodies.AXIS) for g in (start, end)]
    cosines = np.sum(across[0] * across[1], axis=1) / np.prod([np.linalg.norm(a, axis=1) for a in across], axis=0)
    assert_allclose(cosines, np.cos(1.0), atol=1e-4)  # float32, of centres near the axis
    flat = [rotation_matrices(g.quats)[:, :, 2] for g in (start, end)]  # normals
    assert_allclose(np.sum(flat[0] * start.means, axis=1), np.sum(flat[1] * end.means, axis=1) / 1.25, atol=1e-5)
    assert_allclose(activate(end).scales, 1.25 * activate(start).scales, rtol=1e-5)


def test_forms_are_measured(capsys):
    assert measure_claim(["lucas-kanade/forms", "--seeds", "1"]) == 0
    lines = [line.strip("| ").split("|") for line in capsys.readouterr().out.splitlines()]
    errors = {line[0].strip(): float(line[1]) for line in lines[2:]}
    assert errors["(i) and (iii), the latter by differences"] < 1e-7 and errors["(i) and J (ii)"] < 1e-12
    assert errors["Runge-Kutta from time 0 to 1 in 8 steps"] < 1e-4 < errors["fitted warp and the body"] < 0.1


def test_the_claim_measures_its_arms(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(bodies, "N_GAUSSIANS", 60)
    monkeypatch.setattr(bodies, "N_FRAMES", 6)
    for name, value in (("WIDTH", 48), ("HEIGHT", 32), ("FOCAL", 55.0)):
        monkeypatch.setattr(bodies, name, value)
    out = tmp_path / "out"
    records = {
        record["arm"]: record
        for record in measured(["lucas-kanade/body", "--iterations", "30", "--seeds", "0", "--out", str(out)])[
            "records"
        ]
    }
    assert list(records) == [f"{camera}, {arm}" for camera in claim.CAMERAS for arm in claim.LOSSES]
    for camera in claim.CAMERAS:
        without, _, true = (records[f"{camera}, {arm}"] for arm in claim.LOSSES)
        assert true["flow"] < without["flow"] and true["path"] < without["path"]
    assert "| still, no flow loss" in capsys.readouterr().out
