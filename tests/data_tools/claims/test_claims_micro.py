"""Micro-splatting: equal counts and curves, on small scenes."""

import pytest

from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.micro.counts import CURVES
from measured_claims import measured, scene_folder  # noqa: F401  (a fixture)


def test_the_claim_measures_at_equal_count(tmp_path, capsys):
    out = tmp_path / "measured"
    found = measured(["micro/checker", "--iterations", "130", "--seeds", "1", "--out", str(out)])["variants"]
    assert {tuple(numbers["n"]) for numbers in found.values()} == {(840,)}
    assert found["both"]["psnr_edges"][0] > found["3dgs"]["psnr_edges"][0]
    assert (out / "figure.png").stat().st_size > 10_000
    assert "| both " in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        measure_claim(["micro/checker", "--seeds", "0", "--out", str(tmp_path / "none")])
    assert not (tmp_path / "none").exists()


def test_the_claim_measures_quality_against_count(scene_folder, tmp_path, capsys, monkeypatch):
    short = {name: curve._replace(points=curve.points[:1]) for name, curve in CURVES.items()}
    monkeypatch.setattr("data_tools.claims.micro.counts.CURVES", short)
    out = tmp_path / "counts"
    options = ["--iterations", "300", "--seeds", "1", "--out", str(out)]
    plain, first, both = measured(["micro/counts", str(scene_folder), *options])["records"]
    assert both["n_gaussians"] < first["n_gaussians"] and plain["settings"] == {"threshold": 2e-4}
    assert (out / "figure.png").stat().st_size > 10_000 and "| micro, first stage alone | " in capsys.readouterr().out
