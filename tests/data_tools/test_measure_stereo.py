"""The share of a dense start's points that are wrong, by points whose error is known."""

import numpy as np
from numpy.testing import assert_allclose

from data_tools import measure_stereo
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.strategy.plane_sweep import surface_points


def test_points_in_the_air_are_wrong(monkeypatch):
    made = make_scene("room", n_views=4, width=24, height=18, supersampling=1, n_points=50)
    camera, depths = made.scene.train_views[0].camera, made.train_depths[0]
    rows, columns = np.array([3, 9, 14]), np.array([20, 12, 4])
    right = surface_points(camera, depths, rows, columns)
    wrong = camera.center + 0.5 * (right[:1] - camera.center)  # half of the way there is nothing
    errors = measure_stereo.errors_of(made, np.concatenate([right, wrong]))
    assert_allclose(errors[:3], 0, atol=1e-6)
    assert errors[3] > 0.1
    sparse = made.scene.points
    monkeypatch.setattr(measure_stereo, "densify_points", lambda scene: (np.concatenate([sparse, right, wrong]), None))
    assert measure_stereo.measure(made)[:3] == ["room", "4", "25.0%"]
    monkeypatch.setattr(measure_stereo, "densify_points", lambda scene: (sparse, None))
    assert measure_stereo.measure(made)[:3] == ["room", "0", "0.0%"]


def test_the_command_prints_a_row_of_each_scene(monkeypatch, capsys):
    monkeypatch.setattr(measure_stereo, "SIZE", {"n_views": 4, "width": 48, "height": 36, "supersampling": 1})
    measure_stereo.main(["room", "staircase"])
    printed = capsys.readouterr().out
    assert "| room " in printed and "| staircase " in printed and "off by more than 5 %" in printed
