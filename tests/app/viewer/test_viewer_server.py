"""The server of a viewer: a browser's camera comes in and frames go out; what cannot be served is refused in a line."""

import contextlib
import socket
import sys
import time
import warnings
from types import SimpleNamespace

import numpy as np
import pytest

from browser import WEBGL, Browser, find_browser
from minisplat_ref.app.cli import main
from minisplat_ref.app.runs.scoring import Trained
from minisplat_ref.app.viewer import browser as browser_module
from minisplat_ref.app.viewer import live
from minisplat_ref.app.viewer.browser import HOST, Content, Viewer, address, open_server
from minisplat_ref.app.viewer.layers import render_layer
from minisplat_ref.app.viewer.poses import Pose, camera_from_pose, pose_from_camera
from minisplat_ref.app.viewer.progression import Wanted
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.errors import InputError
from minisplat_ref.io import read_image, save_ply
from minisplat_ref.io.viewpoints import Viewpoint
from minisplat_ref.rendering import SPLATTING
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.types import Model
from run_commands import OPTIONS, SCENE, contents, refused, write_room  # noqa: F401  (a fixture)
from scenes import as_dtype, balls

SECONDS = 30.0  # until a frame must have come
AHEAD = Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0)
SIZE = (64, 48)
JPEG_ERROR = 4.0  # of 255, mean: what the quality of 90 costs on these images


@pytest.fixture
def server():
    pytest.importorskip("viser", reason="needs viser: pip install 'minisplat_ref[viewer]'")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of other packages, when they are loaded
        server = open_server(0, "a test")
    yield server
    server.stop()


def trained(x=0.0, color=(0.9, 0.3, 0.1)):
    population = as_dtype(balls([[x, 0.0, 2.0]], [0.3], [0.95], [color]), np.float32)
    return Trained(Model(population), SPLATTING, np.array([0.0, 0.0, 0.4]), "GSPLAT_MAIN", REFERENCE.name)


def content(**changes):
    cameras = [Viewpoint("0001", camera_from_pose(AHEAD, *SIZE), "train", 0.0)]
    whole = Content(
        trained(), cameras, lambda: {"0001": np.full((12, 16, 3), 200, np.uint8)}, None, np.array([0.0, -1.0, 0.0])
    )
    return whole._replace(**changes)


@contextlib.contextmanager
def connected(server):
    from viser_client import Client

    with Client(server.get_port()) as client:
        client.look(AHEAD.wxyz, AHEAD.position, AHEAD.fov, SIZE)
        yield client


def until(viewer, client, is_done):
    """Draw and receive until something is so; return all messages."""
    messages, end = [], time.perf_counter() + SECONDS
    while not is_done(messages):
        assert time.perf_counter() < end, "it did not come"
        viewer.render_next()
        messages += client.receive()
    return messages


def full(client):
    """Return whether the newest image is a full frame."""
    return lambda _: bool(client.images) and client.images[-1].shape == (SIZE[1], SIZE[0], 3)


def close_to(image, expected):
    return np.abs(image.astype(float) - expected).mean() < JPEG_ERROR


def said(messages, word):
    return any(word in str(message.get("updates", {}).get("_markdown", message)) for message in messages)


def test_a_frame_comes_coarse_then_full_and_follows_the_camera(server):
    viewer = Viewer(server, content())
    with connected(server) as client:
        until(viewer, client, full(client))
        assert client.images[0].shape == (16, 16, 3), "coarse at first"
        assert close_to(client.images[-1], render_layer(trained(), camera_from_pose(AHEAD, *SIZE), "colour").image)

        aside = AHEAD._replace(position=(0.4, 0.0, 0.0))
        client.look(aside.wxyz, aside.position, aside.fov, SIZE)
        expected = render_layer(trained(), camera_from_pose(aside, *SIZE), "colour").image
        until(viewer, client, lambda _: full(client)(_) and close_to(client.images[-1], expected))

        viewer.show(trained(color=(0.1, 0.8, 0.2)))
        expected = render_layer(trained(color=(0.1, 0.8, 0.2)), camera_from_pose(aside, *SIZE), "colour").image
        until(viewer, client, lambda _: full(client)(_) and close_to(client.images[-1], expected))
        assert not viewer.render_next(), "nothing has changed since"


def test_layers_and_cameras_are_chosen_in_the_panel(server):
    viewer = Viewer(server, content())
    with connected(server) as client:
        until(viewer, client, full(client))
        client.change("layer", "alpha")
        expected = render_layer(trained(), camera_from_pose(AHEAD, *SIZE), "alpha").image
        until(viewer, client, lambda _: full(client)(_) and close_to(client.images[-1], expected))
        client.change("cameras", True)
        messages = until(viewer, client, lambda m: any(x["type"] == "CameraFrustumMessage" for x in m))
        (shown,) = [message for message in messages if message["type"] == "CameraFrustumMessage"]
        assert shown["props"]["fov"] == pytest.approx(AHEAD.fov) and shown["props"]["_image_data"]


def test_cameras_are_hidden_again_and_a_click_goes_there(server, monkeypatch):
    handles, clicks = [], []

    def frustum(name, fov, aspect, **drawn):
        handles.append(SimpleNamespace(visible=None, aspect=aspect, on_click=clicks.append, **drawn))
        return handles[-1]

    monkeypatch.setattr(server.scene, "add_camera_frustum", frustum)
    aside = AHEAD._replace(position=(0.4, 0.0, 0.0), fov=0.7)
    wide = camera_from_pose(aside, *SIZE)._replace(fy=2 * camera_from_pose(aside, *SIZE).fx)
    viewer = Viewer(server, content(cameras=[Viewpoint("0001", wide, "train", 0.0)]))
    for is_shown in (True, False, True):
        viewer._show_cameras(is_shown)
        assert [handle.visible for handle in handles] == [is_shown]
    assert handles[0].aspect == pytest.approx(2 * 4 / 3) and handles[0].image.shape == (12, 16, 3)
    there = SimpleNamespace(wxyz=None, position=None, fov=None)
    clicks[0](SimpleNamespace(client=SimpleNamespace(camera=there, atomic=contextlib.nullcontext)))
    expected = pose_from_camera(wide, 0.0)
    assert (there.wxyz, there.position, there.fov) == (expected.wxyz, expected.position, expected.fov)
    assert there.position == pytest.approx((0.4, 0, 0))


def test_a_window_remembers_since_when_it_wants_something(monkeypatch):
    now = iter([5.0, 9.0])
    monkeypatch.setattr(browser_module.time, "perf_counter", lambda: next(now))
    window, wanted = browser_module._Window(), Wanted(AHEAD, "colour", *SIZE)
    window.want(wanted)
    window.want(wanted)
    assert window.since == 5
    window.want(wanted._replace(layer="depth"))
    assert window.since == 9


def test_the_clock_of_a_training_stands_still_while_a_frame_is_drawn(monkeypatch):
    """All that the viewer does, its making included, is done while the progress is paused."""
    is_paused, done = [False], []

    @contextlib.contextmanager
    def paused():
        is_paused[0] = True
        yield
        is_paused[0] = False

    class Watched:
        def __init__(self, server, content):
            done.append(is_paused[0])

        def __getattr__(self, name):
            return lambda *_: done.append(is_paused[0])

    monkeypatch.setattr(live, "Viewer", Watched)
    monkeypatch.setattr(live, "choose_renderer", lambda settings, model: SPLATTING)
    scene = make_scene("room", n_views=3, width=16, height=12, supersampling=1, n_points=20).scene
    settings, progress = (
        SimpleNamespace(profile="GSPLAT_MAIN", backend="cpu", scene="room"),
        SimpleNamespace(paused=paused),
    )
    on_step = live.make_live_view(None)(None, scene, settings, progress)
    report = SimpleNamespace(state=SimpleNamespace(model=trained().model), step=1, last_step=2)
    on_step(report)
    assert done == [True] * 4 and not is_paused[0]  # made, shown, said, drawn


def test_a_layer_that_cannot_be_drawn_says_why(server):
    def without(model, view, request):
        return SPLATTING.render(model, view, request)[0]._replace(stats=None), ()

    bare = trained()._replace(renderer=SPLATTING._replace(name="bare", render=without))
    viewer = Viewer(server, content(trained=bare))
    with connected(server) as client:
        until(viewer, client, full(client))
        client.change("layer", "importance")
        client.images.clear()
        until(viewer, client, lambda m: said(m, "renderer bare gives no blend statistics"))
        until(viewer, client, full(client))


def test_keyframes_become_a_film(server, tmp_path, monkeypatch):
    monkeypatch.setattr(browser_module, "FILM_SECONDS", 1.0)
    viewer = Viewer(server, content(film=tmp_path / "view.gif"))
    with connected(server) as client:
        until(viewer, client, full(client))
        client.change("write film", True)
        until(viewer, client, lambda m: said(m, "at least two"))
        client.change("add keyframe", True)
        until(viewer, client, lambda m: said(m, "1 keyframes"))
        client.change("add keyframe", True)
        until(viewer, client, lambda m: said(m, "2 keyframes"))
        client.change("write film", True)
        until(viewer, client, lambda m: said(m, "view.gif"))  # lines of progress before it may be passed over
    assert (tmp_path / "view.gif").exists()


def test_it_listens_on_this_machine_alone(server):
    assert address(server) == f"http://127.0.0.1:{server.get_port()}"
    assert server.get_host() == HOST == "127.0.0.1"


def test_a_browser_shows_it(server, tmp_path):
    program = find_browser()
    if program is None:
        pytest.skip("needs Chromium")
    viewer = Viewer(server, content())
    with Browser(program, tmp_path, WEBGL) as browser:
        browser.open(address(server), width=900)
        end = time.perf_counter() + SECONDS
        while not any(window.shown.divisor == 1 for window in viewer._windows.values()):
            assert time.perf_counter() < end, "the browser has not asked for a frame"
            viewer.render_next()
            time.sleep(0.02)
        assert "layer" in browser.run("document.body.innerText")
        shot = tmp_path / "page.png"
        while True:
            assert time.perf_counter() < end, "the frame is not to be seen"
            browser.image(shot)
            image = read_image(shot).astype(int)
            is_background = np.abs(image - [0, 0, 102]).max(axis=2) < 12  # the model's, 0.4 blue
            if is_background.mean() > 0.2:
                break


# refused in one line


def test_bad_input(server, tmp_path, refused):
    ply = tmp_path / "ball.ply"
    save_ply(ply, trained().model.gaussians)
    with socket.socket() as taken:
        taken.bind((HOST, 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert f"port {port} cannot be used" in refused("view", ply, "--port", port)
        assert f"port {port} cannot be used" in refused("train", tmp_path, "--view", port)
    assert "port 70000 cannot be used" in refused("view", ply, "--port", 70000)
    assert "does not exist" in refused("view", tmp_path / "none")
    assert "a film is" in refused("view", ply, "--film", tmp_path / "film.avi")
    (tmp_path / "empty").mkdir()
    assert str(tmp_path / "empty") in refused("view", tmp_path / "empty")


def test_without_viser(tmp_path, refused, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    ply = tmp_path / "ball.ply"
    save_ply(ply, trained().model.gaussians)
    assert "pip install 'minisplat_ref[viewer]'" in refused("view", ply)
    with pytest.raises(InputError, match=r"minisplat_ref\[viewer\]"):
        open_server(0, "")


# a training and its run


@pytest.fixture
def scene(tmp_path):
    write_room(tmp_path / "nook", **SCENE)
    return tmp_path / "nook"


def test_a_training_is_shown_and_ends_with_the_same_bytes(scene, tmp_path, server, monkeypatch, refused):
    options = [*OPTIONS, "--iterations", "6"]
    assert main(["train", str(scene), *options, "--out", str(tmp_path / "alone")]) == 0
    frames = []
    render_next = Viewer.render_next
    monkeypatch.setattr("minisplat_ref.app.viewer.browser.open_server", lambda port, label: server)

    def draw_and_receive(viewer):
        render_next(viewer)
        client.receive()
        frames.append(len(client.images))

    monkeypatch.setattr(Viewer, "render_next", draw_and_receive)
    with connected(server) as client:
        time.sleep(0.2)  # until the server has the camera
        assert main(["train", str(scene), *options, "--out", str(tmp_path / "watched"), "--view"]) == 0
    assert len(frames) == 6 and frames[-1] >= 1
    ours = contents(tmp_path / "watched")
    assert ours["point_cloud.ply"] == contents(tmp_path / "alone")["point_cloud.ply"]

    monkeypatch.setattr("minisplat_ref.app.viewer.browser.serve", lambda viewer: None)
    assert main(["view", str(tmp_path / "watched"), "--port", "0"]) == 0
    (tmp_path / "watched" / "cameras.json").unlink()
    assert "cameras.json" in refused("view", tmp_path / "watched", "--port", "0")
