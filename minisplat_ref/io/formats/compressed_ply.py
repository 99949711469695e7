"""``.compressed.ply``: SuperSplat's PLY of 16 bytes for each Gaussian, whose values lie between bounds of their chunk.

A chunk is 256 Gaussians in Morton order. The element ``chunk`` has the bounds of each chunk's centres, log-scales and
colours, 18 floats; files of older writers lack the colours', which then lie in [0, 1]. The element ``vertex`` has four
words of 32 bits:

========= ==============================================================================================
position  11, 10 and 11 bits for x, y, z, x highest, between the bounds
scale     the same of log-scales, of which the bounds are clipped to [-20, 20]
rotation  2 bits for which of w, x, y, z is largest, 10 bits for each of the others: ``q / sqrt(2) + 1/2``
color     8 bits each for red, green, blue (``0.5 + SH_C0 c``, between the bounds) and opacity
========= ==============================================================================================

The element ``sh``, if there are harmonics, has them in the order of the PLY, channel by channel, as bytes b that mean
``8 ((b + 1/2) / 256 - 1/2)``; 0 and 255 mean -4 and 4. The frame is that of the PLY.
"""

from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.constants import SH_C0, SH_DEGREE_MAX
from minisplat_ref.errors import InputError
from minisplat_ref.io.formats import Format
from minisplat_ref.io.formats.levels8 import (
    WAY_OUT,
    check_float32,
    decode_logits,
    drop_largest,
    finish,
    opacity_bytes,
    refuse_size,
    restore_largest,
)
from minisplat_ref.io.packing.morton import morton_order
from minisplat_ref.io.packing.pieces import pieces, rows_of
from minisplat_ref.io.ply_file import read_header
from minisplat_ref.types import Floats, Gaussians

CHUNK = 256  # Gaussians
LOG_SCALE_MAX = 20.0
SH_RANGE = 8.0
GROUPS = (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
BOUNDS = tuple(f"{end}_{name}" for group in GROUPS for end in ("min", "max") for name in group)
WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
BITS = np.array([11, 10, 11])


class _Parts(NamedTuple):
    """A file, cut into its elements."""

    bounds: Floats
    """[C, 3, 2, 3]: position, scale or colour; smallest and largest; axis."""
    words: NDArray[np.uint32]
    """[N, 4]"""
    sh_rest: NDArray[np.uint8]
    """[N, 3 (K-1)], channel-major."""


def encode(gaussians: Gaussians, level: int) -> bytes:
    """Return the content of a file, with the Gaussians in Morton order; it has one level.

    Raises
    ------
    InputError
        A value is not finite, or beyond float32.
    """
    check_float32(gaussians)
    order = morton_order(gaussians.means)
    n, n_rest = gaussians.sh_rest.shape[:2]
    n_chunks = -(-n // CHUNK)
    bounds, words = np.zeros((n_chunks, 3, 2, 3), "<f4"), np.empty((n, 4), "<u4")
    rest = np.empty((n, 3, n_rest), np.uint8)
    for part in pieces(n):  # of whole chunks
        rows = rows_of(gaussians, order[part])
        chunks = slice(part.start // CHUNK, -(-part.stop // CHUNK))
        bounds[chunks], words[part] = _encode_words(rows)
        rest[part] = np.clip(np.floor(256.0 * (rows.sh_rest / SH_RANGE + 0.5)), 0, 255).transpose(0, 2, 1)
    lines = [
        *("ply", "format binary_little_endian 1.0", f"element chunk {n_chunks}"),
        *(f"property float {name}" for name in BOUNDS),
        f"element vertex {n}",
        *(f"property uint {name}" for name in WORDS),
        *([f"element sh {n}"] if n_rest else []),
        *(f"property uchar f_rest_{i}" for i in range(3 * n_rest)),
        "end_header\n",
    ]
    return b"".join(["\n".join(lines).encode(), bounds.data, words.data, rest.data])


def _encode_words(rows: Gaussians) -> tuple[Floats, NDArray[np.uint32]]:
    """Return the bounds [C, 3, 2, 3] of chunks, float32, and the words [n, 4] of their Gaussians."""
    n = len(rows.means)
    values = np.stack(
        [rows.means, np.clip(rows.log_scales, -LOG_SCALE_MAX, LOG_SCALE_MAX), 0.5 + SH_C0 * rows.sh_dc], axis=1
    )  # [n, 3, 3]
    begins = np.arange(0, n, CHUNK)
    bounds = np.stack([np.minimum.reduceat(values, begins), np.maximum.reduceat(values, begins)], axis=2, dtype="<f4")
    low, high = np.moveaxis(bounds.astype(np.float64)[np.arange(n) // CHUNK], 2, 0)  # [n, 3, 3] each
    shares = np.clip((values - low) / np.where(high > low, high - low, 1.0), 0.0, 1.0)
    largest, others = drop_largest(rows.quats)
    words = np.empty((n, 4), "<u4")
    words[:, 0] = _pack(shares[:, 0], BITS)
    words[:, 1] = largest.astype(np.uint32) << 30 | _pack(others, np.array([10, 10, 10]))
    words[:, 2] = _pack(shares[:, 1], BITS)
    words[:, 3] = _pack(shares[:, 2], np.array([8, 8, 8])) << 8 | opacity_bytes(rows.opacity_logits)
    return bounds, words


def _pack(shares: Floats, bits: NDArray) -> NDArray[np.uint32]:
    """Return three shares [N, 3] of [0, 1] in one word, the first in the highest bits."""
    levels = np.floor(shares * (2.0**bits - 1.0) + 0.5).astype(np.uint32)
    return levels[:, 0] << np.uint32(bits[1] + bits[2]) | levels[:, 1] << np.uint32(bits[2]) | levels[:, 2]


def _unpack(words: NDArray[np.uint32], bits: NDArray) -> Floats:
    shifts = np.array([bits[1] + bits[2], bits[2], 0], np.uint32)
    masks = (2**bits - 1).astype(np.uint32)
    return (words[:, None] >> shifts & masks) / masks.astype(np.float64)


def decode(content: bytes, source: str | Path) -> Gaussians:
    """Return the Gaussians of a file, float32.

    Raises
    ------
    InputError
        The file is damaged, or no compressed PLY.
    """
    parts = _parse(content, source)
    n = len(parts.words)
    low, high = np.moveaxis(parts.bounds[np.arange(n) // CHUNK], 2, 0)  # [N, 3, 3] each
    shares = np.stack(
        [
            _unpack(parts.words[:, 0], BITS),
            _unpack(parts.words[:, 2], BITS),
            _unpack(parts.words[:, 3] >> np.uint32(8), np.array([8, 8, 8])),
        ],
        axis=1,
    )
    with np.errstate(over="ignore", invalid="ignore"):  # of damaged bounds, which are refused below
        values = low + (high - low) * shares  # [N, 3, 3]
    rest = parts.sh_rest.astype(np.float64)
    ends = np.where(rest == 0, 0.0, np.where(rest == 255, 1.0, (rest + 0.5) / 256.0))
    gaussians = Gaussians(
        means=values[:, 0],
        quats=restore_largest(
            (parts.words[:, 1] >> 30).astype(np.int64), _unpack(parts.words[:, 1], np.array([10, 10, 10]))
        ),
        log_scales=values[:, 1],
        opacity_logits=decode_logits((parts.words[:, 3] & 255).astype(np.uint8)),
        sh_dc=(values[:, 2] - 0.5) / SH_C0,
        sh_rest=(SH_RANGE * (ends - 0.5)).reshape(n, 3, rest.shape[1] // 3).transpose(0, 2, 1),
    )
    return finish(source, gaussians)


def _parse(content: bytes, source: str | Path) -> _Parts:
    file = BytesIO(content)
    header = read_header(file, Path(source))
    elements = {element.name: element for element in header.elements}
    chunks, vertices, harmonics = (elements.get(name) for name in ("chunk", "vertex", "sh"))
    if chunks is None or vertices is None or {p.name for p in vertices.properties} != set(WORDS):
        raise InputError(f"{source}: not a compressed PLY, it has no packed properties: name a plain one .ply")
    if any(len({p.name for p in element.properties}) < len(element.properties) for element in header.elements):
        raise InputError(f"{source}: damaged, a property is declared twice; {WAY_OUT}")
    dtypes = {element.name: element.dtype for element in header.elements}
    counts = {element.name: element.n for element in header.elements}
    names = {element.name: set(element.dtype.names or ()) for element in header.elements}
    n_rest = 0 if harmonics is None else len(harmonics.properties)
    allowed = [3 * ((degree + 1) ** 2 - 1) for degree in range(SH_DEGREE_MAX + 1)]
    if (
        header.encoding != "binary_little_endian"
        or len(elements) < len(header.elements)
        or any(element.has_lists for element in header.elements)
        or any(dtypes["vertex"][name] != np.dtype("<u4") for name in WORDS)
        or names["chunk"] not in ({*BOUNDS}, {*BOUNDS[:12]})
        or any(dtypes["chunk"][name] != np.dtype("<f4") for name in names["chunk"])
        or chunks.n != -(-vertices.n // CHUNK)
        or (harmonics is not None and (harmonics.n != vertices.n or n_rest not in allowed))
        or any(p.dtype != np.uint8 for p in (harmonics.properties if harmonics is not None else ()))
    ):
        raise InputError(f"{source}: damaged, its header is not that of a compressed PLY; {WAY_OUT}")
    begin = file.tell()
    refuse_size(source, sum(counts[name] * dtypes[name].itemsize for name in counts), len(content) - begin)
    rows = {}
    for name in counts:
        rows[name] = np.frombuffer(content, dtypes[name], counts[name], begin)
        begin += rows[name].nbytes
    bounds = np.zeros((chunks.n, 3, 2, 3))
    bounds[:, 2, 1] = 1.0
    for i, name in enumerate(BOUNDS):
        if name in names["chunk"]:
            bounds.reshape(chunks.n, 18)[:, i] = rows["chunk"][name]
    words = np.stack([rows["vertex"][name] for name in WORDS], axis=1)
    order = [f"f_rest_{i}" for i in range(n_rest)]
    if n_rest and names["sh"] != set(order):
        raise InputError(f"{source}: damaged, its harmonics are not f_rest_0 to f_rest_{n_rest - 1}; {WAY_OUT}")
    rest = np.stack([rows["sh"][name] for name in order], axis=1) if n_rest else np.zeros((vertices.n, 0), np.uint8)
    return _Parts(bounds, words, rest)


def describe(content: bytes, source: str | Path) -> list[tuple[str, str]]:
    """Return the precision of a file, as pairs of name and text.

    Raises
    ------
    InputError
        The file is refused, as by :func:`decode`.
    """
    bounds = _parse(content, source).bounds
    with np.errstate(over="ignore", invalid="ignore"):
        largest = (bounds[:, :, 1] - bounds[:, :, 0]).max(axis=0, initial=0.0)  # [3, 3]
        steps = largest / (2.0 ** np.stack([BITS, BITS, np.array([8, 8, 8])]) - 1.0)
    return [
        ("centres", f"within {0.5 * steps[0].max():.2g} world units along each axis, by chunks of {CHUNK}"),
        ("log-scales", f"within {0.5 * steps[1].max():.2g}"),
        ("opacities", f"within {0.5 / 255:.2g}"),
        ("SH coefficients", f"within {0.5 * steps[2].max() / SH_C0:.2g} (degree 0) and {0.5 * SH_RANGE / 256:.2g}"),
    ]


COMPRESSED_PLY = Format(
    suffix=".compressed.ply",
    summary="SuperSplat's, 16 bytes each and 1 for each harmonic",
    levels=("11, 10 and 8 bits",),
    default_level=0,
    encode=encode,
    decode=decode,
    describe=describe,
)
"""The format of SuperSplat and PlayCanvas."""
