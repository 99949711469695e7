"""Paths around a scene: where photographs were taken, and not where none were; films of them."""

import math

import numpy as np
import pytest
from PIL import Image

from minisplat_ref.app.film import check_film, write_film
from minisplat_ref.errors import InputError
from minisplat_ref.io.images import write_image
from minisplat_ref.io.orbits import orbit
from minisplat_ref.io.viewpoints import Viewpoint
from rings import HEIGHT, WIDTH, ring_of_cameras
from scenes import make_camera
from tolerances import CLOSED_FORM, ORBIT_DAMPING

TARGET = np.array([0.5, -0.2, 4.0])
NOTHING = np.zeros((0, 3))


def angles_of(frames):
    """Angles of the cameras about the vertical axis through the target, degrees."""
    offsets = np.array([frame.camera.center for frame in frames]) - TARGET
    return np.degrees(np.arctan2(offsets[:, 2], offsets[:, 0]))


def test_what_was_not_photographed_is_left_out():
    views = ring_of_cameras(TARGET, radius=2.0, height=0.7, n=36)[:12]  # 0 to 110 degrees
    frames = orbit(NOTHING, views, 40, WIDTH, HEIGHT)
    angles = angles_of(frames)
    assert angles.min() == pytest.approx(0, abs=0.5) and angles.max() == pytest.approx(110, abs=0.5)
    np.testing.assert_allclose(angles[1:20], angles[:20:-1], rtol=0, atol=1e3 * CLOSED_FORM)  # there and back
    assert np.abs(np.diff(angles, append=angles[0])).max() < 110 * math.pi / 2 / 20 + 1e-6  # no jump, not at the end
    assert [frames[0].time, frames[20].time] == [0, 0.5]


def test_a_gap_of_less_than_a_quarter_is_crossed():
    views = ring_of_cameras(TARGET, radius=2.0, height=0.7, n=36)
    crossed = angles_of(orbit(NOTHING, views[:29], 60, WIDTH, HEIGHT))  # a gap of 80 degrees
    left_out = angles_of(orbit(NOTHING, views[:27], 60, WIDTH, HEIGHT))  # one of 100
    assert (np.abs(crossed % 360 - 320) < 30).any() and not (np.abs(left_out % 360 - 310) < 40).any()


def test_an_arc_lies_about_the_middle_of_what_was_photographed():
    views = ring_of_cameras(TARGET, radius=2.0, height=0.7, n=36)[:12]
    angles = angles_of(orbit(NOTHING, views, 40, WIDTH, HEIGHT, math.radians(30)))
    assert (angles.min(), angles.max()) == pytest.approx((40, 70), abs=1)
    all_around = angles_of(orbit(NOTHING, views, 36, WIDTH, HEIGHT, 2 * math.pi))
    np.testing.assert_allclose(np.sort(all_around % 360), np.arange(0, 360, 10), rtol=0, atol=1)


def test_radius_and_height_follow_the_cameras():
    """Two half rings of different radius and height: far from where they meet, the path is on each."""
    near = ring_of_cameras(TARGET, radius=2.0, height=0.4, n=72)[:36]
    far = ring_of_cameras(TARGET, radius=3.0, height=1.2, n=72)[36:]
    frames = orbit(NOTHING, [*near, *far], 36, WIDTH, HEIGHT)
    offsets = np.array([frame.camera.center for frame in frames]) - TARGET
    radii, angles = np.hypot(offsets[:, 0], offsets[:, 2]), angles_of(frames)
    for middle, radius, height in ((90, 2.0, 0.4), (-90, 3.0, 1.2)):
        (frame,) = np.flatnonzero(np.abs(angles - middle) < 4)
        assert radii[frame] == pytest.approx(radius, abs=10 * ORBIT_DAMPING)
        assert -offsets[frame, 1] == pytest.approx(height, abs=10 * ORBIT_DAMPING)


def test_cameras_that_look_outwards_are_followed_outwards():
    outwards = []
    for view in ring_of_cameras(np.zeros(3), radius=2.0, height=0.0):
        R = np.diag([-1.0, 1.0, -1.0]) @ view.camera.cam_from_world_R  # turned about its own vertical
        outwards.append(
            view._replace(camera=view.camera._replace(cam_from_world_R=R, cam_from_world_t=-R @ view.camera.center))
        )
    for frame in orbit(NOTHING, outwards, 16, WIDTH, HEIGHT):
        outside = frame.camera.center / np.linalg.norm(frame.camera.center)
        assert frame.camera.cam_from_world_R[2] @ outside == pytest.approx(1, abs=1e-6)


def test_cameras_side_by_side():
    """Parallel optical axes meet nowhere: the path stays among the cameras and looks where they do."""
    camera = make_camera(WIDTH, HEIGHT)._replace(cam_from_world_R=np.eye(3))
    views = [
        Viewpoint(f"{x}", camera._replace(cam_from_world_t=np.array([-x, 0.0, 0.0])), "train")
        for x in np.linspace(-1, 1, 9)
    ]
    for frame in orbit(NOTHING, views, 20, WIDTH, HEIGHT):
        assert np.abs(frame.camera.center).max() < 1.05
        assert frame.camera.cam_from_world_R[2, 2] > 0.75


# films


def street(n, seed=0, turn=0.0):
    """Cameras of a walk of n steps of about 1.5 along z, at eye level, which sways and looks ahead.

    After half of it the street turns by so many degrees.
    """
    rng = np.random.default_rng(seed)
    views, position, heading = [], np.zeros(3), 0.0
    for k in range(n):
        heading = math.radians(turn) if k >= n // 2 else 0.0
        position = position + rng.uniform(1.2, 1.8) * np.array([math.sin(heading), 0.0, math.cos(heading)])
        x, yaw = position + rng.normal(0, 0.1, 3), heading + rng.normal(0, 0.05)
        rotation = np.array(
            [[math.cos(yaw), 0.0, -math.sin(yaw)], [0.0, 1.0, 0.0], [math.sin(yaw), 0.0, math.cos(yaw)]]
        )
        camera = make_camera(width=WIDTH, height=HEIGHT)._replace(
            cam_from_world_R=rotation, cam_from_world_t=-rotation @ x
        )
        views.append(Viewpoint(f"{k:03d}", camera, "train"))
    return views


def distances_to(frames, views):
    """Distance of each frame to the nearest segment between photographs that follow each other."""
    centres = np.array([view.camera.center for view in views])
    a, d = centres[:-1], np.diff(centres, axis=0)
    points = np.array([frame.camera.center for frame in frames])[:, None]
    t = np.clip(((points - a) * d).sum(axis=2) / (d**2).sum(axis=1), 0, 1)
    return np.linalg.norm(points - a - t[:, :, None] * d, axis=2).min(axis=1)


@pytest.mark.parametrize("turn", [0.0, 90.0])
def test_a_walk_stays_in_its_street(turn):
    views = street(25, turn=turn)
    frames = orbit(NOTHING, views, 60, WIDTH, HEIGHT)
    assert distances_to(frames, views).max() < 0.3, "swaying is 0.1, a step 1.5"
    np.testing.assert_allclose(frames[0].camera.center, views[0].camera.center, rtol=0, atol=CLOSED_FORM)
    np.testing.assert_allclose(frames[30].camera.center, views[-1].camera.center, rtol=0, atol=CLOSED_FORM)
    ahead = np.array([frame.camera.cam_from_world_R[2] for frame in frames])
    assert (ahead[:10, 2] > 0.95).all() and np.abs(ahead[:, 1]).max() < 0.2, "it looks where the walker looked"
    steps = np.linalg.norm(np.diff([frame.camera.center for frame in frames], axis=0), axis=1)
    assert steps.max() < 1.5 * math.pi / 2 * steps.mean(), "no jump"


def test_only_a_walk_is_walked():
    """Cameras around a scene, beside a wall, and in no order, are followed on a circle as before; so is an arc."""
    ring = ring_of_cameras(TARGET, radius=2.0, height=0.7, n=36)
    wall = [view._replace(camera=sideways(view.camera)) for view in street(25)]
    shuffled = [street(25)[k] for k in np.random.default_rng(1).permutation(25)]
    for views in (ring, wall, shuffled):
        assert orbit(NOTHING, views, 8, WIDTH, HEIGHT)[4].camera.center != pytest.approx(views[-1].camera.center)
    views = street(25)
    assert distances_to(orbit(NOTHING, views, 60, WIDTH, HEIGHT, math.radians(90)), views).max() > 1


def sideways(camera):
    """The camera, turned by 90 degrees about its vertical axis in its place."""
    rotation = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]) @ camera.cam_from_world_R
    return camera._replace(cam_from_world_R=rotation, cam_from_world_t=-rotation @ camera.center)


@pytest.fixture
def images(tmp_path):
    paths = [tmp_path / f"{k}.png" for k in range(3)]
    for k, path in enumerate(paths):
        write_image(path, np.full((7, 9, 3), 60 * k, np.uint8))
    return paths


def test_gif_holds_the_images(tmp_path, images):
    write_film(tmp_path / "a.gif", images, fps=20)
    with Image.open(tmp_path / "a.gif") as film:
        assert (film.n_frames, film.size, film.info["duration"], film.info["loop"]) == (3, (9, 7), 50, 0)
        for k in range(3):
            film.seek(k)
            np.testing.assert_array_equal(np.asarray(film.convert("RGB")), np.full((7, 9, 3), 60 * k))


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # imageio-ffmpeg leaves pipes open
def test_mp4_holds_the_images(tmp_path, images):
    imageio = pytest.importorskip("imageio.v2", reason="needs imageio, of the extra [video]")
    pytest.importorskip("imageio_ffmpeg", reason="needs ffmpeg, of the extra [video]")
    write_film(tmp_path / "a.mp4", images, fps=20)
    with imageio.get_reader(tmp_path / "a.mp4") as reader:
        frames = list(reader.iter_data())
    assert [frame.shape for frame in frames] == 3 * [(6, 8, 3)]
    assert [round(float(frame.mean()) / 60) for frame in frames] == [0, 1, 2]


def test_films_that_cannot_be(tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"a\.avi: a film is \.gif or \.mp4; give one"):
        check_film(tmp_path / "a.avi", [(4, 4)])
    with pytest.raises(InputError, match="does not exist; create it first"):
        check_film(tmp_path / "missing" / "a.gif", [(4, 4)])
    with pytest.raises(InputError, match="these are 4 x 3 and 4 x 6: give --cameras orbit"):
        check_film(tmp_path / "a.gif", [(4, 6), (4, 3)])
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    with pytest.raises(InputError, match=r"pip install 'minisplat_ref\[video\]', or give a \.gif"):
        check_film(tmp_path / "a.mp4", [(4, 4)])
