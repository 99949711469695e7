"""Masks that leave no pixel of their photograph."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from data_tools.foreign_files.building import (
    NAMES,
    OPTIONS,
    SCENE,
    TEST_NAMES,
    camera_names,
    command,
    done,
    metrics_of,
    refused,
    room,
)
from minisplat_ref.io import load_scene

HEIGHT, WIDTH = SCENE["height"], SCENE["width"]
BLACK: NDArray[np.uint8] = np.zeros((HEIGHT, WIDTH), np.uint8)
HALF = np.where(np.arange(WIDTH) < WIDTH // 2, np.uint8(1), np.uint8(0)) * np.ones((HEIGHT, 1), np.uint8)  # 0 and 1
SPECK = BLACK.copy()
SPECK[5, 7] = 255  # one pixel of 48 x 36: none is half covered at a quarter of the size


def _write(scene: Path, name: str, mask: NDArray | Image.Image) -> Path:
    file = scene / "masks" / f"{name}.png.png"
    file.parent.mkdir(exist_ok=True)
    image = mask if isinstance(mask, Image.Image) else Image.fromarray(mask)
    image.save(file, format="TIFF" if image.mode in ("I", "F") else "PNG")  # PNG has no 32 bits; names are COLMAP's
    return file


def _set_aside(folder: Path, name: str) -> None:
    """One empty mask: the view is named and left out of everything, and the run ends with metrics."""
    scene, run = room(folder), folder / "run"
    for other in NAMES:
        _write(scene, other, BLACK if other == name else 255 * HALF)
    for said in (done("info", scene), done("train", scene, *OPTIONS, "--out", run)):
        (warning,) = said.warnings
        assert f"masks/{name}.png.png" in warning and "values from 0 to 0" in warning and "1 of 8 views" in warning
    assert name not in (*camera_names(run, "train"), *camera_names(run, "test"))
    assert len(metrics_of(run)["per_view"]) == 2 - (name in TEST_NAMES)
    done("eval", run)
    done("train", "--resume", run, "--iterations", 18)


def _simplified(folder: Path) -> None:
    scene, run = room(folder), folder / "run"
    _write(scene, NAMES[4], BLACK)
    done("train", scene, *OPTIONS, "--out", run)
    said = done("simplify", run, "--out", folder / "small", "--budget", 100)
    assert f"masks/{NAMES[4]}.png.png" in said.err
    assert len(metrics_of(folder / "small")["per_view"]) == 1


def _compared(folder: Path) -> None:
    scene = room(folder)
    _write(scene, NAMES[4], BLACK)
    said = done(
        *("compare", scene, "--recipes", "3dgs-accel,3dgs", "--iterations", 6, "--test-every", 4),
        *("--out", folder / "compared"),
    )
    assert f"masks/{NAMES[4]}.png.png" in said.err


def _all_empty(folder: Path, mask: NDArray | Image.Image, says: str) -> None:
    """All masks are empty: refused before anything is written, with the range that they hold."""
    scene = room(folder)
    for name in NAMES:
        _write(scene, name, mask)
    for arguments in (("info", scene), ("train", scene, "--out", folder / "run", *OPTIONS)):
        line = refused(*arguments, names=f"masks/{NAMES[1]}.png.png")
        assert says in line and ("8 of 8 views" in line or "32 bits" in line), line
    assert not (folder / "run").exists()


def _palette(levels: NDArray[np.uint8], color: tuple[int, int, int]) -> Image.Image:
    image = Image.fromarray(levels, mode=None).convert("L").convert("P")
    image = Image.frombytes("P", image.size, levels.tobytes())
    image.putpalette([0, 0, 0, *color])
    return image


def _clear() -> Image.Image:
    rgba = np.full((HEIGHT, WIDTH, 4), 255, np.uint8)
    rgba[..., 3] = 0
    return Image.fromarray(rgba)


def _alpha_of_photograph(folder: Path) -> None:
    """A photograph that is transparent everywhere, in a COLMAP scene, where alpha is a mask."""
    scene = room(folder)
    photograph = scene / "images" / f"{NAMES[2]}.png"
    image = Image.open(photograph).convert("RGBA")
    image.putalpha(0)
    image.save(photograph)
    (warning,) = done("info", scene).warnings
    assert f"images/{NAMES[2]}.png (transparent everywhere)" in warning


def _after_downscaling(folder: Path) -> None:
    scene, run = room(folder), folder / "run"
    _write(scene, NAMES[3], SPECK)
    assert not done("info", scene).warnings
    said = done("train", scene, *OPTIONS, "--downscale", 2, "--out", run)
    (warning,) = [line for line in said.warnings if "mask" in line]
    assert f"masks/{NAMES[3]}.png.png (at 24 x 18 pixels)" in warning
    done("eval", run)


def _after_undistortion(folder: Path) -> None:
    """What is white lies in the corner that the undistorted photograph does not show."""
    scene, run = room(folder), folder / "run"
    cameras = scene / "sparse" / "0" / "cameras.txt"
    lines = [line.split() for line in cameras.read_text().splitlines() if not line.startswith("#")]
    fields = lines[0]
    cameras.write_text(" ".join([fields[0], "OPENCV", *fields[2:], "-0.3", "0", "0", "0"]) + "\n")
    corner = BLACK.copy()
    corner[0, 0] = 255
    _write(scene, NAMES[3], corner)
    said = done("train", scene, "--undistort", *OPTIONS, "--out", run)
    (warning,) = [line for line in said.warnings if "mask" in line]
    assert f"masks/{NAMES[3]}.png.png" in warning, warning
    done("eval", run)


def _halved_in_training(folder: Path) -> None:
    """A mask that is there, but not at the size at which a recipe trains at first."""
    scene, run = room(folder), folder / "run"
    for name in NAMES:
        _write(scene, name, SPECK)
    said = command(
        *("train", scene, "--recipe", "mini-splatting2", "--iterations", 30, "--test-every", 4, "--out", run),
        *("--set", "min_side=16"),
    )
    assert said.code == 0, said.err
    assert len(metrics_of(run)["per_view"]) == 2


def _of_transforms(folder: Path) -> None:
    scene = folder / "frames"
    (scene / "images").mkdir(parents=True)
    frames = []
    for i in range(5):
        x = 0.2 * i
        matrix = [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
        frames.append({"file_path": f"images/{i}.png", "mask_path": f"images/{i}_mask.png", "transform_matrix": matrix})
        Image.fromarray(np.full((24, 32, 3), 40 * i, np.uint8)).save(scene / "images" / f"{i}.png")
        Image.fromarray(np.full((24, 32), 0 if i == 3 else 255, np.uint8)).save(scene / "images" / f"{i}_mask.png")
    (scene / "transforms.json").write_text(json.dumps({"fl_x": 40, "frames": frames}))
    (warning,) = done("info", scene).warnings
    assert "images/3_mask.png (values from 0 to 0" in warning


def _read_on_demand(folder: Path) -> None:
    """Photographs that memory cannot hold are checked as well."""
    from minisplat_ref import memory

    scene, shelf_bytes = room(folder), memory.shelf_bytes
    _write(scene, NAMES[5], BLACK)
    memory.shelf_bytes = lambda *_: 0.0
    try:
        (warning,) = done("info", scene).warnings
    finally:
        memory.shelf_bytes = shelf_bytes
    assert f"masks/{NAMES[5]}.png.png" in warning


def _sixteen_bits(folder: Path) -> None:
    """Black and white of 16 bits, and floats from 0 to 1, are masks like any other."""
    scene = room(folder)
    file = _write(scene, NAMES[1], 65535 * HALF.astype(np.uint16))
    Image.fromarray(HALF.astype(np.float32)).save(file.with_name(f"{NAMES[2]}.png"), format="TIFF")
    views = {view.name: view for view in load_scene(scene).train_views}
    for name in NAMES[1:3]:
        np.testing.assert_array_equal(views[name].mask, HALF == 1)


EMPTY: dict[str, tuple[Callable[[], NDArray | Image.Image], str]] = {
    "black": (lambda: BLACK, "values from 0 to 0, white is 255"),
    "0 and 1": (lambda: HALF, "values from 0 to 1, white is 255"),
    "8 bits in 16": (lambda: 255 * HALF.astype(np.uint16), "values from 0 to 255, white is 65535"),
    "0 and 1 of 16 bits": (lambda: HALF.astype(np.uint16), "values from 0 to 1, white is 65535"),
    "dark palette": (lambda: _palette(HALF, (80, 0, 40)), "values from 0 to 80, white is 255"),
    "transparent everywhere": (_clear, "alpha goes up to 0"),
    "32-bit integers": (lambda: Image.fromarray(HALF.astype(np.int32)), "integers of 32 bits"),
}

CASES: dict[str, Callable[[Path], None]] = {
    "a training view": partial(_set_aside, name=NAMES[3]),
    "a test view": partial(_set_aside, name=NAMES[4]),
    "simplify": _simplified,
    "compare": _compared,
    **{f"all of {what}": partial(_all_empty, mask=make(), says=says) for what, (make, says) in EMPTY.items()},
    "transparent photograph": _alpha_of_photograph,
    "after --downscale": _after_downscaling,
    "after --undistort": _after_undistortion,
    "halved in training": _halved_in_training,
    "transforms.json": _of_transforms,
    "read on demand": _read_on_demand,
    "16 bits and floats": _sixteen_bits,
}
