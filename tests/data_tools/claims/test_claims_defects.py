"""The claim ``defects``: what is planted is what the record says, and the table counts the records."""

import numpy as np
import pytest

from data_tools.claims import defects
from data_tools.claims.__main__ import main as measure_claim
from measured_claims import measured
from minisplat_ref.app.cli import main
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.errors import InputError


@pytest.fixture(scope="module")
def scene():
    return make_scene("room", n_views=9, width=40, height=30, n_points=150, supersampling=1).scene


def test_gains_are_planted(scene):
    disturbed = defects.with_gains(scene, np.random.default_rng(0))
    for view, other in zip(scene.train_views, disturbed.train_views, strict=True):
        ratio = other.image[view.image > 100].mean() / view.image[view.image > 100].mean()
        assert 0.89 < ratio < 1.11 and ratio != 1


def test_cameras_are_turned_by_half_a_pixel(scene):
    disturbed = defects.with_rotated_cameras(scene, np.random.default_rng(0))
    for view, other in zip(scene.train_views, disturbed.train_views, strict=True):
        camera, moved = view.camera, other.camera
        axis = camera.cam_from_world_R.T @ np.array([0.0, 0.0, 1.0])  # what stands in the middle of the image
        x, y, z = moved.cam_from_world_R @ axis
        assert np.hypot(camera.fx * x / z, camera.fy * y / z) == pytest.approx(defects.PIXELS, rel=1e-3)
        np.testing.assert_allclose(moved.center, camera.center, atol=1e-12)


def test_about_half_of_the_photographs_are_halved(scene):
    disturbed = defects.CONDITIONS["sizes"](scene, np.random.default_rng(0))
    sizes = [view.image.shape[:2] for view in disturbed.train_views]
    assert set(sizes) == {(30, 40), (15, 20)} and [view.camera.width for view in disturbed.train_views] == [
        width for _, width in sizes
    ]


def test_command(tmp_path, capsys):
    options = ["--views", "9", "--width", "40", "--height", "30", "--supersampling", "1", "--points", "150"]
    assert main(["synthetic", "room", "--out", str(tmp_path / "room"), *options]) == 0
    command = ["defects", str(tmp_path / "room"), "--trials", "1", "--out", str(tmp_path / "out")]
    result = measured(command)
    assert [run["condition"] for run in result["runs"]] == ["clean", "gains", "poses", "sizes"]
    for run in result["runs"]:
        row = result["summary"][run["condition"]]
        assert row == {"trials": 1, **{what: int(what in run["switched_on"]) for what in defects.COLORS}}
        del run["evidence"]["switch_sky_on"]
        assert all("fitted to" in note for note in run["evidence"].values()) and len(run["evidence"]) == 2
    printed = capsys.readouterr().out
    assert f"after {defects.decision_step(list(defects.COLORS))} iterations" in printed and "| poses " in printed


def test_gains_are_found_by_tracks_before_the_first_iteration(tmp_path, capsys):
    """In photographs of 64 x 48 with a thousand points; a scene without tracks says nothing about them."""
    options = ["--views", "9", "--width", "64", "--height", "48", "--supersampling", "1", "--points", "1000"]
    assert main(["synthetic", "room", "--out", str(tmp_path / "room"), *options]) == 0
    command = ["defects", str(tmp_path / "room"), "--asked", "exposure", "--conditions", "clean,gains", "--trials", "2"]
    result = measured([*command, "--out", str(tmp_path / "out")])
    assert {name: row.get("exposure") for name, row in result["summary"].items() if row["trials"]} == {
        "clean": 0,
        "gains": 2,
    }
    for run in result["runs"]:
        is_planted = run["condition"] == "gains"
        assert run["switched_on"] == ["exposure"] * is_planted and list(run["evidence"]) == ["exposures"] * is_planted
    assert "after 1 iteration of adaptive" in capsys.readouterr().out
    tracked = make_scene("room", n_views=9, width=64, height=48, n_points=1000, supersampling=1).scene
    views = tuple(view._replace(point_ids=None) for view in tracked.train_views)
    found = {}
    for name, each in (("tracks", tracked), ("no tracks", tracked._replace(train_views=views))):
        disturbed = defects.with_gains(each, np.random.default_rng(0))
        found[name] = defects.decide(disturbed, 0, ["exposure"])["switched_on"]
    assert found == {"tracks": ["exposure"], "no tracks": []}


def test_sky_is_planted_above_the_cut():
    """Where something lower than 1.2 m is seen, the photograph stays; elsewhere its colours are those of the sky."""
    truth = make_scene("room", supersampling=1)
    scene = defects.under_a_sky(truth.scene, np.random.default_rng(0))
    assert 0 < len(scene.points) < len(truth.scene.points) and scene.points[:, 2].max() <= defects.CUT
    shown, heights = [], []
    for view, other, depth in zip(truth.scene.test_views, scene.test_views, truth.test_depths, strict=True):
        camera, (v, u) = view.camera, np.indices(depth.shape)
        rays = np.stack(
            [(u + 0.5 - camera.cx) / camera.fx, (v + 0.5 - camera.cy) / camera.fy, np.ones(depth.shape)], -1
        )
        points = (depth[..., None] * rays - camera.cam_from_world_t) @ camera.cam_from_world_R
        is_low = points[..., 2] < defects.CUT - 1e-6
        assert 0.1 < is_low.mean() < 1.0
        np.testing.assert_array_equal(other.image[is_low], view.image[is_low])
        assert (other.image[~is_low] != view.image[~is_low]).any(axis=-1).mean() > 0.9
        up = (rays @ camera.cam_from_world_R)[..., 2] / np.linalg.norm(rays, axis=-1)
        shown.append(other.image[~is_low])
        heights.append(np.sqrt(np.maximum(up[~is_low], 0)))
    gradient = np.column_stack([np.ones(len(np.concatenate(heights))), np.concatenate(heights)])
    colors = np.concatenate(shown).astype(float)
    explained = gradient @ np.linalg.lstsq(gradient, colors, rcond=None)[0]
    assert np.ptp(colors, axis=0).max() > 5 and np.abs(colors - explained).max() <= 1.0  # rounded to bytes


def test_sky_alone_is_asked_of_a_scene_that_is_synthetic(scene, tmp_path, capsys):
    out = tmp_path / "out"
    command = [
        "defects",
        "room",
        "--conditions",
        "clean",
        "--asked",
        "sky",
        "--trials",
        "1",
        "--out",
        str(out),
    ]
    result = measured(command)
    (run,) = result["runs"]
    assert list(run["evidence"]) == ["switch_sky_on"] and result["summary"]["clean"] == {"trials": 1, "sky": 0}
    assert "after 100 iterations" in capsys.readouterr().out
    with pytest.raises(InputError, match="cuts off a synthetic scene"):
        defects.under_a_sky(scene, np.random.default_rng(0))  # of another size than the room that is made by its name
    for option, value in (("--asked", "weather"), ("--conditions", "rain")):
        capsys.readouterr()
        assert measure_claim(["defects", "room", option, value, "--out", str(tmp_path / "none")]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert value in line and "sky" in line and not (tmp_path / "none" / "result.json").exists()
