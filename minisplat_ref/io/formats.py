"""A compact file format of Gaussians: a suffix, levels of precision, and a pair of functions.

A PLY stores every float. A format stores less, at one of several levels, and says how much may be lost. Formats belong
to extensions: ``minisplat_ref.extensions.extension.find_format`` finds them by the suffix of a file.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from minisplat_ref.errors import InputError
from minisplat_ref.io.atomic import replacing
from minisplat_ref.types import Gaussians


class Format(NamedTuple):
    """A compact file format of the six fields of 3DGS."""

    suffix: str
    """The end of the names of such files, including the dot."""
    summary: str
    """What it is, in half a line."""
    levels: tuple[str, ...]
    """Description of each level of precision; the finest, and usually largest, first."""
    default_level: int
    """Index of the level that is written by default."""
    encode: Callable[[Gaussians, int], bytes]
    """``encode(gaussians, level)``: a whole file. Raises InputError where a value does not fit the format."""
    decode: Callable[[bytes, str | Path], Gaussians]
    """``decode(content, source)`` of a whole file; float32, finite. Raises InputError, which names ``source``."""
    describe: Callable[[bytes, str | Path], list[tuple[str, str]]]
    """``describe(content, source)``: names and values that say what the file stores, and how precisely."""


def read_content(path: str | Path) -> bytes:
    """Return the bytes of a file.

    Raises
    ------
    InputError
        It cannot be read.
    """
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be opened ({error.strerror})") from None


def write_content(path: str | Path, content: bytes) -> None:
    """Write a file, complete or not at all.

    Raises
    ------
    InputError
        As for :func:`minisplat_ref.io.atomic.replacing`.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(content)
