"""The error of one Gaussian's footprint, as the docstring of the relative quotes it."""

import pytest

from data_tools.claims import analytic as footprint
from data_tools.claims.__main__ import main as measure_claim
from measured_claims import measured


def test_the_claim_finds_what_the_docstring_says(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(footprint, "SIGMAS", (0.1, 1.0))
    out = tmp_path / "measured"
    errors = measured(["analytic/footprint", "--out", str(out)])["errors"]
    assert errors["round"]["integral, logistic"][0] < 1e-3 < 0.1 < errors["round"]["Mip filter"][0]
    assert errors["round"]["dilation"][0] > 10 > errors["round"]["centre"][0] > 1
    assert 0.02 < errors["needle"]["integral, erf"][0] < 0.2
    assert (out / "figure.png").stat().st_size > 10_000 and "| needle " in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        measure_claim(["analytic/footprint", "--places", "0", "--out", str(tmp_path / "none")])
    assert not (tmp_path / "none").exists()
