"""Binary files of a COLMAP model, record by record, none of them ever in memory as a whole.

pycolmap takes missing bytes for counts and hangs, so a file is walked before it is read; and what a training does not
need of a model, the 2D features, is nearly all of it, so the walk passes over them.
"""

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from minisplat_ref.errors import InputError

N_COUNT = 8  # bytes of a file's number of records
N_NAME = 256  # bytes that are read at once in search of a name's end


class Layout(NamedTuple):
    """Of a binary file of COLMAP: a count of records, each fixed bytes, a name, and a counted list of items."""

    n_fixed: int
    """Bytes before the name or the count."""
    has_name: bool
    """Whether a zero-terminated name follows."""
    count_format: str
    """Of the number of items, for :mod:`struct`."""
    n_item: int
    """Bytes of an item: a 2D feature, or an element of a track."""


class Record(NamedTuple):
    """What a record has before its items."""

    head: bytes
    """The fixed bytes."""
    name: bytes
    """Empty without one."""
    items: bytes
    """Empty where they were passed over."""


LAYOUTS = {
    "images.bin": Layout(n_fixed=64, has_name=True, count_format="<Q", n_item=24),
    "points3D.bin": Layout(n_fixed=43, has_name=False, count_format="<Q", n_item=8),
    "frames.bin": Layout(n_fixed=64, has_name=False, count_format="<I", n_item=16),
}


def read_records(file: Path, with_items: bool = False) -> Iterator[Record]:
    """Yield the records of a file, whose name says which layout it has.

    Parameters
    ----------
    file : Path
        One of :data:`LAYOUTS`.
    with_items : bool
        Read the items too, instead of passing over them.

    Raises
    ------
    InputError
        The file ends before its last record.
    """
    layout, n_bytes = LAYOUTS[file.name], file.stat().st_size
    count = struct.Struct(layout.count_format)
    with file.open("rb") as opened:
        try:
            for _ in range(struct.unpack("<Q", opened.read(N_COUNT))[0]):
                head, name = opened.read(layout.n_fixed), _read_name(opened) if layout.has_name else b""
                length = count.unpack(opened.read(count.size))[0] * layout.n_item
                if opened.tell() + length > n_bytes:
                    raise EOFError
                items = opened.read(length) if with_items else b""
                if not with_items:
                    opened.seek(length, os.SEEK_CUR)
                yield Record(head, name, items)
        except (struct.error, EOFError, OverflowError):  # the last of a count that no range has
            raise InputError(f"{file}: truncated at {n_bytes} bytes; copy or export it again") from None


def check_records(file: Path) -> None:
    """Refuse a file that ends before its last record."""
    for _ in read_records(file):
        pass


def without_items(record: Record, layout: Layout) -> bytes:
    """Return the bytes of a record whose list of items is empty."""
    name = record.name + b"\0" if layout.has_name else b""
    return record.head + name + struct.pack(layout.count_format, 0)


def _read_name(opened: BinaryIO) -> bytes:
    """Return what is before the next zero byte, and go on behind it."""
    name = b""
    while (end := name.find(b"\0")) < 0:
        block = opened.read(N_NAME)
        if not block:
            raise EOFError
        name += block
    opened.seek(end + 1 - len(name), os.SEEK_CUR)
    return name[:end]
