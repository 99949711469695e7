"""What a viewer shows, without a browser: poses, the size of the next frame, layers, films."""

import math

import numpy as np
import pytest
from PIL import Image

from minisplat_ref.app.reports.images import to_8_bits
from minisplat_ref.app.runs.scoring import Trained
from minisplat_ref.app.viewer import progression
from minisplat_ref.app.viewer.filming import FPS, Film, write_travel
from minisplat_ref.app.viewer.layers import LAYERS, colors_of_ids, find_bins, list_layers, render_layer, tile_loads
from minisplat_ref.app.viewer.photographs import SCALE, camera_scale
from minisplat_ref.app.viewer.poses import Pose, camera_from_pose, choose_start, pose_from_camera, travel
from minisplat_ref.app.viewer.progression import Shown, Wanted, coarse_divisor, fit, next_divisor, reduced
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import load_extension
from minisplat_ref.io.viewpoints import Viewpoint
from minisplat_ref.rendering import SPLATTING, render
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.types import Model, TileBins, TileGrid
from scenes import as_dtype, balls, make_camera, make_gaussians

WIDTH, HEIGHT = 40, 32
AHEAD = Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), math.radians(60.0))
WANTED = Wanted(AHEAD, "colour", 800, 600)


@pytest.fixture(scope="module")
def trained():
    gaussians = as_dtype(make_gaussians(np.random.default_rng(4), 30), np.float32)
    return Trained(Model(gaussians), SPLATTING, np.array([0.1, 0.2, 0.3]), "GSPLAT_MAIN", REFERENCE.name)


# poses


UP = np.array([0.0, -1.0, 0.0])


def test_a_pose_and_its_camera():
    """cos 45 + j sin 45 turns the camera's z to the world's x: seen along x, from x = -2."""
    half = math.sqrt(0.5)
    camera = camera_from_pose(Pose((half, 0.0, half, 0.0), (-2.0, 0.0, 0.0), math.radians(90.0)), 80, 60)
    np.testing.assert_allclose(camera.cam_from_world_R @ [1, 0, 0], [0, 0, 1], atol=1e-12)  # rounding of float64
    np.testing.assert_allclose(camera.center, [-2, 0, 0], atol=1e-12)
    assert (camera.fx, camera.fy) == pytest.approx((30.0, 30.0))  # half the height at 45 degrees
    assert (camera.cx, camera.cy, camera.width, camera.height) == (40.0, 30.0, 80, 60)


def test_there_and_back():
    camera = make_camera(rng=np.random.default_rng(3), fx=28.0)
    again = camera_from_pose(pose_from_camera(camera, 0.25), camera.width, camera.height)
    for name in ("cam_from_world_R", "cam_from_world_t", "fx", "fy"):
        np.testing.assert_allclose(getattr(again, name), getattr(camera, name), atol=1e-12)
    assert pose_from_camera(camera, 0.25).time == 0.25


def test_a_path_reaches_its_keyframes_without_overshoot():
    turned = Pose((math.cos(0.6), 0.0, math.sin(0.6), 0.0), (1.0, 0.0, 0.0), 0.5, 1.0)
    path = travel([AHEAD, turned, turned], 9)
    assert len(path) == 9
    for pose, keyframe in ((path[0], AHEAD), (path[4], turned), (path[8], turned)):
        np.testing.assert_allclose(np.hstack(pose), np.hstack(keyframe), atol=1e-12)
    np.testing.assert_allclose(path[2].wxyz, (math.cos(0.3), 0.0, math.sin(0.3), 0.0), atol=1e-12)
    x = [pose.position[0] for pose in path]
    assert x == sorted(x) and max(x) == pytest.approx(1.0) and 0.4 < x[2] < 0.8
    with pytest.raises(InputError, match="at least two"):
        travel([AHEAD], 9)


def test_where_it_starts():
    """At the first camera, about the point of its axis nearest to where the axes meet; or on render's circle."""
    half = math.sqrt(0.5)
    poses = [Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -4.0), 1.0), Pose((half, 0.0, half, 0.0), (-4.0, 0.0, 0.0), 1.0)]
    cameras = [Viewpoint(f"{k}", camera_from_pose(pose, 8, 6), "train", 0.5) for k, pose in enumerate(poses)]
    start = choose_start(np.zeros((0, 3)), cameras, UP)
    np.testing.assert_allclose(np.hstack(start.pose), np.hstack(poses[0]._replace(time=0.5)), atol=1e-9)
    np.testing.assert_allclose(start.target, [0, 0, 0], atol=0.02)  # the damping of nearest_to_axes
    np.testing.assert_allclose(start.up, [0, -1, 0], atol=1e-9)
    means = np.array([[5.0, 1.0, 2.0]]) + np.random.default_rng(0).normal(size=(40, 3))
    start, middle = choose_start(means, [], UP), np.median(means, axis=0)
    np.testing.assert_allclose(start.target, middle, atol=1e-9)
    np.testing.assert_allclose(start.up, [0, -1, 0])
    assert np.isfinite(np.hstack(choose_start(means[:0], [], UP).pose)).all()


def test_how_large_cameras_are_shown():
    """Two cameras 4 apart lie 2 from their mean; one lies at it."""
    cameras = [
        Viewpoint("", camera_from_pose(AHEAD._replace(position=(x, 0.0, 0.0)), 8, 6), "", 0.0) for x in (0.0, 4.0)
    ]
    assert camera_scale(cameras) == pytest.approx(2 * SCALE)
    assert camera_scale(cameras[:1]) == SCALE


# the size of the next frame


def test_sizes():
    assert fit(1600, 1200, 800) == (800, 600) and fit(640, 480, 800) == (640, 480) and fit(0, 0, 800) == (16, 16)
    assert reduced(800, 600, 4) == (200, 150) and reduced(40, 30, 16) == (16, 16)


def test_the_coarse_frame_takes_its_time_at_most():
    """480,000 pixels of 1 us each are 0.48 s: a quarter of them are 0.12 s, too long, and a sixteenth 0.03 s."""
    assert coarse_divisor(WANTED, 1e-6) == 4
    assert coarse_divisor(WANTED, progression.COARSE_SECONDS / 480_000) == 1
    assert coarse_divisor(WANTED, 1.0) == 16
    assert coarse_divisor(WANTED, None) == progression.FIRST_DIVISOR


def test_from_coarse_to_full():
    moved = WANTED._replace(pose=AHEAD._replace(position=(0.0, 0.0, 1.0)))
    assert next_divisor(WANTED, 0, Shown(), 0.0, 1e-5) == 8
    shown = Shown(WANTED, 8, 0)
    assert next_divisor(WANTED, 0, shown, 0.1, 1e-5) is None, "the camera may move on"
    assert next_divisor(WANTED, 0, shown, 0.3, 1e-5) == 2
    assert next_divisor(WANTED, 0, shown._replace(divisor=2), 0.3, 1e-5) == 1
    full = shown._replace(divisor=1)
    assert next_divisor(WANTED, 0, full, 9.0, 1e-5) is None
    assert next_divisor(moved, 0, full, 0.0, 1e-5) == 8
    assert next_divisor(WANTED._replace(layer="depth"), 0, full, 0.0, 1e-5) == 8
    assert next_divisor(WANTED, 1, full, 9.0, 1e-5) == 1, "another model of what is looked at is not blurred"
    assert next_divisor(moved, 1, full, 9.0, 1e-5) == 8


# layers


def test_colours_are_those_of_the_renderer(trained):
    camera = camera_from_pose(AHEAD, WIDTH, HEIGHT)
    output, _ = render(trained.model.gaussians, camera, background=trained.background, backend=REFERENCE)
    np.testing.assert_array_equal(render_layer(trained, camera, "colour").image, to_8_bits(output.image))


@pytest.mark.parametrize("layer", LAYERS)
def test_layers_of_one_opaque_ball(layer):
    """A ball in the middle of the left half, at depth 2, of which the right half sees nothing."""
    population = as_dtype(balls([[-0.6, 0.0, 2.0]], [0.2], [0.98]), np.float32)
    surfels = load_extension("surfels").representation
    renderer = surfels.renderer if layer == "normals" else SPLATTING
    trained = Trained(Model(population), renderer, np.zeros(3), "GSPLAT_MAIN", REFERENCE.name)
    picture = render_layer(trained, camera_from_pose(AHEAD, WIDTH, HEIGHT), layer)
    ball, empty = picture.image[HEIGHT // 2, 12].astype(int), picture.image[HEIGHT // 2, WIDTH - 1].astype(int)
    assert picture.image.shape == (HEIGHT, WIDTH, 3) and picture.image.dtype == np.uint8
    assert bool(picture.caption) == (layer != "colour")
    if layer == "transmittance":
        assert ball.sum() < empty.sum() and empty.min() > 180
    elif layer == "normals":  # its discs lie along z; towards the camera, -z
        np.testing.assert_allclose(ball, [128, 128, 0], atol=1)
        assert not empty.any()
    elif layer == "tile load":  # tiles of 16 pixels: the ball's lists one, the last none
        assert ball.sum() > 600 and empty.sum() < 10 and "0 to 1" in picture.caption
    else:
        assert ball.sum() > 100 and empty.sum() < 10
    words = {"depth": "2 to 2", "dominant Gaussian": "1 Gaussians"}
    assert words.get(layer, "") in picture.caption


def test_a_layer_that_the_renderer_lacks(trained):
    assert list_layers(SPLATTING) == [name for name in LAYERS if name != "normals"]
    assert "normals" in list_layers(load_extension("surfels").representation.renderer)

    def without(model, view, request):
        return SPLATTING.render(model, view, request)[0]._replace(stats=None), ()

    bare = trained._replace(renderer=SPLATTING._replace(name="bare", render=without))
    for layer in ("importance", "dominant Gaussian", "tile load"):
        with pytest.raises(InputError, match=r"renderer bare .* choose another layer"):
            render_layer(bare, camera_from_pose(AHEAD, 16, 16), layer)


def test_tile_loads_by_hand():
    """Two rows of three tiles of 2 x 2 pixels, of which the last reach beyond an image of 5 x 3."""
    bins = TileBins(np.arange(8), np.array([0, 1, 1, 5, 7, 8, 8]), np.arange(8), np.arange(9), TileGrid(5, 3, 2, 2))
    np.testing.assert_array_equal(tile_loads(bins), [[1, 1, 0, 0, 4]] * 2 + [[2, 2, 1, 1, 0]])
    assert find_bins((1, (np.zeros(3), bins))) is bins and find_bins((1, [bins])) is None


def test_colours_of_indices():
    ids = np.arange(-1, 1000).reshape(1, -1)
    colors = colors_of_ids(ids)[0]
    assert not colors[0].any() and len(np.unique(colors[1:], axis=0)) == 1000
    steps = np.abs(np.diff(colors.astype(int), axis=0)).sum(axis=1)
    assert np.quantile(steps, 0.05) > 60, "neighbours are told apart"


# films


def test_a_film(trained, tmp_path):
    said, film = [], Film(tmp_path / "view.gif", 5 / FPS, 24, 16, "depth")
    keyframes = [AHEAD, AHEAD._replace(position=(0.2, 0.0, 0.0))]
    assert write_travel(trained, keyframes, film, lambda *done: said.append(done)) == 5
    assert said == [(k, 5) for k in range(1, 6)]
    with Image.open(film.path) as image:
        assert (image.size, image.n_frames) == ((24, 16), 5)
        assert np.ptp(np.asarray(image.convert("RGB")), axis=2).max() > 100, "depths have colours, alpha has none"
    with pytest.raises(InputError, match=r"\.gif or \.mp4"):
        write_travel(trained, keyframes, film._replace(path=tmp_path / "view.avi"), lambda *_: None)
    with pytest.raises(InputError, match="at least two"):
        write_travel(trained, keyframes[:1], film, lambda *_: None)
    assert [path.name for path in tmp_path.iterdir()] == ["view.gif"]
