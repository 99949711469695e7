"""What is up: from EXIF, from photographs held alike, from the ground, from edges of images, or from a person."""

import itertools
import json
import math

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.errors import InputError
from minisplat_ref.io.orbits import orbit
from minisplat_ref.io.upright import (
    FILE,
    Up,
    find_up,
    given_up,
    quarter_turns,
    read_up,
    turn_upright,
    up_to_json,
    upright_rotation,
)
from rings import HEIGHT, WIDTH, ring_of_cameras
from scenes import make_camera
from tolerances import CLOSED_FORM

TARGET = np.array([0.5, -0.2, 4.0])
UP = np.array([0.0, -1.0, 0.0])
DEGREES = np.cos(np.radians(3.0))  # of what is found, where nothing is exact
NO_POINTS = np.zeros((0, 3))


def held(camera, quarters):
    """The camera turned counter-clockwise about its axis by quarters of a circle: after one, its right side is up."""
    x, y, z = camera.cam_from_world_R
    for _ in range(quarters):
        x, y = -y, x
    R = np.stack([x, y, z])
    return camera._replace(cam_from_world_R=R, cam_from_world_t=-R @ camera.center)


def ring(quarters=(0,), height=1.0, n=12):
    views = ring_of_cameras(TARGET, radius=2.0, height=height, n=n)
    return [held(view.camera, quarters[k % len(quarters)]) for k, view in enumerate(views)]


def ground(rng, n=400):
    """Points on a table below the target, and fewer of a thing on it."""
    table = TARGET + np.stack([rng.uniform(-2, 2, n), np.full(n, 0.5), rng.uniform(-2, 2, n)], axis=1)
    return np.concatenate([table, TARGET + rng.uniform(-0.4, 0.4, (n // 2, 3))])


def test_photographs_held_alike():
    up = find_up(ring(), NO_POINTS)
    assert_allclose(up.direction, UP, atol=CLOSED_FORM) and "held alike" in up.source
    tilted = find_up(ring()[:4], NO_POINTS)  # an arc that looks down leans the mean, not the edges
    assert tilted.direction @ UP > DEGREES


@pytest.mark.parametrize("quarters", [(0, 1), (0, 3, 3), (0, 1, 2, 3), (1, 1, 0)])
def test_the_ground_says_what_is_up_where_photographs_were_turned(rng, quarters):
    up = find_up(ring(quarters), ground(rng))
    assert up.direction @ UP > DEGREES and "ground" in up.source


def test_the_ground_is_below_the_cameras_and_nothing_is_below_it(rng):
    """A ceiling, and a plane in the middle of everything, are no ground."""
    turned = ring((0, 1, 3), height=0.3)
    ceiling = ground(rng) * [1, -1, 1] + [0, 2 * TARGET[1] - 2.0, 0]
    below = TARGET + rng.uniform([-2, 0.6, -2], [2, 3, 2], (300, 3))
    for points in (ceiling, np.concatenate([ground(rng), below])):
        assert "edges" in find_up(turned, points).source


def wall_and_cameras(rng, quarters):
    """Cameras along a wall, which they look at."""
    camera = make_camera(WIDTH, HEIGHT)
    walls = np.stack([rng.uniform(-4, 4, 400), rng.uniform(-2, 2, 400), np.full(400, 5.0)], axis=1)
    cameras = []
    for k, x in enumerate(np.linspace(-3, 3, 9)):
        yaw = 0.3 * math.sin(2.0 * k)
        R = np.array([[math.cos(yaw), 0, -math.sin(yaw)], [0, 1, 0], [math.sin(yaw), 0, math.cos(yaw)]])
        straight = camera._replace(cam_from_world_R=R, cam_from_world_t=-R @ np.array([x, 0.1 * k, 0.0]))
        cameras.append(held(straight, quarters[k % len(quarters)]))
    return cameras, walls


@pytest.mark.parametrize("quarters", [(0, 0, 1), (0, 3, 0)])
def test_a_wall_is_no_ground(rng, quarters):
    up = find_up(*wall_and_cameras(rng, quarters))
    assert up.direction @ UP > DEGREES and "edges" in up.source


def test_without_points_the_edges_of_turned_photographs():
    up = find_up(ring((0, 0, 1, 3)), NO_POINTS)
    assert up.direction @ UP > DEGREES and "edges" in up.source


def test_a_sensor_is_trusted_before_all_else(rng):
    """Two photographs of which it is known outweigh ten that were all turned, and the ground."""
    cameras = ring((1,))
    level = np.zeros(12, bool)
    level[[0, 3]] = True
    upright = [held(camera, 3) if is_level else camera for camera, is_level in zip(cameras, level, strict=True)]
    up = find_up(upright, ground(rng), level)
    assert up.direction @ UP > DEGREES
    assert up.source == "EXIF orientation of 2 photographs"
    assert "EXIF" not in find_up(upright, ground(rng), level & False).source


def test_one_camera():
    assert np.linalg.norm(find_up(ring()[:1], NO_POINTS).direction) == pytest.approx(1)


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_a_photograph_is_turned_upright_by_quarters(quarters):
    """The same point appears at the pixel that the turned image shows there."""
    straight = ring()[2]._replace(fx=20.0, fy=25.0, cx=11.0, cy=8.0)
    camera = held(straight, quarters)._replace(
        **({"width": 18, "height": 24, "fx": 25.0, "fy": 20.0} if quarters % 2 else {})
    )
    assert quarter_turns(camera.cam_from_world_R[None], UP)[0] == quarters
    turned = turn_upright(camera, UP)
    assert_allclose(turned.cam_from_world_R, straight.cam_from_world_R, atol=CLOSED_FORM)
    assert_allclose(turned.center, camera.center, atol=CLOSED_FORM)
    assert (turned.width, turned.height, turned.fx, turned.fy) == (WIDTH, HEIGHT, 20.0, 25.0)
    point = TARGET + np.array([0.1, 0.2, -0.3])
    (x, y), (u, v) = project(camera, point), project(turned, point)
    width, height = camera.width, camera.height
    expected = [(x, y), (y, width - x), (width - x, height - y), (height - y, x)][quarters]
    assert_allclose((u, v), expected, atol=CLOSED_FORM)


def project(camera, point):
    x, y, z = camera.cam_from_world_R @ point + camera.cam_from_world_t
    return camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy


def test_the_rotation_that_makes_a_scene_upright(rng):
    assert_array_equal(upright_rotation(UP), np.eye(3))
    for up in (*np.eye(3), *-np.eye(3), *rng.normal(size=(5, 3))):
        up = up / np.linalg.norm(up)
        R = upright_rotation(up)
        assert_allclose(R @ up, UP, atol=CLOSED_FORM)
        assert_allclose(R @ R.T, np.eye(3), atol=CLOSED_FORM) and np.linalg.det(R) > 0


# As a person says it


def test_what_a_person_says():
    names = [f"{k:04d}.jpg" for k in range(12)]
    cameras = ring((0, 1))
    assert_allclose(given_up("0, 0,-2", names, cameras).direction, [0, 0, -1])
    for text in ("0002.jpg", "0002", "0002:top", "0001:right", "0003.jpg:right"):
        up = given_up(text, names, cameras)
        assert up.direction @ UP > DEGREES and up.source == f"--up {text}"
    assert given_up("0002:bottom", names, cameras).direction @ UP < -DEGREES


@pytest.mark.parametrize("text", ["up", "0,0,0", "1,2", "0,nan,1", "0002:inside", "a,b,c", "7777.jpg"])
def test_nonsense_is_refused(text):
    with pytest.raises(InputError, match="--up"):
        given_up(text, [f"{k:04d}.jpg" for k in range(12)], ring())


def test_it_is_recorded_in_the_scene(tmp_path):
    assert read_up(tmp_path) is None
    (tmp_path / FILE).write_text(json.dumps(up_to_json(Up(np.array([0.0, 0.6, 0.8]), "the ground"))))
    up = read_up(tmp_path)
    assert_allclose(up.direction, [0, 0.6, 0.8])
    assert up.source == "the ground"
    for content in ("[]", '{"up": [0, 0]}', '{"up": [0, 0, 0]}', '{"up": "y"}', "{"):
        (tmp_path / FILE).write_text(content)
        with pytest.raises(InputError, match=FILE):
            read_up(tmp_path)


# What shows it


def test_a_path_around_turned_photographs_is_upright_and_begins_at_one(rng):
    views = ring_of_cameras(TARGET, radius=2.0, height=0.7, n=36)[:12]
    radii = iter(np.linspace(0.8, 1.3, 12))
    moved = []
    for k, view in enumerate(views):
        center = TARGET + next(radii) * (view.camera.center - TARGET)
        camera = view.camera._replace(cam_from_world_t=-view.camera.cam_from_world_R @ center)
        moved.append(view._replace(camera=held(camera, k % 2)))
    frames = orbit(ground(rng), moved, 40, WIDTH, HEIGHT)
    nearest = min(np.linalg.norm(frames[0].camera.center - view.camera.center) for view in moved)
    assert nearest < CLOSED_FORM, "a photograph is seen as it was taken"
    first = next(v for v in moved if np.linalg.norm(v.camera.center - frames[0].camera.center) < CLOSED_FORM)
    assert_allclose(frames[0].camera.cam_from_world_R[2], first.camera.cam_from_world_R[2], atol=CLOSED_FORM)
    for frame in frames:
        right, down, _ = frame.camera.cam_from_world_R
        assert abs(right @ UP) < math.sin(math.radians(3)) and down @ UP < 0
    steps = [np.linalg.norm(a.camera.center - b.camera.center) for a, b in itertools.pairwise(frames)]
    assert max(steps) < 0.5, "there is no jump after it"
    other = orbit(ground(rng), moved, 4, WIDTH, HEIGHT, up=np.array([0.0, 0.0, 1.0]))
    assert all(abs(frame.camera.cam_from_world_R[0, 2]) < CLOSED_FORM for frame in other)
