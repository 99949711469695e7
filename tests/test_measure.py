"""The README's measurements: a rate appears, of a training whose number of Gaussians stays what was asked for."""

import re

import pytest

from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.experiments.measure import measure_rate


@pytest.fixture
def scene_folder(tmp_path):
    settings = {"n_views": 4, "width": 32, "height": 24, "n_points": 300}
    write_scene(make_scene("room", **settings), tmp_path / "room", settings)
    return tmp_path / "room"


def test_rate_of_training(scene_folder, capsys):
    measure_rate(scene_folder, n=200, iterations=3)
    text = capsys.readouterr().out
    assert "32 x 24, 200 Gaussians, 3 iterations" in text
    assert float(re.search(r"([0-9.]+) iterations/s", text)[1]) > 0
