"""Lenses: peaks along rays by hand, photographs by a fisheye, and small runs of both claims."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.lens import fisheye, footprints
from data_tools.claims.lens.fisheye import rays_of, take_photographs
from measured_claims import measured
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.scenes import SETTINGS
from minisplat_ref.mechanisms.cameras.models import model_of
from minisplat_ref.types import Primitives
from tolerances import CLOSED_FORM


@pytest.fixture(scope="module")
def photographs():
    return take_photographs(32, 0)


def test_peaks_along_rays_by_hand():
    """A ray at an angle a to the middle of a ball at distance 1 is sin a away from it; behind the camera is no peak."""
    ahead, sigma = np.array([0.0, 0.0, 1.0]), 0.1
    angles = np.radians([0.0, 5.0, 60.0, 120.0])
    rays = 3 * np.stack([np.sin(angles), np.zeros(4), np.cos(angles)], axis=1)
    expected = np.exp(-(np.sin(angles) ** 2) / (2 * sigma**2)) * [1, 1, 1, 0]
    assert_allclose(footprints._peaks(ahead, np.eye(3) / sigma**2, rays), expected, rtol=CLOSED_FORM)
    assert_allclose(footprints.turn(90.0) @ ahead, [1, 0, 0], atol=CLOSED_FORM)


@pytest.mark.parametrize(("kind", "edge"), [("pinhole", np.tan(np.radians(70))), ("fisheye", np.radians(100))])
def test_small_balls_are_drawn_by_every_footprint(kind, edge):
    """All kinds are right to first order, also off the axis; the image's edge is where the camera says."""
    assert footprints.camera_of(kind).fx == pytest.approx(200 / edge)
    small = Primitives(np.array([[0.0, 0, 1]]), np.array([[1.0, 0, 0, 0]]), np.full((1, 3), 0.02), np.ones(1))
    assert max(footprints.errors_at(small, 0.0, kind).values()) < 0.002
    off = footprints.errors_at(small, footprints.ANGLES[kind][-1], kind)
    assert off["exact"] < 0.002 and off["bounds"] < 1e-4 and max(off.values()) < 0.07


def test_the_claim_of_footprints(tmp_path):
    """On a small set: EWA and the unscented conic err more off the axis, and the exact response hardly."""
    for errors in measured(["lens/footprints", "--gaussians", "2", "--out", str(tmp_path)])["errors"].values():
        assert errors["EWA"][-1] > errors["EWA"][0] > errors["UT"][0] > 0.02
        assert max(errors["exact"]) < 0.05  # what the bounds leave out
        assert max(errors["bounds"]) < max(errors["exact"])  # the rest is below alpha_min


def test_fisheye_photographs_show_the_points_where_the_camera_says(photographs):
    """A point drawn on a photograph has its colour where the fisheye projects it; 150 degrees span the image."""
    camera = photographs.fisheye.train_views[0].camera
    edges = rays_of(camera, 0.0)[camera.width * (camera.height // 2)]
    assert np.degrees(np.arccos(edges[2])) == pytest.approx(75, abs=0.2)  # half a line above the axis
    scene, errors = photographs.fisheye, []
    for view in scene.train_views[:4]:
        x = scene.points @ view.camera.cam_from_world_R.T + view.camera.cam_from_world_t
        pixels = model_of(view.camera).project(x, view.camera)
        is_inside = ((pixels > 0) & (pixels < (32, 24))).all(axis=1)
        column, line = pixels[is_inside].astype(int).T
        shown = view.image[line, column].astype(float)
        errors.append(np.median(np.abs(shown - scene.point_colors[is_inside])))
    assert is_inside.sum() > 1000 and np.mean(errors) < 25  # half of them are hidden or at edges


def test_a_photograph_by_a_pinhole_is_that_of_the_synthetic_scene():
    scene_rng, camera_rng, _ = np.random.default_rng(0).spawn(3)
    world, path, _ = SETTINGS["room"](scene_rng)
    made = make_scene("room", n_views=8, width=32, height=24, supersampling=fisheye.SUPERSAMPLING)
    expected = {view.camera.center.tobytes(): view.image for view in made.scene.train_views + made.scene.test_views}
    for camera in path.cameras(len(expected), 32, 24, camera_rng)[:2]:
        assert_array_equal(fisheye.photograph(world, camera), expected[camera.center.tobytes()])


def test_what_undistortion_keeps(photographs):
    """The kept pixels are around the axis, and the undistorted photograph shows what the fisheye shows there."""
    kept, angles = photographs.is_kept, photographs.angles
    assert kept[12, 16] and not kept[12, 0] and not kept[0, 0] and 0.3 < kept.mean() < 0.8
    assert angles[kept].max() < angles.max() - 20
    bent, straight = photographs.fisheye.train_views[0], photographs.pinhole.train_views[0]
    lines, columns = np.nonzero(kept & (angles < 30))
    directions = rays_of(bent.camera).reshape(24, 32, 3)[lines, columns]
    pixels = model_of(straight.camera).project(directions, straight.camera).astype(int)
    difference = straight.image[pixels[:, 1], pixels[:, 0]].astype(float) - bent.image[lines, columns]
    assert np.median(np.abs(difference)) < 12


def test_the_claim_of_the_fisheye(tmp_path, capsys):
    """At a tiny size; the arms have equal numbers of Gaussians, and the folder resumes without another training."""
    out = ["lens/fisheye", "--width", "24", "--iterations", "3", "--seeds", "1", "--out", str(tmp_path / "s")]
    result = measured(out)
    assert len(result["records"]) == 3 and len({record["gaussians"] for record in result["records"]}) == 1
    assert len({record["border"] for record in result["records"]}) == 3
    capsys.readouterr()
    assert measure_claim(out) == 0 and "undistortion keeps" in capsys.readouterr().out
    assert json.loads((tmp_path / "s" / "result.json").read_text()) == result
