"""Photographs whose files do not say, or not as usual, which value is white."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from data_tools.foreign_files.building import NAMES, OPTIONS, done, refused, room
from minisplat_ref.io import load_scene, read_image
from minisplat_ref.types import Floats

LEVELS = np.arange(256).reshape(16, 16)  # every byte once


def _convert(scene: Path, change: Callable[[NDArray], NDArray], suffix: str = ".png") -> None:
    """Save the photographs of a scene, as gray, in another type of number."""
    images = scene / "sparse" / "0" / "images.txt"
    images.write_text(images.read_text().replace(".png", suffix))
    for name in NAMES:
        file = scene / "images" / f"{name}.png"
        gray = np.asarray(Image.open(file).convert("L"))
        file.unlink()
        Image.fromarray(change(gray)).save(file.with_suffix(suffix))


def _floats(folder: Path) -> None:
    """Floats from 0 to 1 are the bytes that they round to, in a training as well."""
    Image.fromarray((LEVELS / 255).astype(np.float32)).save(folder / "levels.tif")
    np.testing.assert_array_equal(read_image(folder / "levels.tif")[..., 1], LEVELS)
    scene = room(folder)
    before = {view.name: view.image for view in load_scene(scene).train_views}
    _convert(scene, lambda gray: (gray / 255).astype(np.float32), ".tif")
    for view in load_scene(scene).train_views:
        gray = np.asarray(Image.fromarray(before[view.name]).convert("L"))
        np.testing.assert_array_equal(view.image, np.repeat(gray[..., None], 3, axis=2))
    done("train", scene, *OPTIONS, "--out", folder / "run")


def _wrong_floats(folder: Path, change: Callable[[Floats], Floats], says: str) -> None:
    scene = room(folder)
    _convert(scene, lambda gray: change(gray / 255).astype(np.float32), ".tiff")
    for arguments in (("info", scene), ("train", scene, *OPTIONS, "--out", folder / "run")):
        line = refused(*arguments, names=f"images/{NAMES[1]}.tiff")
        assert says in line and "1 is white" in line, line


def _with_nan(levels: Floats) -> Floats:
    return np.where(levels > 0.5, np.nan, levels)


def _integers(folder: Path, white: int) -> None:
    scene = room(folder)
    _convert(scene, lambda gray: (gray * (white / 255)).astype(np.int32), ".tif")
    line = refused("train", scene, *OPTIONS, "--out", folder / "run", names=f"images/{NAMES[1]}.tif")
    assert "integers of 32 bits, from" in line and "8 or 16 bits" in line, line


def _sixteen_bits(folder: Path, order: str) -> None:
    Image.fromarray((257 * LEVELS).astype(f"{order}u2")).save(folder / "levels.tif")
    np.testing.assert_array_equal(read_image(folder / "levels.tif")[..., 2], LEVELS)


def _portable_gray(folder: Path, white: int) -> None:
    """A PGM says in its header which value is white."""
    levels = np.round(LEVELS / 255 * white).astype(">u2")
    (folder / "levels.pgm").write_bytes(b"P5 16 16 %d\n" % white + levels.tobytes())
    np.testing.assert_allclose(read_image(folder / "levels.pgm")[..., 0], LEVELS, atol=1)


def _few_bits_of_16(folder: Path, bits: int) -> None:
    """Camera values of 10 to 14 bits in files of 16 are dark, which is said."""
    scene = room(folder)
    _convert(scene, lambda gray: (gray / 255 * (2**bits - 1)).astype(np.uint16))
    (warning,) = done("info", scene).warnings
    assert "almost black" in warning and "white is 65535" in warning


CASES: dict[str, Callable[[Path], None]] = {
    "floats from 0 to 1": _floats,
    "floats to 255": partial(_wrong_floats, change=lambda x: 255 * x, says=" to 2"),
    "floats below 0": partial(_wrong_floats, change=lambda x: 2 * x - 1, says="from -"),
    "floats with NaN": partial(_wrong_floats, change=_with_nan, says="nan"),
    **{f"32-bit integers to {white}": partial(_integers, white=white) for white in (255, 65535, 2**31 - 1)},
    **{f"16 bits, byte order {order}": partial(_sixteen_bits, order=order) for order in "<>"},
    **{f"PGM to {white}": partial(_portable_gray, white=white) for white in (1023, 4095, 65535)},
    **{f"{bits} bits of 16": partial(_few_bits_of_16, bits=bits) for bits in (10, 12, 14)},
}
