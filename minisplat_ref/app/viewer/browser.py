"""The window of a viewer: a server on this machine, by viser, that browsers connect to.

viser's threads receive the messages of browsers. They only leave it where :meth:`Viewer.render_next` finds it, which
does the work in the thread that calls it. Messages of a browser decide what is rendered, never which file is written: a
page from another site can use this port, too.
"""

import contextlib
import io
import queue
import socket
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from minisplat_ref.app.reports.images import Image8
from minisplat_ref.app.runs.scoring import Trained
from minisplat_ref.app.viewer.filming import Film, write_travel
from minisplat_ref.app.viewer.layers import list_layers, render_layer
from minisplat_ref.app.viewer.photographs import camera_scale
from minisplat_ref.app.viewer.poses import Pose, camera_from_pose, choose_start, pose_from_camera
from minisplat_ref.app.viewer.progression import Shown, Wanted, fit, next_divisor, reduced
from minisplat_ref.errors import InputError
from minisplat_ref.io.upright import turn_upright
from minisplat_ref.io.viewpoints import Viewpoint
from minisplat_ref.types import Floats

HOST = "127.0.0.1"
POLL_SECONDS = 0.02  # between polls of the browsers' requests
LONGEST, LONGEST_MIN, LONGEST_MAX = 960, 160, 1920  # pixels of the longer side of a full frame
JPEG_QUALITY = 90
LINE_WIDTH = 1.5  # pixels, of cameras
FILM_SECONDS = 4.0


class Content(NamedTuple):
    """The model that is shown."""

    trained: Trained
    cameras: Sequence[Viewpoint]
    """In the frame of the model; may be empty."""
    photographs: Callable[[], dict[str, Image8]] | None
    """Loads the photographs by the cameras' names, when they are first needed."""
    film: Path | None
    """The file that a film is written to; None: there are none."""
    up: Floats
    """[3] what is up, in the frame of the model."""


class _Window:
    """The state of one browser, and the time of its latest request."""

    def __init__(self) -> None:
        self.shown, self.wanted, self.since = Shown(), None, 0.0

    shown: Shown
    wanted: Wanted | None
    since: float

    def want(self, wanted: Wanted) -> None:
        if wanted != self.wanted:
            self.wanted, self.since = wanted, time.perf_counter()


def open_server(port: int, label: str) -> Any:
    """Return a server of viser that listens on this machine alone.

    Parameters
    ----------
    port : int
        0 for a free one.
    label : str
        Title of the panel.

    Raises
    ------
    InputError
        viser is missing, or the port cannot be had.
    """
    try:
        import viser
    except ImportError:
        raise InputError("the viewer needs viser: pip install 'minisplat_ref[viewer]'") from None
    with socket.socket() as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((HOST, port))
        except (OSError, OverflowError) as error:  # the latter where there is no such number
            reason = getattr(error, "strerror", None) or "ports end at 65535"
            raise InputError(f"port {port} cannot be used ({reason}): give another one, or 0 for any") from None
        port = trial.getsockname()[1]
    with contextlib.redirect_stdout(io.StringIO()):  # a separate table
        server = viser.ViserServer(host=HOST, port=port, label=label, verbose=False)
    if server.get_port() != port:  # another program was faster, and viser continued with the next
        server.stop()
        raise InputError(f"port {port} is in use: give another one, or 0 for any")
    return server


def address(server: Any) -> str:
    """Return the address to open in a browser."""
    return f"http://{HOST}:{server.get_port()}"


class Viewer:
    """A model in all browsers that are connected to a server."""

    def __init__(self, server: Any, content: Content) -> None:
        self._server, self._content, self._version = server, content, 0
        self._windows: dict[int, _Window] = {}
        self._pixel_seconds: float | None = None
        self._keyframes: list[Pose] = []
        self._asked: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()  # from viser's threads
        start = choose_start(content.trained.model.gaussians.means, content.cameras, content.up)
        server.scene.set_up_direction(tuple(start.up.tolist()))
        initial = server.initial_camera
        initial.position, initial.look_at, initial.up = start.pose.position, tuple(start.target), tuple(start.up)
        initial.fov = start.pose.fov
        self._build_panel(start.pose)

    def _build_panel(self, start: Pose) -> None:
        gui, content = self._server.gui, self._content
        gui.configure_theme(show_logo=False, show_share_button=False)
        self._layer = gui.add_dropdown("layer", list_layers(content.trained.renderer), initial_value="colour")
        self._longest = gui.add_slider(
            "pixels", LONGEST_MIN, LONGEST_MAX, 32, LONGEST, hint="of the longer side, once the camera rests"
        )
        self._time = None
        if any(view.time != start.time for view in content.cameras):
            self._time = gui.add_slider("time", 0.0, 1.0, 0.01, min(max(start.time, 0.0), 1.0))
        self._caption = gui.add_markdown("")
        self._status = gui.add_markdown("")
        if content.cameras:
            box = gui.add_checkbox("cameras", False, hint="those of the training; a click goes there")
            box.on_update(lambda _: self._asked.put(lambda: self._show_cameras(box.value)))
        self._frustums: list[Any] = []
        if content.film is not None:
            with gui.add_folder("film"):
                add, clear = gui.add_button("add keyframe"), gui.add_button("remove keyframes")
                self._seconds = gui.add_slider("seconds", 1.0, 30.0, 0.5, FILM_SECONDS)
                write = gui.add_button("write film", hint=str(content.film))
            add.on_click(lambda event: self._asked.put(lambda: self._add_keyframe(event.client)))
            clear.on_click(lambda _: self._asked.put(self._remove_keyframes))
            write.on_click(lambda event: self._asked.put(lambda: self._write_film(event.client)))

    def show_status(self, text: str) -> None:
        """Show a line in the panel; of a text that could be markup the markup is shown."""
        self._status.content = "".join(f"\\{c}" if c in "\\`*_{}[]<>#|!" else c for c in text)

    def show(self, trained: Trained) -> None:
        """Show another model from now on, which has the same renderer's layers."""
        self._content = self._content._replace(trained=trained)
        self._version += 1

    def render_next(self) -> bool:
        """Handle the browsers' requests, then render one frame for each that needs one; return whether any did."""
        while not self._asked.empty():
            self._asked.get()()
        clients = self._server.get_clients()
        self._windows = {number: self._windows.get(number) or _Window() for number in clients}
        return any([self._draw(client, self._windows[number]) for number, client in clients.items()])

    def _draw(self, client: Any, window: _Window) -> bool:
        camera = client.camera
        width, height = fit(camera.image_width, camera.image_height, int(self._longest.value))
        window.want(Wanted(self._pose(camera), self._layer.value, width, height))
        wanted = window.wanted
        assert wanted is not None
        start = time.perf_counter()
        divisor = next_divisor(wanted, self._version, window.shown, start - window.since, self._pixel_seconds)
        if divisor is None:
            return False
        size = reduced(width, height, divisor)
        window.shown = Shown(wanted, divisor, self._version)
        try:
            camera = camera_from_pose(wanted.pose, *size)
            picture = render_layer(self._content.trained, camera, wanted.layer, wanted.pose.time)
        except InputError as error:
            self._caption.content, self._layer.value = "", "colour"
            self.show_status(str(error))
            return True
        self._pixel_seconds = (time.perf_counter() - start) / (size[0] * size[1])
        client.scene.set_background_image(picture.image, format="jpeg", jpeg_quality=JPEG_QUALITY)
        if self._caption.content != picture.caption:
            self._caption.content = picture.caption
        return True

    def _pose(self, camera: Any) -> Pose:
        moment = 0.0 if self._time is None else float(self._time.value)
        return Pose(tuple(camera.wxyz.tolist()), tuple(camera.position.tolist()), float(camera.fov), moment)

    def _show_cameras(self, is_shown: bool) -> None:
        if is_shown and not self._frustums:
            images: dict[str, Image8] = {}
            try:
                images = {} if self._content.photographs is None else self._content.photographs()
            except InputError as error:
                self.show_status(str(error))
            scale = camera_scale(self._content.cameras)
            self._frustums = [self._frustum(k, view, scale, images) for k, view in enumerate(self._content.cameras)]
        for frustum in self._frustums:
            frustum.visible = is_shown

    def _frustum(self, k: int, view: Viewpoint, scale: float, images: dict[str, Image8]) -> Any:
        pose, camera = pose_from_camera(view.camera, view.time), view.camera
        upright = pose_from_camera(turn_upright(camera, self._content.up), view.time)
        aspect = camera.fy * camera.width / (camera.fx * camera.height)
        frustum = self._server.scene.add_camera_frustum(
            f"/cameras/{k}",
            pose.fov,
            aspect,
            scale=scale,
            thickness=LINE_WIDTH,
            thickness_units="screen",
            image=images.get(view.name),
            wxyz=pose.wxyz,
            position=pose.position,
        )

        def go_there(event: Any) -> None:
            with event.client.atomic():
                event.client.camera.wxyz, event.client.camera.position = upright.wxyz, upright.position
                event.client.camera.fov = upright.fov

        frustum.on_click(go_there)
        return frustum

    def _add_keyframe(self, client: Any) -> None:
        self._keyframes.append(self._pose(client.camera))
        self.show_status(f"{len(self._keyframes)} keyframes")

    def _remove_keyframes(self) -> None:
        self._keyframes.clear()
        self.show_status("no keyframes")

    def _write_film(self, client: Any) -> None:
        path = self._content.film
        assert path is not None
        width, height = fit(client.camera.image_width, client.camera.image_height, int(self._longest.value))
        film = Film(path, float(self._seconds.value), width // 2 * 2, height // 2 * 2, self._layer.value)
        try:
            write_travel(
                self._content.trained,
                self._keyframes,
                film,
                lambda done, total: self.show_status(f"film: {done} of {total}"),
            )
        except InputError as error:
            self.show_status(str(error))
            return
        self.show_status(f"film: {path}")
        print(f"film: {path}", flush=True)


def serve(viewer: Viewer) -> None:
    """Render for the browsers until Ctrl-C."""
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            if not viewer.render_next():
                time.sleep(POLL_SECONDS)
