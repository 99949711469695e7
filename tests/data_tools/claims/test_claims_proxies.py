"""Proxies: the hanging and the swinging sheet, the derivative of the roll, and small runs of both claims."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.proxies import affine as edit_claims
from data_tools.claims.proxies import sheet as sheet_claims
from data_tools.claims.proxies.affine import roll, rolled_jacobian
from measured_claims import measured
from minisplat_ref.io.images import read_image
from tolerances import CLOSED_FORM, GRADIENT_REL, GRADIENT_STEP, VERLET_SLOPE


def test_the_hanging_sheet_nears_the_catenary():
    errors = [np.linalg.norm(np.subtract(*sheet_claims.hang_sheet(n, 1e-3)), axis=1).max() for n in (4, 8)]
    assert errors[1] < 4e-3 and errors[0] > 3 * errors[1]


@pytest.mark.parametrize("name", ["no drag", "drag"])
def test_the_energy_balance_closes_with_the_square_of_the_step(name):
    errors = [
        sheet_claims.energy_error(sheet_claims.swing_sheet(sheet_claims.SWINGS[name], f)) for f in (0.8, 0.4, 0.2)
    ]
    assert errors[0] > 1e-6  # else there is no slope to see
    slopes = np.log2(np.divide(errors[:-1], errors[1:]))
    assert_allclose(slopes, 2, atol=VERLET_SLOPE)


def test_the_derivative_of_the_cylinder(rng):
    points = np.column_stack([rng.uniform(-1, 1, (20, 2)), np.zeros(20)])
    J = rolled_jacobian(points)
    for axis in range(2):
        moved = GRADIENT_STEP * np.eye(3)[axis]
        numeric = (roll(points + moved) - roll(points - moved)) / (2 * GRADIENT_STEP)
        assert_allclose(J[:, :, axis], numeric, atol=GRADIENT_REL)
    assert_allclose(np.linalg.det(J), 1, atol=CLOSED_FORM)


def test_the_claim_of_edits(tmp_path, capsys):
    result = measured(["proxies/affine", "--seeds", "1", "--out", str(tmp_path / "out")])
    for errors in result["edits"].values():
        assert 0 < errors["centre"] < 1e-12 and 0 < errors["covariance"] < 1e-12 and 0 < errors["color"] < 1e-12
    assert 0 < result["edits"]["rotation"]["image"] < 1e-10 and result["edits"]["shear"]["image"] is None
    bend = result["bend"]
    assert bend["centre"][-1] < bend["centre"][0] / 500  # second order over five halvings
    whole, lengths = bend["covariance"].values()
    assert whole[-1] < whole[0] / 10 and lengths[-1] > 4 * whole[-1]  # first order, and none
    assert read_image(tmp_path / "out" / "figure.png").shape[0] > 100
    assert "two lengths" in capsys.readouterr().out


def test_the_claim_of_sheets(tmp_path, capsys, monkeypatch):
    small = {"STRETCHES": (1e-2, 1e-3), "CELLS": (4,), "STEPS": (0.8, 0.4, 0.2), "FRAMES": (0.0, 0.02)}
    small |= {"SETTLING": 0.5, "SWING_CELLS": 4, "SAMPLES": 8}
    for name, value in small.items():
        monkeypatch.setattr(sheet_claims, name, value)
    result = measured(["proxies/sheet", "--out", str(tmp_path / "out")])
    assert 0 < result["free_fall"]["centre"] < 1e-12 and result["free_fall"]["covariance"] < 1e-12
    assert set(result["hanging"]) == {"0.01", "0.001"} and set(result["energy"]) == set(sheet_claims.SWINGS)
    assert "free fall for 1 s" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        measure_claim(["proxies/affine", "--seeds", "0", "--out", str(tmp_path / "no")])
    assert not (tmp_path / "no").exists() and edit_claims.CELLS
