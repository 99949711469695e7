"""SPZ of programs that disagree about its axes, and of those that say which they mean."""

import gzip
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from data_tools.foreign_files.building import command, done, refused
from data_tools.foreign_files.dialects import as_version_4, gaussians
from minisplat_ref.io import load_ply, read_image, save_ply
from minisplat_ref.io.formats import spz

NUMBERS = {"LUF": 7, "RDF": 6, "RFU": 12, "LBD": 13}  # of Niantic's library
STEP = 2.0**-11


def theirs(version: int) -> bytes:
    """Return the content of a file with the axes of the PLY, of a program that keeps them, which no header says."""
    content = spz.encode(gaussians(), 2 if version == 2 else 0, "RDF")
    return as_version_4(content) if version == 4 else content


def _kept(folder: Path, version: int) -> None:
    """Read and written back with --axes RDF, nothing turns; without, a line says what was taken."""
    (folder / "theirs.spz").write_bytes(theirs(version))
    said = done("convert", folder / "theirs.spz", folder / "ours.ply")
    assert "read with the axes RUB" in said.err and "--axes RDF" in said.err, said.err
    np.testing.assert_allclose(load_ply(folder / "ours.ply").means, gaussians().means * [1, -1, -1], atol=STEP)
    said = done("convert", folder / "theirs.spz", folder / "ours.ply", "--axes", "RDF")
    assert "read with the axes RDF" in said.err
    np.testing.assert_allclose(load_ply(folder / "ours.ply").means, gaussians().means, atol=STEP)
    said = done(
        "convert", folder / "ours.ply", folder / "back.spz", "--axes", "RDF", "--level", (3, 4, 2).index(version)
    )
    assert "axes: RDF" in said.out
    back = spz.decode((folder / "back.spz").read_bytes(), "back.spz", "RDF")
    np.testing.assert_allclose(back.means, gaussians().means, atol=STEP)


def _said(folder: Path, axes: str, version: int) -> None:
    """A record of the axes counts, and no option is needed."""
    record = struct.pack("<III", 0xADBE0003, 4, NUMBERS[axes])
    content = spz.encode(gaussians(), 0, axes)
    if version == 4:
        content = as_version_4(content, records=struct.pack("<II", 0x12340001, 3) + b"abc" + record)
    else:
        raw = bytearray(gzip.decompress(content))
        raw[14] |= 2
        content = gzip.compress(bytes(raw) + record)
    (folder / "said.spz").write_bytes(content)
    assert f"{axes} (" in done("info", folder / "said.spz").out
    said = done("convert", folder / "said.spz", folder / "ours.ply")
    assert f"axes {axes} " in said.err and "as its header says" in said.err
    np.testing.assert_allclose(load_ply(folder / "ours.ply").means, gaussians().means, atol=STEP)


def _drawn(folder: Path) -> None:
    """What is rendered with the right axes is what the PLY shows."""
    (folder / "theirs.spz").write_bytes(theirs(3))
    save_ply(folder / "ours.ply", spz.decode(theirs(3), "theirs.spz", "RDF"))
    frame = ("--frames", 1, "--size", "48x36")
    done("render", folder / "theirs.spz", "--axes", "RDF", *frame, "--out", folder / "a")
    done("render", folder / "ours.ply", *frame, "--out", folder / "b")
    done("render", folder / "theirs.spz", *frame, "--out", folder / "c")
    images = [read_image(next((folder / name).glob("*.png"))).astype(int) for name in "abc"]
    assert np.abs(images[0] - images[1]).max() <= 1 and np.abs(images[0] - images[2]).max() > 20


def _unknown(folder: Path) -> None:
    record = struct.pack("<III", 0xADBE0003, 4, 40)
    (folder / "new.spz").write_bytes(as_version_4(spz.encode(gaussians(), 0), records=record))
    line = refused("info", folder / "new.spz", names=folder / "new.spz")
    assert "number 40" in line
    refused("convert", folder / "new.spz", folder / "a.ply", "--axes", "UP", names="'UP'")
    assert command("convert", folder / "new.spz", folder / "a.splat").code == 2


CASES: dict[str, Callable[[Path], None]] = {
    **{f"axes of the PLY, version {version}": partial(_kept, version=version) for version in (2, 3, 4)},
    **{f"{axes}, said in version 4": partial(_said, axes=axes, version=4) for axes in NUMBERS},
    **{f"{axes}, said in version 3": partial(_said, axes=axes, version=3) for axes in NUMBERS},
    "drawn": _drawn,
    "axes that nobody knows": _unknown,
}
