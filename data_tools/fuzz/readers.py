"""Readers that are fuzzed: for each a folder of small files that are right, and the call that reads them."""

import hashlib
import json
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from data_tools.foreign_files.dialects import as_version_4
from data_tools.foreign_files.ksplat import write_ksplat
from data_tools.fuzz.mutations import Choose, damage
from minisplat_ref.app.runs import settings
from minisplat_ref.app.runs.options import Settings
from minisplat_ref.app.runs.run_folder import CONFIG
from minisplat_ref.datasets.synthetic import SyntheticScene, make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputWarning
from minisplat_ref.extensions.extension import all_formats, find_format
from minisplat_ref.io import load_ply, load_scene, save_ply, viewpoints, write_image
from minisplat_ref.io.formats import read_content
from minisplat_ref.io.frames import place_scene
from minisplat_ref.io.images import read_image
from minisplat_ref.io.inventory import take_inventory
from minisplat_ref.io.lens import import_pycolmap
from minisplat_ref.io.ply import load_points
from minisplat_ref.io.ply_file import read_vertices, write_vertices
from minisplat_ref.methods import get_recipe
from minisplat_ref.oracle.golden import files as golden
from minisplat_ref.oracle.golden.scenes import RECIPES, inputs, truth
from minisplat_ref.strategy.initialization import gaussians_from_points
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.saved_state import load_state, save_state
from minisplat_ref.types import Frame, Gaussians

FRAME = Frame((450_000.0, 5_410_000.0, 260.0), 0.5)
RECIPE = configure(get_recipe("3dgs-accel"), exposure="learned")


class Reader(NamedTuple):
    """A reader under test."""

    write: Callable[[Path], None]
    """Fills an empty folder with what the reader reads."""
    read: Callable[[Path, Path], object]
    """``read(folder, file)`` reads what ``write`` has left, of which ``file`` may be damaged."""
    damaged: tuple[str, ...]
    """Patterns of the files that are damaged, one at a time."""
    free_memory: int = 16_000_000
    """Bytes that it may take whatever the files: buffers of decoders, modules on first use."""


class Mutant(NamedTuple):
    """A damaged file."""

    path: Path
    content: bytes


def mutant(reader: Reader, folder: Path, choose: Choose) -> Mutant:
    """Return one of the reader's files, damaged; the folder stays as it is."""
    paths = sorted(path for pattern in reader.damaged for path in folder.glob(pattern))
    path = paths[choose(len(paths))]
    return Mutant(path, damage(path.read_bytes(), path.suffix, choose))


def _scene() -> SyntheticScene:
    return make_scene("room", supersampling=1, n_views=6, width=24, height=18, n_points=40)


def _write_colmap_text(folder: Path) -> None:
    write_scene(_scene(), folder / "scene", {})
    for name in ("images", "sparse"):
        shutil.move(folder / "scene" / name, folder / name)
    shutil.rmtree(folder / "scene")


def _write_colmap_binary(folder: Path) -> None:
    _write_colmap_text(folder)
    sparse = folder / "sparse" / "0"
    reconstruction = import_pycolmap().Reconstruction(str(sparse))
    for file in sparse.iterdir():
        file.unlink()
    reconstruction.write_binary(str(sparse))
    (folder / "masks").mkdir()
    for name, dtype in (("view_0001", np.uint8), ("view_0002.png", np.uint16)):
        white = np.full((18, 24), np.iinfo(dtype).max, dtype)
        Image.fromarray(white).save(folder / "masks" / f"{name}.png")


def _read_scene(folder: Path, _: Path) -> object:
    scene = place_scene(load_scene(folder, undistort=True))
    return scene, take_inventory(folder, scene)


def _write_transforms(folder: Path) -> None:
    """Write a file with every entry that is read, for all frames or for one."""
    scene = _scene().scene
    frames: list[dict[str, Any]] = []
    for view in (*scene.train_views, *scene.test_views):
        camera = view.camera
        matrix = np.eye(4)
        matrix[:3, :3] = camera.cam_from_world_R.T * [1, -1, -1]
        matrix[:3, 3] = camera.center
        name = f"{view.name}.png"
        frames.append({"file_path": f"images/{name}", "transform_matrix": matrix.tolist()})
        for kind in ("images", "masks"):
            (folder / kind).mkdir(exist_ok=True)
        write_image(folder / "images" / name, view.image)
    camera = scene.train_views[0].camera
    write_image(folder / "masks" / "0.png", np.ones(view.image.shape[:2], bool))
    frames[0] |= {"mask_path": "masks/0.png", "k1": 0.01, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0, "time": 0.5}
    frames[1] |= {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "camera_model": "OPENCV"}
    save_ply(folder / "points.ply", gaussians_from_points(scene.points, scene.point_colors, 0))
    top = {"fl_x": camera.fx, "w": camera.width, "h": camera.height, "is_fisheye": False, "ply_file_path": "points.ply"}
    (folder / "transforms.json").write_text(json.dumps({**top, "frames": frames}))


def _write_cameras(folder: Path) -> None:
    cameras = viewpoints.to_json(viewpoints.scene_viewpoints(_scene().scene))
    (folder / "cameras.json").write_text(json.dumps(cameras))


def _read_cameras(_: Path, file: Path) -> object:
    return viewpoints.read(file)


def _write_config(folder: Path) -> None:
    scene = _scene().scene._replace(frame=FRAME)
    own = Settings(
        scene="scene", recipe=RECIPE.name, schedule_iterations=10, iterations=10, set={"exposure": "learned"}
    )
    (folder / CONFIG).write_text(json.dumps(settings.to_config(own, RECIPE, scene)))


def _read_config(folder: Path, _: Path) -> object:
    return settings.load(folder), settings.load_background(folder), settings.load_frame(folder)


def _write_plys(folder: Path) -> None:
    """Write Gaussians of degree 1 in little- and big-endian bytes and as text, the last two with a colour.

    One more file has words of another program, colours as bytes, two scales, centres in double and an infinite opacity.
    """
    rng = np.random.default_rng(0)
    shapes = ((7, 3), (7, 4), (7, 3), (7,), (7, 3), (7, 3, 3))
    save_ply(folder / "little.ply", Gaussians(*(rng.normal(size=shape).astype(np.float32) for shape in shapes)))
    columns = read_vertices(folder / "little.ply") | {"red": np.arange(7, dtype=np.float32)}
    names = "".join(f"property float {name}\n" for name in columns)
    header = f"ply\nformat {{}} 1.0\ncomment damaged\nelement vertex 7\n{names}element face 0\nend_header\n"
    rows = np.stack(list(columns.values()), axis=1)  # [7, properties]
    (folder / "big.ply").write_bytes(header.format("binary_big_endian").encode() + rows.astype(">f4").tobytes())
    lines = "".join(" ".join(map(str, row)) + "\n" for row in rows.tolist())
    (folder / "text.ply").write_text(header.format("ascii") + lines)
    other = {name: column for name, column in columns.items() if not name.startswith(("f_", "n", "red", "scale_2"))}
    other = {name.replace("rot_", "quat_"): column for name, column in other.items()}
    other |= {name: other[name].astype(np.float64) for name in ("x", "y", "z")}
    other |= {name: np.arange(7, dtype=np.uint8) for name in ("red", "green", "blue")}
    other["opacity"] = np.where(np.arange(7) == 3, np.float32(np.inf), other["opacity"])
    write_vertices(folder / "other.ply", other)


def _read_ply(_: Path, file: Path) -> object:
    load_points(file)
    return load_ply(file)


def _write_compact(folder: Path) -> None:
    """Write the same Gaussians at every level of every format that an extension has."""
    _write_plys(folder)
    gaussians = load_ply(folder / "little.ply")
    for _, format_ in all_formats():
        for level in range(len(format_.levels)):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", InputWarning)  # of harmonics that a format leaves out
                (folder / f"compact-{level}{format_.suffix}").write_bytes(format_.encode(gaussians, level))
    for level in range(3):
        (folder / f"compact-{level}.ksplat").write_bytes(write_ksplat(gaussians, level))
    (folder / "compact-4.spz").write_bytes(as_version_4((folder / "compact-0.spz").read_bytes()))


def _read_compact(_: Path, file: Path) -> object:
    format_ = find_format(file)
    assert format_ is not None, file
    content = read_content(file)
    return format_.describe(content, file), format_.decode(content, file)


def _write_checkpoint(folder: Path) -> None:
    state = initial_state(_scene().scene, RECIPE, 0)
    state.stats["count"] = np.zeros(len(state.gaussians.means), np.int32)
    state.view_order = [2, 0, 1]
    state.frame = FRAME
    save_state(folder / "checkpoint.npz", state, RECIPE)


def _read_checkpoint(_: Path, file: Path) -> object:
    return load_state(file, RECIPE)


def _write_golden(folder: Path) -> None:
    recipe = RECIPES[0]._replace(size=(16, 16), n=20)
    golden.export(folder / "golden", {recipe.name: truth(inputs(recipe))})


def _read_golden(folder: Path, file: Path) -> object:
    """Read all; a damaged array file is given the hash that it has, as whoever damages on purpose would."""
    manifest = folder / "golden" / golden.MANIFEST
    if file != manifest:
        original = manifest.read_bytes()
        content = json.loads(original)
        content["scenes"][file.parent.name]["files"][file.name]["sha256"] = hashlib.sha256(
            file.read_bytes()
        ).hexdigest()
        try:
            manifest.write_text(json.dumps(content))
            golden.read_npz(file)
            return golden.load(folder / "golden")
        finally:
            manifest.write_bytes(original)
    return golden.load(folder / "golden")


def _write_images(folder: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (6, 8, 4), dtype=np.uint8)
    for suffix in ("png", "webp", "tif"):
        write_image(folder / f"image.{suffix}", image)
    for suffix in ("jpg", "bmp"):
        write_image(folder / f"image.{suffix}", image[..., :3])
    for name, dtype in (("floats", np.float32), ("long", np.int32), ("short", np.uint16)):
        Image.fromarray((image[..., 0] / 255).astype(dtype)).save(folder / f"image.{name}.tif")


def _read_image(_: Path, file: Path) -> object:
    return read_image(file)


READERS = {
    "ply": Reader(_write_plys, _read_ply, ("*.ply",)),
    "compact": Reader(_write_compact, _read_compact, ("compact-*",)),
    "colmap-binary": Reader(_write_colmap_binary, _read_scene, ("sparse/0/*.bin", "masks/*.png")),
    "colmap-text": Reader(_write_colmap_text, _read_scene, ("sparse/0/*.txt",)),
    "transforms": Reader(_write_transforms, _read_scene, ("transforms.json",)),
    "cameras": Reader(_write_cameras, _read_cameras, ("cameras.json",)),
    "config": Reader(_write_config, _read_config, (CONFIG,)),
    "checkpoint": Reader(_write_checkpoint, _read_checkpoint, ("checkpoint.npz",)),
    "golden": Reader(_write_golden, _read_golden, ("golden/*.json", "golden/*/*.npz")),
    "images": Reader(_write_images, _read_image, ("image.*",), free_memory=1_500_000_000),  # pixels are packed
}
"""By the name that the command takes."""
