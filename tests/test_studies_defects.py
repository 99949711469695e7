"""``study defects``: what is planted is what the record says, and the table counts the records."""

import json

import numpy as np
import pytest

from minisplat_ref.cli import main
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.experiments.studies import defects
from minisplat_ref.training.calibration import EXPOSURE, POSE


@pytest.fixture(scope="module")
def scene():
    return make_scene("room", n_views=9, width=40, height=30, n_points=150, supersampling=1).scene


def test_gains_are_planted(scene):
    disturbed = defects.with_gains(scene, np.random.default_rng(0))
    for view, other in zip(scene.train_views, disturbed.train_views, strict=True):
        ratio = other.image[view.image > 100].mean() / view.image[view.image > 100].mean()
        assert 0.89 < ratio < 1.11 and ratio != 1


def test_cameras_are_turned_by_half_a_pixel(scene):
    disturbed = defects.with_turned_cameras(scene, np.random.default_rng(0))
    for view, other in zip(scene.train_views, disturbed.train_views, strict=True):
        camera, moved = view.camera, other.camera
        axis = camera.cam_from_world_R.T @ np.array([0.0, 0.0, 1.0])  # what stands in the middle of the image
        x, y, z = moved.cam_from_world_R @ axis
        assert np.hypot(camera.fx * x / z, camera.fy * y / z) == pytest.approx(defects.PIXELS, rel=1e-3)
        np.testing.assert_allclose(moved.center, camera.center, atol=1e-12)


def test_command(tmp_path, capsys):
    options = ["--views", "9", "--width", "40", "--height", "30", "--supersampling", "1", "--points", "150"]
    assert main(["synthetic", "room", "--out", str(tmp_path / "room"), *options]) == 0
    command = ["study", "defects", str(tmp_path / "room"), "--trials", "1", "--out", str(tmp_path / "out")]
    assert main(command) == 0
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert [run["condition"] for run in result["runs"]] == list(defects.CONDITIONS)
    for run in result["runs"]:
        row = result["summary"][run["condition"]]
        assert row == {"trials": 1, **{c.name: int(c.name in run["switched_on"]) for c in (EXPOSURE, POSE)}}
        assert all("explain" in note for note in run["evidence"].values()) and len(run["evidence"]) == 2
    printed = capsys.readouterr().out
    assert f"after {defects.decision_step()} iterations" in printed and "| poses " in printed
