"""The measurements of docs/measured: a table of whole runs, and a rate at a number of Gaussians that stays."""

import json
import re

import pytest

from data_tools.measure import measure_rate, measure_scenes
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from networks import write_network


@pytest.fixture
def scene_folder(tmp_path):
    settings = {"n_views": 4, "width": 40, "height": 32, "n_points": 300}
    write_scene(make_scene("room", **settings), tmp_path / "room", settings)
    return tmp_path / "room"


def test_rate_of_training(scene_folder, capsys):
    measure_rate(scene_folder, n=200, iterations=3)
    text = capsys.readouterr().out
    assert "40 x 32, 200 Gaussians, 3 iterations" in text
    assert float(re.search(r"([0-9.]+) iterations/s", text)[1]) > 0


@pytest.mark.parametrize("with_lpips", [False, True])
def test_table_of_scenes(scene_folder, tmp_path, rng, capfd, with_lpips):
    """LPIPS has a column where its weights are given."""
    weights = write_network(tmp_path / "alex.npz", rng) if with_lpips else None
    measure_scenes([scene_folder], tmp_path / "runs", "3dgs-accel", 4, weights)
    metrics = json.loads((tmp_path / "runs" / "room" / "metrics.json").read_text())
    heading, _, row = (
        [cell.strip() for cell in line.split("|")[1:-1]] for line in capfd.readouterr().out.splitlines()[-3:]
    )
    cells = dict(zip(heading, row, strict=True))
    assert (cells["scene"], cells["PSNR (dB)"]) == ("room", f"{metrics['psnr']:.2f}")
    assert cells.get("LPIPS") == (f"{metrics['lpips']:.3f}" if with_lpips else None)
