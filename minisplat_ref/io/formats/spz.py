"""``.spz``: Niantic's format, versions 2 to 4.

A file is a gzip stream, in version 4 a plain header and a zstandard frame for each part (:mod:`.spz_streams`). It holds
a header of 16 bytes (magic, version, number N, degree of the spherical harmonics, fractional bits, flags) and then,
each for all Gaussians, centres, opacities, colours, scales, rotations and higher harmonics.

===========  ==========================================================================================
centres      3 x 24 bits, two's complement, in steps of ``2^-b``, for the b fractional bits of the header
opacity      ``255 o``
colour       ``255 (0.15 c + 0.5)`` of the coefficient c of degree 0, which is not its colour
scales       ``16 (ln s + 10)``, 8 bits, so from e^-10 to e^5.94
rotation     version 2: x, y, z as ``127.5 (q + 1)`` with w >= 0; version 3: 2 bits say which of x, y, z, w is largest,
             and of the others each has its sign and 9 bits of ``511 sqrt(2) |q|``, the first in the highest bits
harmonics    ``128 c + 128``, to a multiple of 8 for degree 1 and of 16 above; RGB last
===========  ==========================================================================================

Colours, scales and harmonics outside their ranges are clipped. Of the fractional bits we write 12, as Niantic does, so
that centres reach 2048; fewer if one is further away, more if the Gaussians are so small that they would move by much
of their size. Values that neither version can hold are refused.

**Axes.** The specification says RUB (x right, y up, z backward), as in OpenGL; a PLY of 3DGS has RDF (x right, y down,
z forward). So y and z change sign, a rotation by 180 degrees around x (:mod:`.axes`). Programs disagree: Niantic's
library converts on request only, its own converters of the first versions did not, and splat-transform reads and writes
RUB up to 2.7.1 and the axes of the PLY in 3.7.0, as gsply does. A file says which it has only in the record
``SPZ_ADOBE_coordinate_system``, which we read, in version 4 before the table and in others behind the Gaussians, and
write with other axes than RUB in version 4. Without it they are RUB, unless the user names others.

Opacities 0 and 1 have no logit. They are read as a quarter of a quantisation level away from the end.

Left out are version 1 (half floats), harmonics of degree 4, which are dropped with a warning, other records of
vendors, and the flag that a scene was trained with antialiasing, which is ignored when read and written as
0.
"""

import math
import struct
import warnings
import zlib
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref import memory
from minisplat_ref.constants import SH_DEGREE_MAX
from minisplat_ref.errors import InputError, InputWarning, one_line
from minisplat_ref.interface.progress import progress_bar
from minisplat_ref.io.formats import Format, spz_streams
from minisplat_ref.io.formats.axes import AXES, OURS, check_axes, describe_axes, ours_from, turn
from minisplat_ref.io.formats.levels8 import opacities_of
from minisplat_ref.io.packing.deflating import gzip_compressor
from minisplat_ref.io.packing.pieces import pieces
from minisplat_ref.types import Floats, Gaussians, Ints
from minisplat_ref.validation import check_gaussians

MAGIC = spz_streams.MAGIC
VERSIONS = (3, 4, 2)  # as levels: the finest first; 3 and 4 hold the same numbers, and every reader of 4 reads 3
GZIPPED = (2, 3)
FRACTIONAL_BITS, FRACTIONAL_BITS_MAX = 12, 23
STEP_MAX = 0.1  # of the median of the largest scales; the step of 12 bits is about 0.02 of it in a usual scene
LOG_SCALE_MIN = -10.0
SMALLER_SHARE = 0.01  # of the Gaussians, from which on a warning reports that they are smaller than that
COLOR_SCALE = 0.15
SH_BITS = {1: 5, 2: 4, 3: 4}  # by degree
BLOCK = 1 << 20  # bytes between two moves of the progress bar
GZIP_RATIO_MAX = 1032  # bytes made of one, by deflate
HEADER = struct.Struct("<IIIBBBB")
_NUMBER = struct.Struct("<I")
WAY_OUT = "copy or export the file again"
BYTES_OF_REST = (0, 9, 24, 45, 72)  # by degree

SPECIFIED = "RUB"
COORDINATE_SYSTEM = 0xADBE0003  # the record SPZ_ADOBE_coordinate_system: its place in AXES, from 1, as uint32; 0: none
RECORD = struct.Struct("<II")
RECORDS_MAX = 1 << 16  # bytes that are looked through


class _Header(NamedTuple):
    version: int
    n: int
    sh_degree: int
    fractional_bits: int
    axes: str | None
    """According to a record; None where there is none."""

    @property
    def sizes(self) -> dict[str, int]:
        """Bytes per Gaussian of each attribute, in the order of the file."""
        rotation = 3 if self.version == 2 else 4
        rest = BYTES_OF_REST[self.sh_degree]
        return {"means": 9, "opacities": 1, "colors": 3, "scales": 3, "rotations": rotation, "sh_rest": rest}


def encode(gaussians: Gaussians, level: int, axes: str = SPECIFIED) -> bytes:
    """Return the content of a file that holds the Gaussians.

    Parameters
    ----------
    gaussians : Gaussians
        In the world frame of a PLY.
    level : int
        0 writes version 3, 1 version 4, 2 version 2.
    axes : str
        Those of the file; version 4 has a record of others than RUB.

    Raises
    ------
    InputError
        A value is not finite, a centre is out of range, or version 4 needs zstandard, which is not installed.
    """
    check_gaussians(gaussians, "Gaussians")
    n, n_rest = gaussians.sh_rest.shape[:2]
    to_file = ours_from(axes).T
    fractional_bits = _fractional_bits(gaussians.means.astype(np.float64), gaussians.log_scales)
    sh_degree, version = math.isqrt(n_rest + 1) - 1, VERSIONS[level]
    header = _Header(version, n, sh_degree, fractional_bits, axes)
    parts = {name: np.empty((n, size), np.uint8) for name, size in header.sizes.items()}
    for part in pieces(n):
        rows = turn(Gaussians(*(field[part] for field in gaussians)), to_file)
        for values, into in zip(_encode_rows(rows, header), parts.values(), strict=True):
            into[part] = values.reshape(into[part].shape)
    if version == spz_streams.VERSION:
        record = b"" if axes == SPECIFIED else RECORD.pack(COORDINATE_SYSTEM, 4) + _NUMBER.pack(AXES.index(axes) + 1)
        return spz_streams.pack(n, sh_degree, fractional_bits, (part.tobytes() for part in parts.values()), record)
    n_bytes = HEADER.size + sum(part.nbytes for part in parts.values())
    compressor = gzip_compressor(n_bytes)
    packed = [compressor.compress(HEADER.pack(MAGIC, version, n, sh_degree, fractional_bits, 0, 0))]
    with progress_bar("packing", "MB", n_bytes) as bar:
        for values in parts.values():
            flat = values.reshape(-1).data
            for i in range(0, len(flat), BLOCK):
                packed.append(compressor.compress(flat[i : i + BLOCK]))
                bar.update(len(flat[i : i + BLOCK]))
    return b"".join([*packed, compressor.flush()])


def _encode_rows(rows: Gaussians, header: _Header) -> tuple[NDArray, ...]:
    """Return the bytes of Gaussians in the axes of the file, attribute by attribute in its order."""
    steps = np.floor(rows.means.astype(np.float64) * 2.0**header.fractional_bits + 0.5)  # [n, 3]
    opacities = opacities_of(rows.opacity_logits.astype(np.float64))
    quats = rows.quats.astype(np.float64)
    return (
        steps.astype("<i4").reshape(-1, 1).view(np.uint8)[:, :3],
        _to_bytes(255.0 * opacities),
        _to_bytes(255.0 * (COLOR_SCALE * rows.sh_dc.astype(np.float64) + 0.5)),
        _to_bytes(16.0 * (rows.log_scales.astype(np.float64) + 10.0)),
        _to_vector(quats) if header.version == 2 else _to_smallest_three(quats).view(np.uint8),
        _to_buckets(128.0 * rows.sh_rest),
    )


def _fractional_bits(means: Floats, log_scales: Floats) -> int:
    """Return the number of fractional bits by which all centres [N, 3] are in reach and none moves by much.

    Raises
    ------
    InputError
        There is none, or most Gaussians are of a size that the format does not hold.
    """
    if not len(means):
        return FRACTIONAL_BITS
    sizes = log_scales.max(axis=1)  # [N]
    n_smaller = np.count_nonzero(sizes < LOG_SCALE_MIN)
    size, reach = float(np.exp(np.median(sizes))), float(np.abs(means).max())
    if 2 * n_smaller > len(sizes):
        raise InputError(
            f"SPZ holds scales from {math.exp(LOG_SCALE_MIN):.2g} on, but {n_smaller:,} of {len(sizes):,} Gaussians are"
            f" smaller, the median is {size:.2g}: scale the scene, or choose another format"
        )
    if n_smaller > SMALLER_SHARE * len(sizes):
        message = (
            f"SPZ holds scales from {math.exp(LOG_SCALE_MIN):.2g} on: {n_smaller:,} of {len(sizes):,} Gaussians are"
            " smaller, and become larger"
        )
        warnings.warn(one_line(message), InputWarning, stacklevel=3)
    bits_max = FRACTIONAL_BITS_MAX
    while bits_max >= 0 and math.floor(reach * 2.0**bits_max + 0.5) >= 2**23:
        bits_max -= 1
    bits = min(max(FRACTIONAL_BITS, math.ceil(-math.log2(STEP_MAX * size))), bits_max)
    if bits < 0 or (bits < FRACTIONAL_BITS and 2.0**-bits > STEP_MAX * size):
        row = int(np.argmax(np.abs(means).max(axis=1)))
        raise InputError(
            f"the centre of row {row} is {reach:.6g} away, where SPZ has steps of {2.0 ** -max(bits, 0):g}, and the"
            f" median size is {size:.2g}: move the scene to the origin, remove what is far away, or choose another"
            " format"
        )
    return bits


def _to_bytes(values: Floats) -> NDArray[np.uint8]:
    return np.clip(np.floor(values + 0.5), 0, 255).astype(np.uint8)


def _to_buckets(values: Floats) -> NDArray[np.uint8]:
    """Return ``128 c`` [N, K-1, 3] rounded to multiples of a bucket, plus 128."""
    n_rest = values.shape[1]
    degrees = np.repeat([1, 2, 3], [3, 5, 7])[:n_rest]
    bucket = np.array([2.0 ** (8 - SH_BITS[int(degree)]) for degree in degrees])[:, None]  # [K-1, 1]
    return _to_bytes(bucket * np.floor((np.floor(values + 0.5) + 128.0 + bucket / 2) / bucket))


def _to_vector(quats: Floats) -> NDArray[np.uint8]:
    """Return x, y, z of unit quaternions with w >= 0, in one byte each."""
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True) * np.where(quats[:, :1] < 0, -1.0, 1.0)
    return _to_bytes(127.5 * (quats[:, 1:] + 1.0))


def _from_vector(raw: NDArray[np.uint8]) -> Floats:
    xyz = raw.astype(np.float64) / 127.5 - 1.0  # [N, 3]
    w = np.sqrt(np.maximum(0.0, 1.0 - (xyz**2).sum(axis=1, keepdims=True)))
    return np.concatenate([w, xyz], axis=1)


def _to_smallest_three(quats: Floats) -> NDArray[np.uint32]:
    """Return unit quaternions in 32 bits, without their largest component, which is made positive."""
    xyzw = np.roll(quats / np.linalg.norm(quats, axis=1, keepdims=True), -1, axis=1)  # [N, 4]
    largest = np.argmax(np.abs(xyzw), axis=1)  # [N]
    xyzw *= np.where(np.take_along_axis(xyzw, largest[:, None], axis=1) < 0, -1.0, 1.0)
    others = xyzw[np.arange(4) != largest[:, None]].reshape(-1, 3)
    magnitudes = np.minimum(511, np.floor(511.0 * math.sqrt(2.0) * np.abs(others) + 0.5)).astype(np.uint32)
    words = magnitudes | (others < 0).astype(np.uint32) << np.uint32(9)  # [N, 3]
    packed = words[:, 0] << np.uint32(20) | words[:, 1] << np.uint32(10) | words[:, 2]
    return (packed | largest.astype(np.uint32) << np.uint32(30)).astype("<u4")


def _from_smallest_three(raw: NDArray[np.uint8]) -> Floats:
    packed = raw.reshape(-1).view("<u4").astype(np.int64)  # [N]
    words = np.stack([packed >> 20, packed >> 10, packed], axis=1) & 1023  # [N, 3]
    others = (words & 511) / (511.0 * math.sqrt(2.0)) * np.where(words & 512, -1.0, 1.0)
    xyzw = np.empty((len(packed), 4))
    is_largest = np.arange(4) == (packed >> 30)[:, None]
    xyzw[is_largest] = np.sqrt(np.maximum(0.0, 1.0 - (others**2).sum(axis=1)))
    xyzw[~is_largest] = others.reshape(-1)
    return np.roll(xyzw, 1, axis=1)


def decode(content: bytes, source: str | Path, axes: str | None = None) -> Gaussians:
    """Return the Gaussians of a file, float32, in the world frame of a PLY.

    Parameters
    ----------
    content : bytes
        The whole file.
    source : str or Path
        Its name, for messages.
    axes : str, optional
        Those that the file has; by default what it says itself, and RUB if it says nothing.

    Raises
    ------
    InputError
        The file is damaged, of another kind or version, or claims more than it holds.
    """
    header, body = _parse(content, source)
    raw: dict[str, NDArray[np.uint8]] = {}
    begin = 0
    for name, size in header.sizes.items():
        part = np.frombuffer(body, np.uint8, header.n * size, begin)
        raw[name] = part.reshape(header.n, size)
        begin += header.n * size
    # Three bytes become the upper ones of four, so that an arithmetic shift extends the sign.
    words = np.zeros((header.n, 3, 4), np.uint8)
    words[..., 1:] = raw["means"].reshape(header.n, 3, 3)
    steps: Ints = words.view("<i4")[..., 0] >> 8  # [N, 3]
    levels = np.clip(raw["opacities"][:, 0].astype(np.float64), 0.25, 254.75)  # [N]
    unpack_rotations: Any = _from_vector if header.version == 2 else _from_smallest_three
    n_rest = min(header.sizes["sh_rest"] // 3, (SH_DEGREE_MAX + 1) ** 2 - 1)
    if header.sh_degree > SH_DEGREE_MAX:
        message = f"{source}: its harmonics of degree {header.sh_degree} are cut off at degree {SH_DEGREE_MAX}"
        warnings.warn(one_line(message), InputWarning, stacklevel=2)
    sh_rest = (
        raw["sh_rest"].reshape(header.n, header.sizes["sh_rest"] // 3, 3)[:, :n_rest].astype(np.float32) - 128
    ) / 128
    fields = (
        steps * 2.0**-header.fractional_bits,
        unpack_rotations(raw["rotations"]),
        raw["scales"] / 16.0 - 10.0,
        np.log(levels / (255.0 - levels)),
        (raw["colors"] / 255.0 - 0.5) / COLOR_SCALE,
        sh_rest,
    )
    gaussians = Gaussians(*(field.astype(np.float32) for field in fields))
    gaussians = turn(gaussians, ours_from(axes or header.axes or SPECIFIED))
    check_gaussians(gaussians, source)
    return gaussians


def _parse(content: bytes, source: str | Path) -> tuple[_Header, bytes]:
    """Return the header and all that follows it, after checking the header."""
    if content[:4] == struct.pack("<I", MAGIC):
        streams = spz_streams.parse(content, source)
        axes = _recorded_axes(streams.records, source)
        header = _Header(spz_streams.VERSION, streams.n, streams.sh_degree, streams.fractional_bits, axes)
        _check_header(header, source)
        return header, spz_streams.unpack(streams, header.sizes, source)
    if content[:2] != b"\x1f\x8b":
        raise InputError(f"{source}: not an SPZ file, it is not packed by gzip; give one that ends in .spz")
    head, _ = _inflate(content, HEADER.size, source)
    if len(head) < HEADER.size or HEADER.unpack(head)[0] != MAGIC:
        raise InputError(f"{source}: not an SPZ file, its content does not begin with NGSP; {WAY_OUT}")
    _, version, n, degree, fractional_bits, flags, _ = HEADER.unpack(head)
    if version not in GZIPPED:
        raise InputError(f"{source}: SPZ of version {version}, which is not supported: export it as version 2, 3 or 4")
    header = _Header(version, n, degree, fractional_bits, None)
    _check_header(header, source)
    n_bytes = HEADER.size + n * sum(header.sizes.values())
    if n_bytes > min(GZIP_RATIO_MAX * len(content), memory.free_bytes()):
        raise InputError(f"{source}: {n:,} Gaussians cannot be in {len(content):,} packed bytes; {WAY_OUT}")
    body, is_whole = _inflate(content, n_bytes + (RECORDS_MAX if flags & spz_streams.HAS_RECORDS else 0), source)
    if len(body) < n_bytes or not is_whole:
        raise InputError(
            f"{source}: truncated, {n_bytes:,} bytes and their end expected, {len(body):,} found; {WAY_OUT}"
        )
    header = header._replace(axes=_recorded_axes(body[n_bytes:], source))
    return header, body[HEADER.size : n_bytes]


def _recorded_axes(records: bytes, source: str | Path) -> str | None:
    """Return the axes that the records of vendors name; None if none does, or it leaves them open."""
    begin = 0
    while begin + RECORD.size <= len(records):
        kind, length = RECORD.unpack_from(records, begin)
        begin += RECORD.size
        if kind == COORDINATE_SYSTEM and length == _NUMBER.size and begin + length <= len(records):
            (number,) = _NUMBER.unpack_from(records, begin)
            if number > len(AXES):
                raise InputError(f"{source}: its record of axes has the number {number}, of {len(AXES)}; {WAY_OUT}")
            return AXES[number - 1] if number else None
        begin += length
    return None


def _check_header(header: _Header, source: str | Path) -> None:
    """Refuse a header of which two numbers are impossible."""
    if header.sh_degree >= len(BYTES_OF_REST) or header.fractional_bits > FRACTIONAL_BITS_MAX:
        raise InputError(
            f"{source}: damaged, spherical harmonics of degree {header.sh_degree} and {header.fractional_bits}"
            f" fractional bits; {WAY_OUT}"
        )


def _inflate(content: bytes, n_bytes: int, source: str | Path) -> tuple[bytes, bool]:
    """Return the first ``n_bytes`` of a gzip stream, and whether more follow or it ends with the right checksum."""
    try:
        gzip = zlib.decompressobj(31)
        head = gzip.decompress(content, n_bytes)
        more = gzip.decompress(gzip.unconsumed_tail, 1)
        return head, bool(more) or gzip.eof
    except zlib.error as error:
        raise InputError(f"{source}: damaged, it cannot be unpacked ({error}); {WAY_OUT}") from None


def describe_file_axes(content: bytes, source: str | Path, axes: str | None = None) -> str:
    """Return the axes that a file is read with, and why, in a few words; arguments and errors as for :func:`decode`."""
    header, _ = _parse(content, source)
    return _describe_axes(header, axes)


def _describe_axes(header: _Header, axes: str | None) -> str:
    if axes is not None:
        return f"{describe_axes(axes)}, as --axes says"
    if header.axes is not None:
        return f"{describe_axes(header.axes)}, as its header says"
    return f"{describe_axes(SPECIFIED)}, as the specification says; --axes {OURS} if that turns the scene about x"


def describe(content: bytes, source: str | Path, axes: str | None = None) -> list[tuple[str, str]]:
    """Return version, axes and error bounds of the values of a file, as pairs of name and text.

    Raises
    ------
    InputError
        The file is refused, as by :func:`decode`.
    """
    header, _ = _parse(content, source)
    return [
        ("SPZ version", str(header.version)),
        ("axes", _describe_axes(header, axes)),
        ("centres", f"within {2.0 ** (-header.fractional_bits - 1):.3g} world units along each axis"),
        ("scales", f"within {100 * math.expm1(1 / 32):.2g} %, between e^-10 and e^5.94"),
        ("opacities", f"within {0.5 / 255:.2g}"),
        ("SH coefficients", f"within {0.5 / 255 / COLOR_SCALE:.2g} (degree 0), {4 / 128:.2g} and {8 / 128:.2g}"),
    ]


def with_axes(axes: str) -> Format:
    """Return the format for files with these axes, whatever they say.

    Raises
    ------
    InputError
        There are no such axes.
    """
    axes = check_axes(axes)
    return SPZ._replace(
        encode=partial(encode, axes=axes),
        decode=partial(decode, axes=axes),
        describe=partial(describe, axes=axes),
        describe_axes=partial(describe_file_axes, axes=axes),
    )


SPZ = Format(
    suffix=".spz",
    summary="Niantic's, versions 3, 4 and 2",
    levels=tuple(f"version {version}" for version in VERSIONS),
    default_level=0,
    encode=encode,
    decode=decode,
    describe=describe,
    with_axes=with_axes,
    describe_axes=describe_file_axes,
)
"""The format that other programs read, too."""
