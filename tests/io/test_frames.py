"""Frames of scenes: which scenes have one, the way there and back, and what is written of it."""

import math

import numpy as np
import pytest

from minisplat_ref.errors import InputWarning
from minisplat_ref.io import load_ply, save_ply
from minisplat_ref.io.frames import (
    Unit,
    choose_frame,
    frame_from_json,
    frame_of_means,
    frame_to_json,
    place_camera,
    place_fields,
    place_points,
    place_population,
    place_scene,
    return_camera,
    return_fields,
    return_population,
)
from minisplat_ref.io.ply_file import read_vertices
from minisplat_ref.training.loop import train
from minisplat_ref.training.representation import WORLD_UNITS
from minisplat_ref.types import FILE_FRAME, Frame, Gaussians
from scenes import make_camera, make_gaussians
from tiny_training import PLAIN, scene  # noqa: F401  (a fixture)
from tolerances import CLOSED_FORM

UTM = Frame((450_000.0, 5_410_000.0, 260.0), 0.25)
LAST_DIGIT = np.spacing(5_410_000.0)  # 9.3e-10, of a coordinate in float64


def camera_at(center, rng):
    camera = make_camera(24, 16, rng=rng)
    return camera._replace(cam_from_world_t=-camera.cam_from_world_R @ np.array(center, float))


@pytest.mark.parametrize(
    ("center", "extent", "frame"),
    [
        ((0, 0, 0), 4.8, FILE_FRAME),
        ((0, 0, 0), 0.5, FILE_FRAME),
        ((0, 299, 0), 3.0, FILE_FRAME),  # less than 100 extents away
        ((0, 0, 0), 0.004, FILE_FRAME._replace(unit=2.0**-10)),  # 0.004 is 4.1 of these units
        ((0, 0, 0), 5e4, FILE_FRAME._replace(unit=2.0**14)),
        ((0, 301.4, 0), 3.0, Frame((0.0, 301.0, 0.0), 1.0)),
        ((0.4501, 0, 0), 0.004, Frame((461 / 1024, 0.0, 0.0), 2.0**-10)),  # to whole units
    ],
)
def test_frame_by_hand(center, extent, frame, rng):
    assert choose_frame([camera_at(center, rng) for _ in range(3)], extent) == frame


def test_frame_of_gaussians_alone():
    means = np.zeros((20, 3), np.float32)
    assert frame_of_means(means) == frame_of_means(means[:0]) == FILE_FRAME
    means[:, 0] = np.linspace(-1, 1, 20)
    assert frame_of_means(means) == frame_of_means(means / 5) == FILE_FRAME
    assert frame_of_means(means / 512).unit == 2.0**-11  # nine tenths are within 0.0018
    assert frame_of_means(means + np.float32(1000)) == Frame((1000.0, 0.0, 0.0), 1.0)._replace(origin=(1000.0,) * 3)


def test_a_camera_sees_the_same_from_everywhere(rng):
    """x_cam is divided by the unit, so pixels stay; also for a matrix that is a rotation to three digits only."""
    camera = make_camera(24, 16, rng=rng)
    camera = camera._replace(cam_from_world_R=camera.cam_from_world_R + 1e-4 * rng.normal(size=(3, 3)))
    points = rng.normal(size=(5, 3)) * 10 + UTM.origin
    before = points @ camera.cam_from_world_R.T + camera.cam_from_world_t
    placed = place_camera(camera, UTM)
    after = place_points(points, UTM) @ placed.cam_from_world_R.T + placed.cam_from_world_t
    np.testing.assert_allclose(UTM.unit * after, before, atol=4 * LAST_DIGIT)
    back = return_camera(placed, UTM)
    np.testing.assert_allclose(back.cam_from_world_t, camera.cam_from_world_t, atol=4 * LAST_DIGIT)
    assert place_camera(camera, FILE_FRAME) is camera and return_camera(camera, FILE_FRAME) is camera


def test_population_there_and_back(rng):
    """Centres in float64 in the files, float32 in the frame: what is lost is float64's last digit in the files."""
    gaussians = Gaussians(*(field.astype(np.float32) for field in make_gaussians(rng, 30)))
    out = return_population(gaussians, WORLD_UNITS, UTM)
    assert out.means.dtype == np.float64 and out.log_scales.dtype == np.float32
    np.testing.assert_array_equal(out.means, np.array(UTM.origin) + 0.25 * gaussians.means.astype(np.float64))
    np.testing.assert_allclose(out.log_scales, gaussians.log_scales + math.log(0.25), rtol=1e-6)
    back = place_population(out, WORLD_UNITS, UTM)
    assert all(field.dtype == np.float32 for field in back)
    np.testing.assert_allclose(back.means, gaussians.means, rtol=0, atol=LAST_DIGIT / UTM.unit)
    np.testing.assert_allclose(back.log_scales, gaussians.log_scales, atol=2e-7 * np.abs(gaussians.log_scales).max())
    for name in ("quats", "opacity_logits", "sh_dc", "sh_rest"):
        np.testing.assert_array_equal(getattr(back, name), getattr(gaussians, name))


def test_lengths_scale_and_other_fields_stay():
    fields = {"speeds": np.array([[8.0, 4.0]]), "counts": np.array([3.0])}
    units = {"speeds": Unit.LENGTH}
    placed = place_fields(fields, units, UTM)
    np.testing.assert_array_equal(placed["speeds"], [[32.0, 16.0]])
    np.testing.assert_array_equal(placed["counts"], [3.0])
    np.testing.assert_array_equal(return_fields(placed, units, UTM)["speeds"], fields["speeds"])


def test_far_centres_are_doubles_in_a_ply(tmp_path, rng):
    gaussians = make_gaussians(rng, 30)
    far = gaussians._replace(means=gaussians.means + np.array(UTM.origin))
    for name, population, dtype in (("near", gaussians, np.float32), ("far", far, np.float64)):
        save_ply(tmp_path / f"{name}.ply", population)
        columns = read_vertices(tmp_path / f"{name}.ply")
        assert columns["y"].dtype == dtype and columns["scale_1"].dtype == np.float32
    np.testing.assert_array_equal(load_ply(tmp_path / "far.ply").means, far.means)


def test_a_scene_is_placed_with_all_that_it_has(scene):
    placed = place_scene(scene, UTM)
    assert placed.frame == UTM and placed.extent == scene.extent / 0.25
    np.testing.assert_allclose(placed.points, (scene.points - UTM.origin) / 0.25, rtol=CLOSED_FORM)
    for view, before in zip(placed.train_views, scene.train_views, strict=True):
        assert view.image is before.image and view.camera.fx == before.camera.fx
        center = np.array(UTM.origin) + 0.25 * view.camera.center
        np.testing.assert_allclose(center, before.camera.center, atol=1e-8)
    assert place_scene(scene) is scene and placed.random_box is None
    boxed = place_scene(scene._replace(random_box=np.array(UTM.origin) + np.array([[-1.3] * 3, [1.3] * 3])), UTM)
    np.testing.assert_allclose(boxed.random_box, [[-5.2] * 3, [5.2] * 3], rtol=1e-6)


def test_training_elsewhere_warns_with_the_figures(scene):
    recipe = PLAIN._replace(iterations=1)
    small = place_scene(scene, Frame((0.0, 0.0, 0.0), 1000.0))._replace(frame=FILE_FRAME)
    with pytest.warns(InputWarning, match=r"0\.001 units large and 0 from the origin.*place_scene"):
        train(small, recipe, seed=0)
    train(place_scene(small), recipe, seed=0)


@pytest.mark.parametrize("frame", [FILE_FRAME, UTM])
def test_json(frame):
    assert frame_from_json(frame_to_json(frame)) == frame


@pytest.mark.parametrize(
    "value",
    [3, [], {}, {"origin": [1, 2], "unit": 1}, {"origin": [1, 2, 3], "unit": 0}, {"origin": [1, 2, 1e999], "unit": 1}],
)
def test_json_that_is_no_frame(value):
    assert frame_from_json(value) is None
    assert frame_from_json(None) == FILE_FRAME
