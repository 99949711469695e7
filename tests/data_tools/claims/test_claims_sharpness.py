"""Sharpness: what displacements gain, by images that were displaced by known amounts, and planted cameras."""

import json

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from data_tools.claims import sharpness
from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.kit.claim import FIGURE, RESULT
from data_tools.claims.pose import Disturbance
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.methods import get_recipe

HEIGHT, WIDTH = 96, 160


@pytest.fixture(scope="module")
def photograph():
    """Smooth noise, [H, W, 3] in [0, 1]."""
    noise = gaussian_filter(np.random.default_rng(0).normal(size=(HEIGHT, WIDTH, 3)), (2, 2, 0))
    return np.clip(0.5 + 1.5 * noise, 0, 1)


def everything():
    return np.ones((HEIGHT, WIDTH), bool)


def test_a_rendering_that_is_moved_as_a_whole(photograph):
    """Both displacements find it; fine and edges do not depend on it."""
    moved = np.roll(photograph, (1, -2), (0, 1))
    found = sharpness.compare_sharpness(moved, photograph, everything())
    assert found["moved"] > 40 and found["warped"] > 40  # dB: whole pixels, exactly
    assert found["edges"] == pytest.approx(1, abs=0.1)  # and a seam at the border
    assert found["fine"] > 0.6


def test_patches_that_are_moved_apart(photograph):
    """Each patch's own displacement explains all but what crosses its border, one of the whole image nothing."""
    torn, rng = np.empty_like(photograph), np.random.default_rng(2)
    for row in range(0, HEIGHT, sharpness.PATCH):
        for column in range(0, WIDTH, sharpness.PATCH):
            here = slice(row, row + sharpness.PATCH), slice(column, column + sharpness.PATCH)
            torn[here] = np.roll(photograph, rng.integers(-2, 3, 2), (0, 1))[here]
    found = sharpness.compare_sharpness(torn, photograph, everything())
    assert found["moved"] > 5 and found["warped"] < 0.5


def test_noise_gains_nothing(photograph):
    noisy = photograph + 0.1 * np.random.default_rng(1).normal(size=photograph.shape)
    found = sharpness.compare_sharpness(noisy, photograph, everything())
    assert abs(found["moved"]) < 0.1 and abs(found["warped"]) < 0.1
    assert found["fine"] > 0.95 and found["edges"] > 1.2


def test_a_blurred_rendering(photograph):
    """It has fewer edges, and errors that no displacement explains."""
    found = sharpness.compare_sharpness(gaussian_filter(photograph, (3, 3, 0)), photograph, everything())
    assert found["edges"] < 0.6 and abs(found["moved"]) < 0.1 and abs(found["warped"]) < 0.1
    slow = np.broadcast_to(np.linspace(0, 0.2, WIDTH)[:, None], photograph.shape)
    assert sharpness.compare_sharpness(photograph + slow, photograph, everything())["fine"] < 0.01


def test_pixels_that_do_not_count(photograph):
    """A masked part with nonsense changes nothing in the others."""
    counted = everything()
    counted[:, 2 * sharpness.PATCH :] = False
    torn = np.where(counted[..., None], np.roll(photograph, 1, 0), 1 - photograph)
    found = sharpness.compare_sharpness(torn, photograph, counted)
    assert found["moved"] > 40 and found["warped"] > 40
    assert set(sharpness.compare_sharpness(photograph, photograph, everything()).values()) <= {0.0, 1.0}


def test_a_warp_reads_where_it_says():
    """Displacements (u, v) = (2 + x, -y) of a ramp u + 10 v."""
    v, u = np.indices((HEIGHT, WIDTH))
    ramp = np.repeat((u + 10.0 * v)[..., None], 3, axis=2)
    x, y = 2 * u / WIDTH - 1, 2 * v / HEIGHT - 1
    A = np.array([[2.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
    read, inside = sharpness.warp(ramp, A, np.stack([np.ones_like(x), x, y]))
    inner = inside.copy()
    inner[:4] = inner[-4:] = inner[:, :4] = inner[:, -4:] = False
    np.testing.assert_allclose(read[inner, 0], (u + 2 + x + 10 * (v - y))[inner], atol=0.02)  # splines at the border
    assert inside[50, 100] and not inside[50, -1]


def test_planted_errors_of_cameras():
    scene = make_scene("room", supersampling=1, n_views=8, width=48, height=36, n_points=50).scene
    changed = sharpness.disturb(scene, Disturbance(0.4, 0.0), 0.02, np.random.default_rng(0))
    assert len(changed.train_views) == len(scene.train_views) and len(changed.test_views) == len(scene.test_views)
    turned = []
    for views in ((scene.train_views, changed.train_views), (scene.test_views, changed.test_views)):
        for before, after in zip(*views, strict=True):
            assert after.camera.fx == pytest.approx(1.02 * before.camera.fx)
            assert after.camera.fy == pytest.approx(1.02 * before.camera.fy)
            turn = after.camera.cam_from_world_R @ before.camera.cam_from_world_R.T
            turned.append(np.degrees(Rotation.from_matrix(turn).magnitude()))
    np.testing.assert_allclose(turned, 0.4, rtol=1e-6)


def test_from_the_command_line(tmp_path, monkeypatch, capsys):
    """A row for each recipe, from the records of its folds."""
    size = {"n_views": 8, "width": 48, "height": 36, "n_points": 300}
    write_scene(make_scene("room", supersampling=1, **size), tmp_path / "room", size)
    monkeypatch.setattr(sharpness, "recipe_of", lambda name: get_recipe(name, 12))
    command = ["sharpness", str(tmp_path / "room"), "--folds", "2", "--seeds", "0", "--recipes", "3dgs-accel,3dgs"]
    assert measure_claim([*command, "--focal", "0.02", "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert "3dgs-accel" in printed and "focal length +2.0%" in printed
    result = json.loads((tmp_path / "out" / RESULT).read_text())
    assert (tmp_path / "out" / FIGURE).stat().st_size > 5000
    assert [row["recipe"] for row in result["summary"]] == ["3dgs-accel", "3dgs"] and len(result["runs"]) == 4
    for row in result["summary"]:
        own = [run["held_out"]["psnr"] for run in result["runs"] if run["recipe"] == row["recipe"]]
        assert row["held_out"]["psnr"] == pytest.approx(np.mean(own)) and 10 < np.mean(own) < 40


def test_errors_out_of_range(tmp_path, capsys):
    assert measure_claim(["sharpness", "room", "--degrees", "95", "--out", str(tmp_path / "no")]) == 2
    assert "--degrees is 95" in capsys.readouterr().err and not (tmp_path / "no").exists()
