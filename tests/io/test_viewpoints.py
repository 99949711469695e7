"""Where `render` looks from: camera files by hand and there and back, orbits by their geometry."""

import json

import numpy as np
import pytest

from minisplat_ref.errors import InputError
from minisplat_ref.io.orbits import orbit
from minisplat_ref.io.viewpoints import Viewpoint, read, to_json
from rings import HEIGHT, WIDTH, ring_of_cameras
from scenes import make_camera
from tolerances import CLOSED_FORM, ORBIT_DAMPING


def centre(camera):
    return -camera.cam_from_world_R.T @ camera.cam_from_world_t


def project(point, camera):
    x, y, z = camera.cam_from_world_R @ point + camera.cam_from_world_t
    return np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, z])


def test_camera_file_by_hand(tmp_path):
    """A camera at (1, 2, 3) that looks along world +x: its right is world -z where down is +y."""
    world_from_camera = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    entry = {"img_name": "a", "width": 8, "height": 6, "fx": 9, "fy": 10}
    entry |= {"position": [1, 2, 3], "rotation": world_from_camera}
    (tmp_path / "c.json").write_text(json.dumps([entry, {**entry, "time": 0.25}]))
    (name, camera, split, time), later = read(tmp_path / "c.json")
    assert (time, later.time) == (0.0, 0.25)
    assert (name, split, camera.width, camera.height) == ("a", "", 8, 6)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (9, 10, 4, 3)
    np.testing.assert_array_equal(centre(camera), [1, 2, 3])
    ahead = np.array([1 + 5.0, 2 + 1.0, 3 - 2.0])  # 5 ahead, 1 down, 2 to the right
    np.testing.assert_allclose(project(ahead, camera), [9 * 2 / 5 + 4, 10 * 1 / 5 + 3, 5], rtol=CLOSED_FORM)


def test_camera_file_there_and_back(tmp_path, rng):
    cameras = [make_camera(rng=rng, cx=7.25), make_camera(40, 30, rng=rng)]
    views = [
        Viewpoint(f"v{i}", camera, split)
        for i, (camera, split) in enumerate(zip(cameras, ("train", "test"), strict=True))
    ]
    (tmp_path / "c.json").write_text(json.dumps(to_json(views)))
    for view, again in zip(views, read(tmp_path / "c.json"), strict=True):
        assert (view.name, view.split, view.camera[2:8]) == (again.name, again.split, again.camera[2:8])
        for pose, pose_again in zip(view.camera[:2], again.camera[:2], strict=True):
            np.testing.assert_allclose(pose_again, pose, rtol=0, atol=CLOSED_FORM)


def test_orbit_repeats_a_ring_of_cameras():
    """The orbit of a regular ring is the ring itself, up to its direction; each camera looks at the target."""
    target = np.array([0.5, -0.2, 4.0])
    views = ring_of_cameras(target, radius=2.0, height=0.7)
    frames = orbit(np.zeros((0, 3)), views, len(views), 2 * WIDTH, 2 * HEIGHT)
    assert [frame.name for frame in frames[:2]] == ["orbit_000", "orbit_001"]
    positions = np.array([centre(view.camera) for view in views])
    distances = np.array([np.linalg.norm(centre(frame.camera) - positions, axis=1) for frame in frames])  # [F, V]
    assert distances.min(axis=0).max() < ORBIT_DAMPING  # each camera of the ring is met by a frame
    for frame in frames:
        camera = frame.camera
        assert np.linalg.det(camera.cam_from_world_R) == pytest.approx(1, rel=CLOSED_FORM)
        assert (camera.width, camera.height, camera.fx) == (2 * WIDTH, 2 * HEIGHT, 2 * views[0].camera.fx)
        u, v, z = project(target, camera)
        assert z > 0 and (u, v) == pytest.approx((WIDTH, HEIGHT), abs=camera.fx * ORBIT_DAMPING)
        assert camera.cam_from_world_R[1] @ [0, 1, 0] > 0.5  # down stays down


def test_orbit_has_the_field_of_view_of_the_first_camera():
    views = ring_of_cameras(np.zeros(3), radius=2.0, height=0.7)
    other = views[-1].camera
    views = [*views[:-1], views[-1]._replace(camera=other._replace(fx=2 * other.fx, width=3 * other.width))]
    assert orbit(np.zeros((0, 3)), views, 1, 2 * WIDTH, 2 * HEIGHT)[0].camera.fx == 2 * views[0].camera.fx


def test_orbit_of_a_cloud_shows_nine_tenths_of_it(rng):
    means = np.array([3.0, 1.0, -2.0]) + rng.normal(size=(500, 3))
    for frame in orbit(means, [], 5, WIDTH, HEIGHT):
        u, v, z = np.array([project(mean, frame.camera) for mean in means]).T
        is_inside = (z > 0) & (u > 0) & (u < WIDTH) & (v > 0) & (v < HEIGHT)
        assert 0.85 < is_inside.mean() < 1
        assert frame.camera.cam_from_world_R[1] @ [0, 1, 0] > 0.5


def test_orbit_of_one_point_and_of_none():
    for means in (np.zeros((0, 3)), np.ones((1, 3))):
        (frame,) = orbit(means, [], 1, WIDTH, HEIGHT)
        assert np.isfinite(frame.camera.cam_from_world_R).all() and np.isfinite(frame.camera.cam_from_world_t).all()


@pytest.mark.parametrize("axis", range(3))
def test_a_mirrored_camera_is_refused(axis, tmp_path):
    """A matrix of determinant -1 is orthogonal, and no rotation."""
    mirrored = np.eye(3)
    mirrored[axis, axis] = -1
    entry = {"img_name": "a", "width": 8, "height": 6, "fx": 9, "fy": 10, "position": [0, 0, 0]}
    (tmp_path / "c.json").write_text(json.dumps([{**entry, "rotation": mirrored.tolist()}]))
    with pytest.raises(InputError, match="camera 0: rotation is not a rotation matrix"):
        read(tmp_path / "c.json")
