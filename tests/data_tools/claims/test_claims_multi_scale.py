"""Levels at every size, on a small scene."""

import pytest

from data_tools.claims.__main__ import main as measure_claim
from measured_claims import measured
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene

SCENE = {"n_views": 6, "width": 64, "height": 48, "n_points": 300, "test_every": 4}


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes") / "nook"
    write_scene(make_scene("room", supersampling=1, **SCENE), folder, SCENE)
    return folder


def test_the_claim_compares_at_every_size(scene_folder, tmp_path, capsys):
    out = tmp_path / "measured"
    options = [str(scene_folder), "--iterations", "40", "--seeds", "1", "--out", str(out)]
    result = measured(["multi-scale/downscale", *options])
    assert result["blocks"] == [1, 2, 4, 8]
    pairs = {name: figures["n_pairs"][0] for name, figures in result["figures"].items()}
    assert pairs["levels 2"][-1] < pairs["3dgs"][-1]
    assert (out / "figure.png").stat().st_size > 10_000 and "| too early " in capsys.readouterr().out
    assert measure_claim(["multi-scale/downscale", "room", "--downscale", "2", "--out", str(tmp_path / "none")]) == 2
    assert not (tmp_path / "none").exists()
