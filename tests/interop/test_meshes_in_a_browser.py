"""Meshes as glTF in a browser: three.js shows the colours that we write, where we draw them.

Skipped without Chromium or three: ``npm install three``, and the PATH must name the folder ``node_modules/.bin``.
"""

import base64
import io
import json
import os
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from browser import WEBGL, Browser, find_browser
from minisplat_ref.extensions.fans.mesh_files import write_mesh as write_translucent
from minisplat_ref.io import write_image
from minisplat_ref.mechanisms.fusion.extraction import ColoredMesh
from minisplat_ref.mechanisms.meshes.files import write_mesh
from minisplat_ref.mechanisms.peeling.kernels import peel
from minisplat_ref.mechanisms.peeling.layers import Frame, TranslucentMesh
from minisplat_ref.types import Camera

pytestmark = pytest.mark.interop

SECONDS = 60.0
LOADER = "examples/jsm/loaders/GLTFLoader.js"
BACKGROUND = (26, 51, 77)  # of 255
NEAR, FAR = 0.1, 20.0
GAP = 12  # pixels between two pictures
LEVELS = 1  # of 255, by which a pixel may differ: rounding once here and once there
EDGES_MAX = 0.002  # share of pixels that may differ by more: an edge passes through their centres, 4e-4 were measured

PAGE = """<!doctype html><meta charset="utf-8">
<script type="importmap">
{"imports": {"three": "THREE/build/three.module.js", "three/addons/": "THREE/examples/jsm/"}}
</script>
<script type="module">
import {Camera, Color, Scene, WebGLRenderer} from "three";
import {GLTFLoader} from "three/addons/loaders/GLTFLoader.js";
const asked = ASKED;
const renderer = new WebGLRenderer({preserveDrawingBuffer: true});
renderer.setPixelRatio(1);
renderer.setSize(asked.width, asked.height);
renderer.setClearColor(new Color(asked.background), 1);
document.body.append(renderer.domElement);
const camera = new Camera(), scene = new Scene();
camera.matrixAutoUpdate = camera.matrixWorldAutoUpdate = false;
camera.matrixWorldInverse.set(...asked.view);
camera.matrixWorld.copy(camera.matrixWorldInverse).invert();
camera.projectionMatrix.set(...asked.projection);
const file = Uint8Array.from(atob("FILE"), letter => letter.charCodeAt(0));
new GLTFLoader().parse(file.buffer, "", model => {
  scene.add(model.scene);
  renderer.render(scene, camera);
  document.body.dataset.drawn = renderer.domElement.toDataURL();
}, error => { document.body.dataset.drawn = "error: " + error; });
</script>"""


@pytest.fixture(scope="module")
def three():
    beside = (Path(entry).resolve().parent / "three" for entry in os.get_exec_path() if Path(entry).name == ".bin")
    found = next((folder for folder in beside if (folder / LOADER).is_file()), None)
    if found is None:
        pytest.skip("no three beside a node_modules/.bin of the PATH: npm install three")
    return found


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    program = find_browser()
    if program is None:
        pytest.skip("no Chromium on the PATH")
    options = (*WEBGL, "--allow-file-access-from-files")  # for modules
    with Browser(program, tmp_path_factory.mktemp("browser"), options) as opened:
        yield opened


def camera():
    """Turned about all axes, with the principal point beside the middle."""
    w, x, y, z = np.array([0.95, 0.1, -0.2, 0.15]) / np.linalg.norm([0.95, 0.1, -0.2, 0.15])
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return Camera(R, np.array([0.1, 0.4, 4.0]), 260.0, 240.0, 84.0, 56.0, 160, 120)


def asked_of(camera):
    """What the page is told of a camera, whose axes are ours, for a scene that has the axes of glTF.

    A camera of WebGL looks along -z, and y is up; its image plane extends from -1 to 1.
    """
    view = np.eye(4)
    view[:3, :3] = np.diag([1, -1, -1]) @ camera.cam_from_world_R @ np.diag([-1, -1, 1])
    view[:3, 3] = [1, -1, -1] * camera.cam_from_world_t
    w, h = camera.width, camera.height
    projection = [
        [2 * camera.fx / w, 0, 1 - 2 * camera.cx / w, 0],
        [0, 2 * camera.fy / h, 2 * camera.cy / h - 1, 0],
        [0, 0, (FAR + NEAR) / (NEAR - FAR), 2 * FAR * NEAR / (NEAR - FAR)],
        [0, 0, -1, 0],
    ]
    background = f"rgb({', '.join(map(str, BACKGROUND))})"
    matrices = {"view": view.ravel().tolist(), "projection": np.ravel(projection).tolist()}
    return json.dumps({"width": w, "height": h, "background": background, **matrices})


def shown(browser, three, path, folder):
    """What three.js shows of a file, bytes [H, W, 3]."""
    page = PAGE.replace("THREE", three.as_uri()).replace("ASKED", asked_of(camera()))
    (folder / "page.html").write_text(page.replace("FILE", base64.b64encode(path.read_bytes()).decode()))
    browser.open(folder / "page.html", width=400)
    end = time.perf_counter() + SECONDS
    while (drawn := browser.run("document.body.dataset.drawn")) is None:
        assert time.perf_counter() < end, browser.complaints()
        time.sleep(0.05)
    assert drawn.startswith("data:image/png;base64,"), drawn
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(drawn.split(",")[1]))).convert("RGB"))


def check_same(theirs, mesh, folder):
    """Assert that an image is that of a mesh as we render it, but for edges, and that it shows enough of the mesh.

    Both are written side by side: ``--basetemp DIR`` keeps them.
    """
    peeled = peel(mesh, Frame(camera(), NEAR), np.array(BACKGROUND) / 255)
    assert (peeled.n_layers > 0).mean() > 0.2
    ours = np.rint(255 * peeled.image)
    between = np.full((len(ours), GAP, 3), 255)
    write_image(folder / "theirs_and_ours.png", np.concatenate([theirs, between, ours], axis=1).astype(np.uint8))
    errors = np.abs(theirs - ours).max(axis=2)
    assert (errors > LEVELS).mean() < EDGES_MAX


CORNERS = np.array([[-1.0, -0.8, -0.3], [1.1, -0.7, 0.2], [0.1, 0.9, -0.2], [-0.2, 0.1, -1.2]])
OUTWARD = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [0, 2, 3]])


def test_a_mesh_has_the_colours_of_a_render(browser, three, tmp_path):
    """A tetrahedron whose faces have a colour each, a dark one among them, and which looks different from all sides."""
    colors = np.array([[0.9, 0.5, 0.2], [3 / 255, 6 / 255, 12 / 255], [0.1, 0.3, 0.8], [0.5, 0.7, 0.4]])
    mesh = ColoredMesh(CORNERS[OUTWARD].reshape(-1, 3), np.arange(12).reshape(4, 3), np.repeat(colors, 3, axis=0))
    p0, p1, p2 = np.moveaxis(mesh.corners, 1, 0)
    assert np.sum(np.cross(p0, p1) * p2) > 0
    write_mesh(tmp_path / "mesh.glb", mesh)
    opaque = TranslucentMesh(mesh.vertices, np.column_stack([mesh.colors, np.ones(12)]), mesh.faces)
    check_same(shown(browser, three, tmp_path / "mesh.glb", tmp_path), opaque, tmp_path)


def test_fans_blend_and_have_two_sides(browser, three, tmp_path):
    """Two triangles, the far one first in the file, of which one is seen from behind."""
    far, near = np.array([[-1.2, -0.9, 0.5], [1.3, -0.8, 0.5], [0.0, 1.1, 0.5]]), CORNERS[:3] - [0.3, 0.2, 0.6]
    rgba = np.repeat([[0.8, 0.2, 0.1, 0.7], [0.1, 0.6, 0.9, 0.4]], 3, axis=0)
    mesh = TranslucentMesh(np.concatenate([far, near]), rgba, np.array([[0, 1, 2], [3, 5, 4]]))
    write_translucent(tmp_path / "fans.glb", mesh)
    check_same(shown(browser, three, tmp_path / "fans.glb", tmp_path), mesh, tmp_path)
