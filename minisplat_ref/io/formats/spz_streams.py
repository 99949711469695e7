"""The container of SPZ version 4: a plain header, records of vendors, a table, and six zstandard frames.

::

    magic, version, number of Gaussians     3 x uint32, little-endian
    SH degree, fractional bits, flags       3 x uint8
    number of streams                       uint8
    offset of the table                     uint32
    reserved                                12 bytes
    records of vendors                      up to the table, if flag 2 is set: type, bytes, 2 x uint32, content
    table                                   for each stream: bytes packed, bytes unpacked, 2 x uint64
    streams                                 one zstandard frame each

The streams are those of version 3, in its order, each for all Gaussians: centres, opacities, colours, scales,
rotations, harmonics. splat-transform and Niantic's library write this version by default since 2026.
"""

import struct
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from minisplat_ref.errors import InputError
from minisplat_ref.io.packing.container import pack_frame, unpack_frame

MAGIC = 0x5053474E  # "NGSP"
VERSION = 4
HEADER = struct.Struct("<IIIBBBBI12x")
HAS_RECORDS = 2  # flag
ENTRY = struct.Struct("<QQ")
WAY_OUT = "copy or export the file again"


class Streams(NamedTuple):
    """A file of version 4, its streams still packed."""

    n: int
    sh_degree: int
    fractional_bits: int
    frames: tuple[bytes, ...]
    """Packed, in the order of the file."""
    sizes: tuple[int, ...]
    """Bytes of each, unpacked, according to the table."""
    records: bytes
    """Of vendors."""


def pack(n: int, sh_degree: int, fractional_bits: int, parts: Iterable[bytes], records: bytes = b"") -> bytes:
    """Return the content of a file.

    Parameters
    ----------
    n, sh_degree, fractional_bits : int
        Of the header.
    parts : iterable of bytes
        The six streams, in the order of the file.
    records : bytes
        Of vendors.

    Raises
    ------
    InputError
        zstandard is not installed.
    """
    frames, sizes = [], []
    for part in parts:
        frames.append(pack_frame(part))
        sizes.append(len(part))
    flags, begin = HAS_RECORDS if records else 0, HEADER.size + len(records)
    header = HEADER.pack(MAGIC, VERSION, n, sh_degree, fractional_bits, flags, len(frames), begin)
    table = [ENTRY.pack(len(frame), size) for frame, size in zip(frames, sizes, strict=True)]
    return b"".join([header, records, *table, *frames])


def parse(content: bytes, source: str | Path) -> Streams:
    """Return header and packed streams of a file.

    Raises
    ------
    InputError
        It is of another version, or truncated.
    """
    if len(content) < HEADER.size:
        raise InputError(f"{source}: truncated, {len(content)} bytes are no header; {WAY_OUT}")
    _, version, n, sh_degree, fractional_bits, flags, n_streams, begin = HEADER.unpack_from(content)
    if version != VERSION:
        raise InputError(f"{source}: SPZ of version {version}, which is not supported: export it as version 2, 3 or 4")
    end = begin + n_streams * ENTRY.size
    if begin < HEADER.size or end > len(content):
        raise InputError(f"{source}: truncated or damaged, its table would end at byte {end:,}; {WAY_OUT}")
    table = [ENTRY.unpack_from(content, begin + i * ENTRY.size) for i in range(n_streams)]
    claimed, found = sum(packed for packed, _ in table), len(content) - end
    if claimed > found:
        raise InputError(f"{source}: truncated, {claimed:,} bytes of streams expected, {found:,} found; {WAY_OUT}")
    records = content[HEADER.size : begin] if flags & HAS_RECORDS else b""
    frames = []
    for packed, _ in table:
        frames.append(content[end : end + packed])
        end += packed
    return Streams(n, sh_degree, fractional_bits, tuple(frames), tuple(size for _, size in table), records)


def unpack(streams: Streams, sizes: Mapping[str, int], source: str | Path) -> bytes:
    """Return all streams, one after the other as in version 3.

    Parameters
    ----------
    streams : Streams
    sizes : mapping
        Bytes per Gaussian of each stream by its name, in the order of the file.
    source : str or Path

    Raises
    ------
    InputError
        A stream is missing, damaged or of another size than its Gaussians need, or zstandard is not installed.
    """
    parts = []
    for i, (name, size) in enumerate(sizes.items()):
        n_bytes = streams.n * size
        if n_bytes == 0:
            continue
        if i >= len(streams.frames) or streams.sizes[i] != n_bytes:
            found = streams.sizes[i] if i < len(streams.frames) else 0
            raise InputError(f"{source}: damaged, its {name} have {found:,} bytes, not {n_bytes:,}; {WAY_OUT}")
        parts.append(unpack_frame(streams.frames[i], n_bytes, name, source))
    return b"".join(parts)
