"""One file to send: a page that shows Gaussians in any browser with WebGL 2, without a network and without a server.

``page.html`` is the page, ``page.js`` renders. The Gaussians are in it as gzip in base64, in this order:

========== ========================================================================
centres    3 x float32, in the frame in which the model was trained
log-scales 3 x uint16, ``low + step k`` between the smallest and the largest
rotation   4 x int16, wxyz of length 32767
opacity    uint16, ``k / 65535``
colour     3 x float16, coefficients of degree 0
harmonics  3 (K - 1) x int8 in steps of one 127th of the largest absolute coefficient
========== ========================================================================

We wrote a viewer of our own, as the bundled ones weigh 3.3 MB (SuperSplat's) and 2.7 MB besides three.js (Spark).
It renders under the profile GSPLAT_MAIN: opacities, colours, low-pass and bounds are those of ``render``, blended
in half floats. Left out are early termination, lenses, and whatever an extension adds to the six fields of 3DGS.
"""

import base64
import json
from collections.abc import Callable, Iterator, Sequence
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.app.viewer.poses import choose_start, make_upright
from minisplat_ref.errors import InputError
from minisplat_ref.io.formats.levels8 import opacities_of
from minisplat_ref.io.orbits import orbit
from minisplat_ref.io.packing.deflating import gzip_compressor
from minisplat_ref.io.packing.pieces import pieces, rows_of
from minisplat_ref.io.viewpoints import Viewpoint
from minisplat_ref.types import Floats, Gaussians
from minisplat_ref.validation import check_gaussians

N_VIEWS_WITHOUT_CAMERAS = 8  # on a circle around a scene of which no cameras are known
CIRCLE_SIZE = (960, 640)  # pixels of these
ROW_BYTES = 34  # of a Gaussian without harmonics
LEVEL_MAX = 127  # of the 8 bits of a harmonic
BLOCK = 3 << 20  # bytes that become text at once; multiples of three have no padding
FLOAT16_MAX = 65504.0


def write_page(
    title: str, gaussians: Gaussians, cameras: Sequence[Viewpoint], background: Floats, up: Floats
) -> Iterator[bytes]:
    """Return the parts of a self-contained page that shows Gaussians, in UTF-8.

    Parameters
    ----------
    title : str
        Name of the browser's tab.
    gaussians : Gaussians
        float32 or float64; N may be 0.
    cameras : sequence of Viewpoint
        Cameras that the viewer offers, in the frame of the Gaussians; the first is shown first. Without any, a circle.
    background : ndarray of shape (3,)
        RGB in [0, 1].
    up : ndarray of shape (3,)
        What is up, world frame. Cameras that were held on their side are turned upright.

    Raises
    ------
    InputError
        A value is not finite, or a colour is beyond float16.
    """
    check_gaussians(gaussians, title)
    largest = float(np.abs(gaussians.sh_dc).max(initial=0.0))
    if largest > FLOAT16_MAX:
        raise InputError(f"{title}: a coefficient of {largest:g}, beyond {FLOAT16_MAX:g}, is no colour: remove its row")
    views = make_upright(cameras, up) or orbit(gaussians.means, [], N_VIEWS_WITHOUT_CAMERAS, *CIRCLE_SIZE, up=up)
    start = choose_start(gaussians.means, list(cameras), up)
    header, content = pack(gaussians)
    scene = header | {
        "background": np.asarray(background, np.float64).tolist(),
        "target": start.target.tolist(),
        "up": start.up.tolist(),
        "views": [_view(view) for view in views],
    }
    folder = files("minisplat_ref.app.viewer")
    values = {
        "title": escape(title.encode("utf-8", "backslashreplace").decode()),
        "scene": json.dumps(scene, allow_nan=False).replace("<", "\\u003c"),
        "script": (folder / "page.js").read_text("utf-8"),
    }
    ends = (Template(text).substitute(values) for text in (folder / "page.html").read_text("utf-8").split("$gaussians"))
    return _parts(next(ends).encode(), content, next(ends).encode())


def _parts(head: bytes, content: bytes, tail: bytes) -> Iterator[bytes]:
    yield head
    for start in range(0, len(content), BLOCK):
        yield base64.b64encode(content[start : start + BLOCK])
    yield tail


def _view(view: Viewpoint) -> dict[str, Any]:
    camera = view.camera
    return {
        "name": view.name,
        "R": np.asarray(camera.cam_from_world_R, np.float64).tolist(),
        "position": np.asarray(camera.center, np.float64).tolist(),
        **{name: float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy", "width", "height")},
    }


def pack(gaussians: Gaussians) -> tuple[dict[str, Any], bytes]:
    """Return a page's description of its arrays, and the arrays, packed by gzip.

    Parameters
    ----------
    gaussians : Gaussians
        Finite.
    """
    log_scales, sh_rest = gaussians.log_scales, gaussians.sh_rest
    low, high = (float(log_scales.min()), float(log_scales.max())) if log_scales.size else (0.0, 0.0)
    scale_step = max(high - low, 1e-6) / 65535
    sh_step = max(float(sh_rest.max(initial=0.0)), -float(sh_rest.min(initial=0.0)), 1e-6) / LEVEL_MAX
    fields: tuple[tuple[str, Callable[[Gaussians], NDArray]], ...] = (
        ("centres", lambda rows: rows.means.astype("<f4")),
        ("scales", lambda rows: np.rint((rows.log_scales - low) / scale_step).astype("<u2")),
        ("rotations", _rotations),
        ("opacities", _opacities),
        ("colours", lambda rows: rows.sh_dc.astype("<f2")),
        ("harmonics", lambda rows: np.rint(rows.sh_rest / sh_step).astype("i1")),
    )
    n, n_rest = sh_rest.shape[:2]
    header = {"n": n, "n_rest": n_rest, "scale_low": low, "scale_step": scale_step, "sh_step": sh_step}
    compressor = gzip_compressor(n * (ROW_BYTES + 3 * n_rest))
    packed = []
    for name, encode in fields:
        for part in pieces(n, f"packing {name}"):
            packed.append(compressor.compress(encode(rows_of(gaussians, part)).tobytes()))
    return header, b"".join([*packed, compressor.flush()])


def _rotations(rows: Gaussians) -> NDArray:
    return np.rint(32767 * rows.quats / np.linalg.norm(rows.quats, axis=1, keepdims=True)).astype("<i2")


def _opacities(rows: Gaussians) -> NDArray:
    return np.rint(65535 * opacities_of(rows.opacity_logits)).astype("<u2")
