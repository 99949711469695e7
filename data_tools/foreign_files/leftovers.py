"""Files of a scene that are there and not used: one line of ``info`` and ``train`` says so."""

import json
import math
import shutil
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from PIL import Image

from data_tools.foreign_files.building import NAMES, OPTIONS, camera_names, done, refused, room
from minisplat_ref.io import load_points, load_scene
from minisplat_ref.io.ply_file import write_vertices
from minisplat_ref.types import Scene

WHITE = Image.new("L", (48, 36), 255)


def said(scene: Path, run: Path | None = None) -> str:
    """Return the line of ``info``; if a run is to be made, ``train`` must say the same."""
    (line,) = [line for line in done("info", scene).out.splitlines() if line.startswith("files ")]
    line = line.removeprefix("files").strip()
    if run is None:
        return line
    of_train = done("train", scene, *OPTIONS, "--out", run)
    assert line in of_train.out + of_train.err, of_train.err
    is_warning = any(line in warning for warning in of_train.warnings)
    assert is_warning == (";" in line)
    return line


def _all_used(folder: Path) -> None:
    assert said(room(folder), folder / "run") == "8 of 8 photographs have cameras"


def _without_camera(folder: Path) -> None:
    scene = room(folder)
    for i in range(40):
        WHITE.save(scene / "images" / f"other_{i:02d}.jpg")
    for hidden in ("._view_0001.png", ".thumbs/view_0001.png"):
        (scene / "images" / hidden).parent.mkdir(exist_ok=True)
        WHITE.save(scene / "images" / hidden)
    line = said(scene, folder / "run")
    assert line == "8 of 48 photographs have cameras; without a camera: other_00.jpg, other_01.jpg, other_02.jpg, ..."


def _masks(folder: Path, place: str, suffix: str) -> None:
    scene = room(folder)
    (scene / place).mkdir()
    for name in NAMES:
        WHITE.save(scene / place / f"{name}{suffix}", format="PNG")
    line = said(scene)
    assert f"{place}/ has 8 files, 0 fit: a mask of {NAMES[0]}.png is masks/{NAMES[0]}.png.png" in line, line


def _half_of_the_masks(folder: Path) -> None:
    scene = room(folder)
    (scene / "masks").mkdir()
    for name in (*NAMES[:4], "view_0100", "view_0101"):
        WHITE.save(scene / "masks" / f"{name}.png")
    assert "masks/ has 6 files, 4 fit" in said(scene, folder / "run")


def _second_model(folder: Path, n_first: int) -> None:
    """The model that is read has fewer images than another, which --model takes."""
    scene = room(folder)
    sparse = scene / "sparse"
    shutil.copytree(sparse / "0", sparse / "1")
    reconstruction = pycolmap.Reconstruction(str(sparse / "0"))
    for image_id in sorted(reconstruction.images)[n_first:]:
        reconstruction.deregister_frame(reconstruction.image(image_id).frame_id)
    for file in (sparse / "0").iterdir():
        file.unlink()
    reconstruction.write_binary(str(sparse / "0"))
    line = said(scene, folder / "run")
    assert f"sparse/1 has 8 images, sparse/0 has {n_first}: give --model sparse/1" in line, line
    assert line.startswith(f"{n_first} of 8 photographs have cameras")
    assert "8 of 8 photographs have cameras" in done("info", scene, "--model", "sparse/1").out
    run = folder / "second"
    done("train", scene, "--model", "sparse/1", *OPTIONS, "--out", run)
    assert len(camera_names(run, "train")) == 6
    done("eval", run)
    done("train", "--resume", run, "--iterations", 17)
    line = refused("train", scene, "--model", "sparse/2", *OPTIONS, "--out", folder / "third", names="sparse/2")
    assert "such as sparse/0" in line


def _smaller_model(folder: Path) -> None:
    scene = room(folder)
    shutil.copytree(scene / "sparse" / "0", scene / "sparse" / "1")
    line = said(scene)
    assert "sparse/1 has 8 images, sparse/0 has 8" in line and "--model" not in line


def _split(folder: Path, place: str) -> None:
    scene = room(folder)
    (scene / place).write_text(f"{NAMES[1]}.png\n")
    assert f"the split of {Path(place).name} is not used" in said(scene)


def as_transforms(scene: Scene, **top: Any) -> dict[str, Any]:
    """Return a transforms.json of a scene's cameras, in another frame: turned, scaled and moved."""
    turn = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    frames = []
    for view in (*scene.train_views, *scene.test_views):
        camera = view.camera
        matrix = np.eye(4)
        matrix[:3, :3] = turn @ camera.cam_from_world_R.T * [1, -1, -1]
        matrix[:3, 3] = 2.5 * turn @ camera.center + [1.0, 2.0, 3.0]
        frames.append({"file_path": f"images/{view.name}.png", "transform_matrix": matrix.tolist()})
    lens = {
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "w": camera.width,
        "h": camera.height,
    }
    return {**lens, **top, "frames": frames}


def _beside_a_model(folder: Path, change: Callable[[dict[str, Any]], None], says: str) -> None:
    scene = room(folder)
    content = as_transforms(load_scene(scene))
    change(content)
    (scene / "transforms.json").write_text(json.dumps(content))
    line = said(scene)
    assert says in line if says else line == "8 of 8 photographs have cameras", line


def _agrees(content: dict[str, Any]) -> None:
    pass


def _lists_fewer(content: dict[str, Any]) -> None:
    del content["frames"][5:]


def _has_another_lens(content: dict[str, Any]) -> None:
    content["fl_x"] *= 1.3
    content["fl_y"] *= 1.3


def _has_another_angle(content: dict[str, Any]) -> None:
    content["camera_angle_x"] = 2 * math.atan(0.5 * content["w"] / (1.3 * content["fl_x"]))
    for key in ("fl_x", "fl_y"):
        del content[key]


def _has_other_places(content: dict[str, Any]) -> None:
    content["frames"][0]["transform_matrix"][0][3] += 3.0


def _transforms_alone(folder: Path, keys: Mapping[str, Any], says: str) -> None:
    scene = room(folder)
    content = as_transforms(load_scene(scene), **keys)
    shutil.rmtree(scene / "sparse")
    (scene / "transforms.json").write_text(json.dumps(content))
    line = said(scene)
    assert says in line, line


def _blender_sets(folder: Path) -> None:
    """The validation set of a Blender scene, and depth maps beside its test images."""
    scene = room(folder)
    content = as_transforms(load_scene(scene))
    shutil.rmtree(scene / "sparse")
    parts = {"train": content["frames"][:4], "test": content["frames"][4:6], "val": content["frames"][6:]}
    for name, frames in parts.items():
        (scene / f"transforms_{name}.json").write_text(json.dumps({**content, "frames": frames}))
    WHITE.save(scene / "images" / f"{NAMES[0]}_depth_0001.png")
    line = said(scene)
    assert line.startswith("6 of 8 photographs have cameras"), line
    assert "transforms_val.json is not used, 2 of its images are in no other file" in line


def _cloud(folder: Path, names: tuple[str, str, str], dtype: str, colored: bool) -> None:
    """The colours of a cloud, which programs call by different names."""
    scene = room(folder)
    loaded = load_scene(scene)
    content = as_transforms(loaded, ply_file_path="cloud.ply")
    shutil.rmtree(scene / "sparse")
    (scene / "transforms.json").write_text(json.dumps(content))
    colors = loaded.point_colors / 255 if dtype == "f4" else loaded.point_colors
    columns = dict(zip(("x", "y", "z", *names), [*loaded.points.T, *colors.T.astype(dtype)], strict=True))
    write_vertices(scene / "cloud.ply", columns)
    cloud = load_points(scene / "cloud.ply")
    line = said(scene, folder / "run")
    if colored:
        np.testing.assert_array_equal(cloud.colors, loaded.point_colors)
        assert "gray" not in line
    else:
        assert f"cloud.ply has no red, green, blue, but {', '.join(names)}: its points are gray" in line, line


def _unnamed_cloud(folder: Path) -> None:
    scene = room(folder)
    loaded = load_scene(scene)
    shutil.rmtree(scene / "sparse")
    (scene / "transforms.json").write_text(json.dumps(as_transforms(loaded)))
    write_vertices(scene / "sparse_pc.ply", dict(zip("xyz", loaded.points.T, strict=True)))
    line = said(scene)
    assert "sparse_pc.ply is not used: name it as ply_file_path in transforms.json" in line, line


def _init(folder: Path) -> None:
    """The colours of --init are those of Gaussians, or are said to be missing."""
    scene = room(folder)
    loaded = load_scene(scene)
    dc = ((loaded.point_colors / 255 - 0.5) / 0.28209479177387814).astype(np.float32)
    places = dict(zip("xyz", loaded.points.T, strict=True))
    write_vertices(folder / "splat.ply", places | {f"f_dc_{c}": dc[:, c] for c in range(3)})
    np.testing.assert_array_equal(load_points(folder / "splat.ply").colors, loaded.point_colors)
    write_vertices(folder / "strange.ply", places | {"intensity": dc[:, 0]})
    said = done("train", scene, *OPTIONS, "--init", folder / "strange.ply", "--out", folder / "run")
    assert "no properties red, green, blue, but intensity; all points start gray" in said.err


CASES: dict[str, Callable[[Path], None]] = {
    "nothing left": _all_used,
    "photographs without a camera": _without_camera,
    **{
        f"{place}/NAME{suffix}": partial(_masks, place=place, suffix=suffix)
        for place, suffix in (("masks", ".jpg"), ("mask", ".png"), ("mask", ".png.png"), ("Masks", ".png"))
    },
    "masks of some": _half_of_the_masks,
    "a larger second model": partial(_second_model, n_first=3),
    "an equal second model": _smaller_model,
    **{f"split in {place}": partial(_split, place=place) for place in ("test.txt", "sparse/0/test.txt", "split.json")},
    "transforms.json that agrees": partial(_beside_a_model, change=_agrees, says=""),
    "transforms.json with fewer": partial(
        _beside_a_model, change=_lists_fewer, says="transforms.json lists 5 images, sparse/0 has 8 and is used"
    ),
    "transforms.json, lens": partial(
        _beside_a_model,
        change=_has_another_lens,
        says="differs from sparse/0, which is used: focal lengths are 1.3 times",
    ),
    "transforms.json, angle": partial(_beside_a_model, change=_has_another_angle, says="focal lengths are 1.3 times"),
    "transforms.json, places": partial(_beside_a_model, change=_has_other_places, says="cameras stand elsewhere"),
    "test_filenames": partial(
        _transforms_alone,
        keys={"test_filenames": [f"images/{NAMES[2]}.png"]},
        says="test_filenames of transforms.json (1) is not used",
    ),
    "validation set": _blender_sets,
    "diffuse_red": partial(_cloud, names=("diffuse_red", "diffuse_green", "diffuse_blue"), dtype="u1", colored=True),
    "r, g, b": partial(_cloud, names=("r", "g", "b"), dtype="u1", colored=True),
    "Red of floats": partial(_cloud, names=("Red", "Green", "Blue"), dtype="f4", colored=True),
    "other colours": partial(_cloud, names=("hue", "saturation", "value"), dtype="f4", colored=False),
    "cloud that is not named": _unnamed_cloud,
    "--init": _init,
}
