"""Viewers in a headless Chromium: a page imports the viewer from the cache folder and returns its pixels.

Each file in ``viewers/`` is the driver of one viewer: a module with ``show(request)``, which loads ``request.ply``,
sets the camera by its matrices, and returns the canvas' bytes [H, W, 4], bottom row first.
"""

import base64
import functools
import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from data_tools.browser import WEBGL, Browser, find_browser
from minisplat_ref.errors import InputError
from minisplat_ref.types import Floats

DRIVERS = Path(__file__).with_name("viewers")
SECONDS = 60.0  # for a picture; software rendering takes a few
PAGE = """<!doctype html><meta charset="utf-8"><style>body { margin: 0 } canvas { display: block }</style>
<script type="importmap">{"imports": IMPORTS}</script><body><script type="module">
const request = REQUEST;
const failed = error => { window.answer = {error: String(error && error.stack || error)}; };
window.addEventListener("error", event => failed(event.message));
window.addEventListener("unhandledrejection", event => failed(event.reason));
try {
  const driver = await import("/viewers/DRIVER");
  const pixels = await driver.show(request);
  let text = ""; for (const byte of pixels) text += String.fromCharCode(byte);
  window.answer = {pixels: btoa(text)};
} catch (error) { failed(error); }
</script>"""


class _Quiet(SimpleHTTPRequestHandler):
    """Serves the folder of a run, the drivers and the packages, and says nothing."""

    roots: ClassVar[dict[str, Path]] = {}

    def translate_path(self, path: str) -> str:
        first, _, rest = path.split("?")[0].lstrip("/").partition("/")
        return (
            str(self.roots.get(first, self.roots[""]) / rest) if first in self.roots else super().translate_path(path)
        )

    def end_headers(self) -> None:
        self.send_header("Cache-Control", "no-store")
        super().end_headers()

    def log_message(self, *_: Any) -> None:
        return


@contextmanager
def serving(folder: Path, packages: Path) -> Iterator[str]:
    """Serve a folder, the drivers, ``/node_modules`` and ``/repositories`` on this machine alone; yield the address."""
    roots = {"": folder, "viewers": DRIVERS} | {name: packages / name for name in ("node_modules", "repositories")}
    handler = type("Handler", (_Quiet,), {"roots": roots})
    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(handler, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()


@contextmanager
def browsing(profile: Path) -> Iterator[Browser]:
    """Open a Chromium that renders WebGL in software.

    Raises
    ------
    InputError
        There is none.
    """
    program = find_browser()
    if program is None:
        raise InputError("viewers need a Chromium on the PATH: apt-get install chromium")
    with Browser(program, profile, (*WEBGL, "--ignore-gpu-blocklist", "--enable-webgl")) as browser:
        yield browser


def picture(
    browser: Browser, address: str, folder: Path, driver: str, imports: dict[str, str], request: dict[str, Any]
) -> Floats:
    """Return what a viewer shows [H, W, 3] in 0 to 1.

    Raises
    ------
    InputError
        The viewer failed, or gave no picture in time.
    """
    page = folder / f"{driver}.{request['name']}.html"
    text = PAGE.replace("IMPORTS", json.dumps(imports)).replace("DRIVER", driver)
    page.write_text(text.replace("REQUEST", json.dumps(request)))
    browser.open(f"{address}/{page.name}", width=1000)
    end = time.perf_counter() + SECONDS
    while (answer := browser.run("window.answer")) is None:
        if time.perf_counter() > end:
            said = "; ".join(browser.complaints()[-2:])
            raise InputError(f"{driver} shows nothing of {request['name']} in {SECONDS:.0f} seconds: {said}")
        time.sleep(0.05)
    if "error" in answer:
        raise InputError(f"{driver}, {request['name']}: {answer['error'].splitlines()[0]}")
    data = np.frombuffer(base64.b64decode(answer["pixels"]), np.uint8)
    return data.reshape(request["height"], request["width"], 4)[::-1, :, :3] / 255.0
