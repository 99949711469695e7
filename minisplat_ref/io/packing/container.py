"""A container of packed bytes: magic, version, a JSON header, then one zstandard frame for each stream.

::

    magic      4 bytes
    version    uint16, little-endian
    length     uint32, of the header in bytes
    header     JSON; "streams" lists [name, bytes packed] in the order of the frames
    frames     back to back, to the end of the file

A frame holds its own checksum. No memory is allocated for a claimed size before it is checked to be possible: a
zstandard frame has blocks of at least 4 bytes (3 of header, 1 of content), each of which makes at most 2^17 bytes.
"""

import json
import struct
from collections.abc import Iterable, Mapping
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from minisplat_ref import memory
from minisplat_ref.errors import InputError
from minisplat_ref.interface.progress import progress_bar
from minisplat_ref.io.json_file import parse_json
from minisplat_ref.io.label import Label, from_json, to_json

# Parameters of zstandard. Bytes of quantised numbers hardly repeat, so entropy coding does most of the packing. The
# strongest parser with a short search is ten times as fast as level 19, and its files are 0.3 to 4 % larger.
PARAMETERS = {"window_log": 17, "hash_log": 15, "chain_log": 16, "search_log": 3}
LEVEL = 19  # the source of all other parameters
HEADER_MAX = 1 << 16  # bytes
LABEL = "label"  # the entry of a header that names the file's renderer
RATIO_MAX = 1 << 15  # bytes made of one packed byte: 2^17 of 4
AT_ONCE = 1 << 25  # bytes; of longer streams, which take seconds, a bar shows the progress, at other packed bytes
BLOCK = 1 << 20  # bytes between two moves of the bar
UNKNOWN_SIZE = -1  # of a frame that was written as a stream
WAY_OUT = "copy or export the file again"
Buffer = bytes | memoryview
_PREFIX = struct.Struct("<4sHI")


class Container(NamedTuple):
    """The magic and the version of a format."""

    magic: bytes
    """Four bytes."""
    version: int
    """The version that is written, and the only one that is read."""


class Packed(NamedTuple):
    """The parts of a file, still packed."""

    header: Mapping[str, Any]
    frames: Mapping[str, bytes]
    """Packed frames by the names of their streams."""
    source: str | Path
    """Name of the file, for messages."""


def _zstandard() -> Any:
    try:
        import zstandard
    except ImportError:
        raise InputError(
            "this format is packed by zstandard, which is not installed: pip install 'minisplat_ref[compression]'"
        ) from None
    return zstandard


def pack(container: Container, header: Mapping[str, Any], streams: Iterable[tuple[str, Buffer]]) -> bytes:
    """Return the content of a file.

    Parameters
    ----------
    container : Container
        Magic and version.
    header : mapping
        JSON values; less than 64 KiB of text.
    streams : iterable of pairs of str and bytes
        The names of the streams, and the streams before packing, which may be made one after the other.

    Raises
    ------
    InputError
        zstandard is not installed.
    """
    zstandard = _zstandard()
    parameters = zstandard.ZstdCompressionParameters.from_level(
        LEVEL, strategy=zstandard.STRATEGY_BTULTRA2, write_checksum=True, write_content_size=True, **PARAMETERS
    )
    compressor = zstandard.ZstdCompressor(compression_params=parameters)
    frames = {name: _compress(compressor, name, raw) for name, raw in streams}
    sizes = [[name, sum(map(len, parts))] for name, parts in frames.items()]
    text = json.dumps({**header, "streams": sizes}, separators=(",", ":")).encode()
    assert len(text) <= HEADER_MAX
    prefix = _PREFIX.pack(container.magic, container.version, len(text))
    return b"".join([prefix, text, *chain.from_iterable(frames.values())])


def _compress(compressor: Any, name: str, raw: Buffer) -> list[bytes]:
    """Return the parts of a frame of bytes, with a bar of progress; the name is that of the stream."""
    content = memoryview(raw)
    if len(content) <= AT_ONCE:
        return [compressor.compress(content)]
    frame = compressor.compressobj(size=len(content))
    packed = []
    with progress_bar(f"packing {name}", "MB", len(content)) as bar:
        for start in range(0, len(content), BLOCK):
            block = content[start : start + BLOCK]
            packed.append(frame.compress(block))
            bar.update(len(block))
    return [*packed, frame.flush()]


def pack_frame(raw: bytes) -> bytes:
    """Return bytes as a zstandard frame that states their number, for files with another layout.

    Raises
    ------
    InputError
        zstandard is not installed.
    """
    return b"".join(_compress(_zstandard().ZstdCompressor(level=LEVEL), "stream", raw))


def parse(container: Container, content: bytes, source: str | Path) -> Packed:
    """Check magic, version and sizes of a file, and return its header and its frames, still packed.

    Parameters
    ----------
    container : Container
        The magic and version to expect.
    content : bytes
        The whole file.
    source : str or Path
        Its name, for messages.

    Raises
    ------
    InputError
        It is another kind of file, of another version, or its sizes do not add up.
    """
    if len(content) < _PREFIX.size or content[:4] != container.magic:
        raise InputError(f"{source}: not an {_name(container)} file, it does not begin with {_name(container)}")
    _, version, length = _PREFIX.unpack_from(content)
    if version != container.version:
        raise InputError(
            f"{source}: {_name(container)} of version {version}, but this program reads version {container.version};"
            " convert it with the program that wrote it"
        )
    if length > min(HEADER_MAX, len(content) - _PREFIX.size):
        raise InputError(f"{source}: truncated or damaged, its header would have {length:,} bytes; {WAY_OUT}")
    begin = _PREFIX.size + length
    header = parse_json(content[_PREFIX.size : begin], source, WAY_OUT)
    sizes = header.get("streams") if isinstance(header, dict) else None
    if not isinstance(sizes, list) or not all(map(_is_size, sizes)) or len(dict(sizes)) < len(sizes):
        raise InputError(f"{source}: its header does not list its streams; {WAY_OUT}")
    claimed, found = sum(size for _, size in sizes), len(content) - begin
    if claimed != found:
        raise InputError(f"{source}: truncated or damaged, {claimed:,} bytes expected, {found:,} found; {WAY_OUT}")
    frames = {}
    for name, size in sizes:
        frames[name] = content[begin : begin + size]
        begin += size
    return Packed(header, frames, source)


def write_label(container: Container, content: bytes, label: Label) -> bytes:
    """Return the content of a file with a label in its header."""
    packed = parse(container, content, _name(container))
    header = json.dumps({**packed.header, LABEL: to_json(label)}, separators=(",", ":")).encode()
    assert len(header) <= HEADER_MAX
    return b"".join([_PREFIX.pack(container.magic, container.version, len(header)), header, *packed.frames.values()])


def read_label(container: Container, content: bytes, source: str | Path) -> Label:
    """Return the label in the header of a file.

    Raises
    ------
    InputError
        As for :func:`parse`, or it is damaged.
    """
    return from_json(parse(container, content, source).header.get(LABEL), source)


def _is_size(entry: Any) -> bool:
    return isinstance(entry, list) and len(entry) == 2 and isinstance(entry[0], str) and is_count(entry[1])


def _name(container: Container) -> str:
    return container.magic.decode("ascii").strip()


def is_count(value: Any, largest: int = 2**53) -> bool:
    """Return whether a value of a header is an integer from 0 to ``largest``; booleans are not."""
    return type(value) is int and 0 <= value <= largest


def unpack(packed: Packed, name: str, n_bytes: int) -> bytes:
    """Return the unpacked bytes of a stream, whose size is in the header.

    Parameters
    ----------
    packed : Packed
        The file.
    name : str
        Name of the stream.
    n_bytes : int
        Its size.

    Raises
    ------
    InputError
        There is no such stream, it holds another number of bytes, it is damaged, or it does not fit into memory.
    """
    frame = packed.frames.get(name)
    if frame is None:
        raise InputError(f"{packed.source}: damaged, it has no stream {name}; {WAY_OUT}")
    return unpack_frame(frame, n_bytes, name, packed.source)


def unpack_frame(frame: bytes, n_bytes: int, name: str, source: str | Path) -> bytes:
    """Decompress a zstandard frame; its size must match the header.

    Raises
    ------
    InputError
        As for :func:`unpack`; ``name`` is the stream's, for messages.
    """
    if n_bytes > RATIO_MAX * len(frame) or n_bytes > memory.free_bytes():
        raise InputError(
            f"{source}: its {name} would take {memory.as_text(n_bytes)}, made of {len(frame):,} bytes; {WAY_OUT}"
        )
    zstandard = _zstandard()
    try:
        if zstandard.frame_content_size(frame) not in (n_bytes, UNKNOWN_SIZE):
            raise InputError(f"{source}: damaged, its {name} do not have {n_bytes:,} bytes; {WAY_OUT}")
        raw = bytes(zstandard.ZstdDecompressor().decompress(frame, max_output_size=n_bytes))
    except zstandard.ZstdError as error:
        raise InputError(f"{source}: damaged, its {name} cannot be unpacked ({error}); {WAY_OUT}") from None
    if len(raw) != n_bytes:
        raise InputError(f"{source}: damaged, its {name} have {len(raw):,} bytes, not {n_bytes:,}; {WAY_OUT}")
    return raw
