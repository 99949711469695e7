"""Compact file formats of Gaussians: a suffix, levels of precision, and a pair of functions.

A PLY stores every float. A format stores less, at one of several levels, and describes the possible loss. Those of
other programs are here, :mod:`.catalogue`: ``.spz`` (:mod:`.spz`), Niantic's, versions 2 to 4; ``.splat``
(:mod:`.splat`), of the first viewers in the browser; ``.sog`` (:mod:`.sog`) and ``.compressed.ply``
(:mod:`.compressed_ply`), of SuperSplat and PlayCanvas; ``.glb`` (:mod:`.glb`), glTF with its extension for Gaussians;
and ``.ksplat`` (:mod:`.ksplat`), only read. An extension may bring further ones.
``minisplat_ref.extensions.extension.find_format`` finds all by the suffix of a file.

They hold the six fields of 3DGS; the fields of an extension need a PLY. An extension that renders these six in another
way is recorded in a file beside theirs (:mod:`minisplat_ref.io.label`).
"""

from collections.abc import Callable, Iterable
from io import BytesIO
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from zipfile import ZipFile

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.io.atomic import replacing
from minisplat_ref.io.json_file import parse_json
from minisplat_ref.io.label import NO_LABEL, Label, read_sidecar, write_sidecar
from minisplat_ref.io.names import name_inside
from minisplat_ref.types import Gaussians

# The frame of glTF is LUF (x left, y up, z forward), that of a scene RDF: a rotation by 180 degrees about z.
UNBUNDLED = "meta.json"  # of a SOG in a folder
GLTF_AXES = np.array([-1, -1, 1], np.float32)


class Format(NamedTuple):
    """A compact file format of the six fields of 3DGS."""

    suffix: str
    """The end of the names of such files, including the dot."""
    summary: str
    """A description of half a line."""
    levels: tuple[str, ...]
    """Description of each level of precision; the finest, and usually largest, first."""
    default_level: int
    """Index of the level that is written by default."""
    encode: Callable[[Gaussians, int], bytes]
    """``encode(gaussians, level)``: a whole file. Raises InputError where a value does not fit the format."""
    decode: Callable[[bytes, str | Path], Gaussians]
    """``decode(content, source)`` of a whole file; float32, finite. Raises InputError, which names ``source``."""
    describe: Callable[[Any, str | Path], list[tuple[str, str]]]
    """``describe(content, source)``: the content of the file and its precision, as names and values. Of a format with
    ``write``, the content may be a :func:`mapped` file."""
    write: Callable[[BinaryIO, Gaussians, int], None] | None = None
    """``write(file, gaussians, level)``: what ``encode`` returns, a piece at a time; None where that is much smaller
    than the Gaussians. Raises InputError, before anything is written."""
    write_label: Callable[[bytes, Label], bytes] | None = None
    """``write_label(content, label)``: the content with a label in it; None where there is no place for one, so that it
    goes into a sidecar."""
    read_label: Callable[[bytes, str | Path], Label] | None = None
    """``read_label(content, source)``: the label of ``write_label``, ``NO_LABEL`` without one. Raises InputError."""
    with_axes: Callable[[str], "Format"] | None = None
    """``with_axes(name)``: the format for files with these axes (:mod:`.axes`); None where all files have the same.
    Raises InputError."""
    describe_axes: Callable[[bytes, str | Path], str] | None = None
    """``describe_axes(content, source)``: the axes that a file is read with, and why. Raises InputError."""


def read_content(path: str | Path) -> bytes:
    """Return the bytes of a file.

    Raises
    ------
    InputError
        It cannot be read.
    """
    try:
        return bundle(Path(path)) if Path(path).name == UNBUNDLED else Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be opened ({error.strerror})") from None


def mapped(path: Path) -> memoryview:
    """Return the content of a file that is not empty, without a copy in memory."""
    with path.open("rb") as file:
        return memoryview(mmap(file.fileno(), 0, access=ACCESS_READ))


def bundle(meta: Path) -> bytes:
    """Return a SOG that is not packed, the folder of its ``meta.json``, as the one file that it would be.

    Raises
    ------
    InputError
        An image that it names is not in the folder.
    """
    packed = BytesIO()
    content = parse_json(meta.read_bytes(), meta, "export it again")
    parts = content.values() if isinstance(content, dict) else []
    lists = [part["files"] for part in parts if isinstance(part, dict) and isinstance(part.get("files"), list)]
    names = [name for files in lists for name in files if isinstance(name, str)]
    with ZipFile(packed, "w") as archive:
        archive.writestr(UNBUNDLED, meta.read_bytes())
        for name in dict.fromkeys(names):
            if not (meta.parent / name_inside(name, meta)).is_file():
                raise InputError(f"{meta}: {name} is not beside it; copy the whole folder")
            archive.write(meta.parent / name, name)
    return packed.getvalue()


def write_content(path: str | Path, content: bytes | Iterable[bytes]) -> None:
    """Write a file, or the parts of one, complete or not at all.

    Raises
    ------
    InputError
        As for :func:`minisplat_ref.io.atomic.replacing`.
    """
    with replacing(path) as temporary:
        if isinstance(content, bytes):
            temporary.write_bytes(content)
        else:
            with temporary.open("wb") as file:
                file.writelines(content)


def with_label(format_: Format, content: bytes, label: Label) -> bytes:
    """Return the content of a file with its label, where the format has a place for it and there is one."""
    return content if label == NO_LABEL or format_.write_label is None else format_.write_label(content, label)


def write_file(path: Path, format_: Format, content: bytes | Callable[[BinaryIO], None], label: Label) -> None:
    """Write a compact file with its label in the content if the format has a place for it, and else beside it.

    Parameters
    ----------
    path : Path
    format_ : Format
    content : bytes or callable
        Of the file, or what writes it into an open file.
    label : Label

    Raises
    ------
    InputError
        As for :func:`write_content`, or another program's file is where the label should be; nothing is written then.
    """
    with replacing(path) as temporary:
        if isinstance(content, bytes):
            temporary.write_bytes(content)
        else:
            with temporary.open("wb") as file:
                content(file)
        if format_.write_label is None:  # first, so that the file is never there without it
            write_sidecar(path, temporary, label)


def label_of(path: Path, format_: Format, content: bytes) -> Label:
    """Return the label of a compact file, in it or beside it.

    Raises
    ------
    InputError
        The file or its label is damaged.
    """
    return read_sidecar(path, content) if format_.read_label is None else format_.read_label(content, path)
