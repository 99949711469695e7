"""Names of photographs as other systems and programs write them, and text models with marks of an editor."""

import json
import shutil
import unicodedata
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from data_tools.foreign_files.building import NAMES, OPTIONS, camera_names, done, room
from data_tools.foreign_files.leftovers import as_transforms
from minisplat_ref.io import load_scene

ACCENT = "caf\u00e9"  # one letter; macOS may keep it as e and an accent


def _rename(scene: Path, in_model: Callable[[str], str], on_disk: Callable[[str], str]) -> None:
    """Give every photograph one name in the model and another in the folder."""
    images = scene / "sparse" / "0" / "images.txt"
    text = images.read_text()
    for name in NAMES:
        text = text.replace(f"{name}.png", in_model(f"{name}.png"))
        target = scene / "images" / on_disk(f"{name}.png")
        target.parent.mkdir(exist_ok=True, parents=True)
        (scene / "images" / f"{name}.png").rename(target)
    images.write_text(text)


def _renamed(folder: Path, in_model: Callable[[str], str], on_disk: Callable[[str], str]) -> None:
    """All eight photographs are found, with the pixels of before."""
    scene = room(folder)
    before = [view.image for view in load_scene(scene, test_every=0).train_views]
    _rename(scene, in_model, on_disk)
    after = [view.image for view in load_scene(scene, test_every=0).train_views]
    np.testing.assert_array_equal(after, before)
    assert "8 of 8 photographs have cameras" in done("info", scene).out
    if in_model is _spaced:
        run = folder / "run"
        done("train", scene, *OPTIONS, "--out", run)
        assert len({*camera_names(run, "train"), *camera_names(run, "test")}) == 8
        done("eval", run)


def _masks(folder: Path, name_of: Callable[[str], str]) -> None:
    """Masks are found whatever the case of their names."""
    scene = room(folder)
    (scene / "masks").mkdir()
    for name in NAMES:
        shutil.copyfile(scene / "images" / f"{name}.png", scene / "masks" / name_of(f"{name}.png"))
    assert all(view.mask is not None for view in load_scene(scene, test_every=0).train_views)
    assert "masks/ has" not in done("info", scene).out


def _frames(folder: Path, suffix: str, listed: str) -> None:
    """Frames of a transforms.json without a suffix, or with one in other case."""
    scene = room(folder)
    content = as_transforms(load_scene(scene))
    shutil.rmtree(scene / "sparse")
    for name in NAMES:
        (scene / "images" / f"{name}.png").rename(scene / "images" / f"{name}{suffix}")
    for frame in content["frames"]:
        frame["file_path"] = f"./images/{Path(frame['file_path']).stem}{listed}"
    (scene / "transforms.json").write_text(json.dumps(content))
    assert len(load_scene(scene, test_every=0).train_views) == 8
    assert "8 of 8 photographs have cameras" in done("info", scene).out


def _marked(folder: Path, file: str, encoding: str) -> None:
    """A text model that an editor has saved with a byte order mark."""
    scene = room(folder)
    before = load_scene(scene)
    path = scene / "sparse" / "0" / file
    path.write_text(path.read_text(), encoding=encoding)
    after = load_scene(scene)
    assert [view.name for view in after.train_views] == [view.name for view in before.train_views]
    np.testing.assert_array_equal(after.points, before.points)
    assert after.train_views[2].camera[2:] == before.train_views[2].camera[2:]


def _lines(folder: Path, change: Callable[[str], str]) -> None:
    """A text model with the line ends or gaps of another system."""
    scene = room(folder)
    before = load_scene(scene)
    for file in (scene / "sparse" / "0").iterdir():
        file.write_bytes(change(file.read_text()).encode())
    after = load_scene(scene)
    np.testing.assert_array_equal(after.points, before.points)
    assert [view.name for view in after.train_views] == [view.name for view in before.train_views]
    assert "8 of 8 photographs have cameras" in done("info", scene).out


def _without_points(folder: Path, binary: bool) -> None:
    """A model of cameras alone: trained from random points, with a warning."""
    scene = room(folder)
    model = scene / "sparse" / "0"
    if binary:
        import pycolmap

        reconstruction = pycolmap.Reconstruction(str(model))
        for file in model.iterdir():
            file.unlink()
        reconstruction.write_binary(str(model))
    for file in model.glob("points3D.*"):
        file.unlink()
    assert any("no sparse points" in warning for warning in done("info", scene).warnings)
    done("train", scene, *OPTIONS, "--out", folder / "run")


def _points_in_a_ply(folder: Path) -> None:
    """The points are in the PLY that 3DGS writes beside the model."""
    from minisplat_ref.io.ply_file import write_vertices

    scene = room(folder)
    before = load_scene(scene)
    model = scene / "sparse" / "0"
    (model / "points3D.txt").unlink()
    names = ("x", "y", "z", "red", "green", "blue")
    columns = [*before.points.T, *before.point_colors.T]
    write_vertices(model / "points3D.ply", dict(zip(names, columns, strict=True)))
    assert not done("info", scene).warnings
    after = load_scene(scene)
    np.testing.assert_array_equal(after.points, before.points)
    np.testing.assert_array_equal(after.point_colors, before.point_colors)


def same(name: str) -> str:
    """Return the name itself."""
    return name


def _upper(name: str) -> str:
    return name.replace(".png", ".PNG")


def _spaced(name: str) -> str:
    return name.replace("view_", "my photo (1)  ")


def _folder(name: str) -> str:
    return f"left camera/{name}"


def _accented(form: Literal["NFC", "NFD"], name: str) -> str:
    return unicodedata.normalize(form, f"{ACCENT}_{name}")


CASES: dict[str, Callable[[Path], None]] = {
    "spaces": partial(_renamed, in_model=_spaced, on_disk=_spaced),
    "a folder with a space": partial(_renamed, in_model=_folder, on_disk=_folder),
    "upper case on disk": partial(_renamed, in_model=same, on_disk=_upper),
    "upper case in the model": partial(_renamed, in_model=_upper, on_disk=same),
    "as in an address": partial(_renamed, in_model=lambda name: f"my%20{name}", on_disk=lambda name: f"my {name}"),
    "backslashes": partial(_renamed, in_model=lambda name: f"left\\{name}", on_disk=lambda name: f"left/{name}"),
    "decomposed on disk": partial(_renamed, in_model=partial(_accented, "NFC"), on_disk=partial(_accented, "NFD")),
    "decomposed in the model": partial(_renamed, in_model=partial(_accented, "NFD"), on_disk=partial(_accented, "NFC")),
    "masks NAME.PNG": partial(_masks, name_of=_upper),
    "masks NAME.png.PNG": partial(_masks, name_of=lambda name: f"{name}.PNG"),
    "frames without suffix, .PNG": partial(_frames, suffix=".PNG", listed=""),
    "frames in lower case, .PNG": partial(_frames, suffix=".PNG", listed=".png"),
    "frames without suffix, .JPEG": partial(_frames, suffix=".JPEG", listed=""),
    **{
        f"{encoding} of {file}": partial(_marked, file=file, encoding=encoding)
        for file in ("cameras.txt", "images.txt", "points3D.txt")
        for encoding in ("utf-8-sig", "utf-16")
    },
    "line ends of Windows": partial(_lines, change=lambda text: text.replace("\n", "\r\n")),
    "tabs": partial(_lines, change=lambda text: text.replace(" ", "\t")),
    "no points, text": partial(_without_points, binary=False),
    "no points, binary": partial(_without_points, binary=True),
    "points in a PLY": _points_in_a_ply,
}
