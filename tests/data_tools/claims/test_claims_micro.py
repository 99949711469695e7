"""Micro-splatting: equal counts and curves, on small scenes."""

import json

import pytest

from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.micro.counts import CURVES
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene

SCENE = {"n_views": 6, "width": 32, "height": 24, "n_points": 60, "test_every": 4}


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes") / "nook"
    write_scene(make_scene("room", supersampling=1, **SCENE), folder, SCENE)
    return folder


def test_the_claim_measures_at_equal_count(tmp_path, capsys):
    out = tmp_path / "measured"
    assert measure_claim(["micro/checker", "--iterations", "130", "--seeds", "1", "--out", str(out)]) == 0
    found = json.loads((out / "result.json").read_text())["variants"]
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
    assert measure_claim(["micro/counts", str(scene_folder), *options]) == 0
    plain, first, both = json.loads((out / "result.json").read_text())["records"]
    assert both["n_gaussians"] < first["n_gaussians"] and plain["settings"] == {"threshold": 2e-4}
    assert (out / "figure.png").stat().st_size > 10_000 and "| micro, first stage alone | " in capsys.readouterr().out
