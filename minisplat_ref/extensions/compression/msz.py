"""``.msz``: Gaussians in Morton order, each field on its lattice, in planes of bytes packed by zstandard.

The header holds the number of Gaussians, the degree of their spherical harmonics, the level, and for each field the
exponent of its step and the number of its planes; half a step bounds the error. The streams are

- ``means``: differences between consecutive rows, which Morton order makes small;
- ``largest`` and ``quats``: see :mod:`minisplat_ref.extensions.compression.lattice`;
- ``log_scales``, ``opacity_logits``, ``sh_dc``, ``sh_rest``: one column for each number.

At level 0 each field is a stream of the bit patterns of its float32. Encoding a decoded file again gives the same file,
byte for byte: the order, too, depends on lattice points alone, and Gaussians of one cell stay in their order.
"""

import math
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.constants import SH_DEGREE_MAX
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.compression import lattice, levels
from minisplat_ref.extensions.compression.levels import Exponents
from minisplat_ref.io.formats import Format
from minisplat_ref.io.packing.container import (
    WAY_OUT,
    Container,
    Packed,
    is_count,
    pack,
    parse,
    read_label,
    unpack,
    write_label,
)
from minisplat_ref.io.packing.morton import morton_order
from minisplat_ref.io.packing.pieces import pieces
from minisplat_ref.io.packing.planes import PLANES_MAX, count_planes, from_planes, put_planes, unzigzag, zigzag
from minisplat_ref.types import Floats, Gaussians, Ints
from minisplat_ref.validation import check_gaussians

CONTAINER = Container(b"MSZ\n", version=1)
GAUSSIANS_MAX = 2**31 - 1
EXPONENT_MAX = 200  # of a step, positive or negative: beyond the range of float32. Only steps of centres may exceed 1


class _Header(NamedTuple):
    """The checked content of a header."""

    n: int
    sh_degree: int
    level: int
    steps: Exponents | None
    """None at level 0."""
    planes: Mapping[str, int]

    @property
    def widths(self) -> dict[str, int]:
        """Numbers per Gaussian of each field."""
        n_rest = (self.sh_degree + 1) ** 2 - 1
        return {"means": 3, "quats": 4, "log_scales": 3, "opacity_logits": 1, "sh_dc": 3, "sh_rest": 3 * n_rest}

    @property
    def stream_widths(self) -> dict[str, int]:
        """Numbers per Gaussian of each stream."""
        return self.widths if self.level == 0 else {**self.widths, "quats": 3, "largest": 1}


def encode(gaussians: Gaussians, level: int) -> bytes:
    """Return the content of a file that holds the Gaussians.

    Parameters
    ----------
    gaussians : Gaussians
        They are rounded to float32.
    level : int
        0 to 12, see :mod:`minisplat_ref.extensions.compression.levels`.

    Raises
    ------
    InputError
        A value is not finite, or too far out for its lattice, or zstandard is missing.
    """
    with np.errstate(over="ignore"):  # becomes infinite, which is named
        gaussians = Gaussians(*(np.ascontiguousarray(field, np.float32) for field in gaussians))
    check_gaussians(gaussians, "Gaussians")
    n, n_rest = gaussians.sh_rest.shape[:2]
    rows = gaussians._replace(
        opacity_logits=gaussians.opacity_logits[:, None], sh_rest=gaussians.sh_rest.reshape(n, 3 * n_rest)
    )
    steps, streams = (None, _exact_streams(rows)) if level == 0 else _lattice_streams(rows, level)
    planes = {name: count_planes(_largest(stream, n)) for name, stream in streams.items()}
    header = {
        "n": n,
        "sh_degree": math.isqrt(n_rest + 1) - 1,
        "level": level,
        "steps": steps and steps._asdict(),
        "planes": planes,
    }
    packed = ((name, _planes(stream, n, planes[name], f"encoding {name}")) for name, stream in streams.items())
    return pack(CONTAINER, header, packed)


Stream = Callable[[slice], NDArray[np.uint64]]
"""The integers [n, C] of some rows of a file; they are computed twice, as those of all rows do not fit into memory."""


def _largest(stream: Stream, n: int) -> int:
    return max((int(stream(part).max(initial=0)) for part in pieces(n, "measuring")), default=0)


def _planes(stream: Stream, n: int, n_planes: int, description: str) -> memoryview:
    """Return the integers of all rows as planes of bytes."""
    planes = np.empty((n_planes, stream(slice(0, 0)).shape[1], n), np.uint8)
    for part in pieces(n, description):
        put_planes(planes, part, stream(part))
    return planes.reshape(-1).data


def _exact_streams(rows: Gaussians) -> dict[str, Stream]:
    order = morton_order(rows.means)

    def bits(part: slice, field: Floats) -> NDArray[np.uint64]:
        return field[order[part]].view(np.uint32).astype(np.uint64)

    return {name: partial(bits, field=field) for name, field in rows._asdict().items()}


def _lattice_streams(rows: Gaussians, level: int) -> tuple[Exponents, dict[str, Stream]]:
    steps = levels.exponents(level)
    log_scales = lattice.to_lattice(rows.log_scales, steps.log_scales, "log_scales")
    steps = steps._replace(means=steps.means + levels.size_exponent(log_scales, steps.log_scales))
    means = lattice.to_lattice(rows.means, steps.means, "means")
    order = morton_order(means)
    means = np.diff(means[order], axis=0, prepend=0)

    def largest(part: slice) -> NDArray[np.uint64]:
        return zigzag(lattice.to_rotations(rows.quats[order[part]], steps.quats).largest[:, None])

    def quats(part: slice) -> NDArray[np.uint64]:
        return zigzag(lattice.to_rotations(rows.quats[order[part]], steps.quats).others)

    def field(part: slice, name: str) -> NDArray[np.uint64]:
        return zigzag(lattice.to_lattice(getattr(rows, name)[order[part]], getattr(steps, name), name))

    names = ("log_scales", "opacity_logits", "sh_dc", "sh_rest")
    fields = {name: partial(field, name=name) for name in names}
    return steps, {"means": lambda part: zigzag(means[part]), "largest": largest, "quats": quats, **fields}


def decode(content: bytes, source: str | Path) -> Gaussians:
    """Return the Gaussians of a file, in float32; this inverts :func:`encode` to within half a step.

    Parameters
    ----------
    content : bytes
        The whole file.
    source : str or Path
        Its name, for messages.

    Raises
    ------
    InputError
        The file is damaged, of another kind or version, or holds no Gaussians of 3DGS.
    """
    packed = parse(CONTAINER, content, source)
    header = _check_header(packed)
    streams = {}
    for name, width in header.stream_widths.items():
        n_planes = header.planes[name]
        streams[name] = from_planes(unpack(packed, name, n_planes * width * header.n), n_planes, width, header.n)
    rows = _from_exact(streams) if header.steps is None else _from_lattices(streams, header.steps, source)
    gaussians = Gaussians(**rows)._replace(
        opacity_logits=rows["opacity_logits"][:, 0],
        sh_rest=rows["sh_rest"].reshape(header.n, header.widths["sh_rest"] // 3, 3),
    )
    check_gaussians(gaussians, source)
    return gaussians


def _from_exact(streams: Mapping[str, Any]) -> dict[str, Floats]:
    return {name: stream.astype(np.uint32).view(np.float32) for name, stream in streams.items()}


def _from_lattices(streams: Mapping[str, Any], steps: Exponents, source: str | Path) -> dict[str, Floats]:
    integers: dict[str, Ints] = {name: unzigzag(stream) for name, stream in streams.items()}
    integers["means"] = np.cumsum(integers["means"], axis=0)
    largest = integers.pop("largest")[:, 0]
    if not ((largest >= 0) & (largest < 4)).all():
        raise InputError(f"{source}: damaged, a quaternion has four components; {WAY_OUT}")
    quats = lattice.from_rotations(lattice.Rotations(largest, integers.pop("quats")), steps.quats)
    fields = {name: lattice.from_lattice(values, getattr(steps, name)) for name, values in integers.items()}
    return {**fields, "quats": quats}


def _check_header(packed: Packed) -> _Header:
    """Return the header after checking every value that is read."""
    values, source = packed.header, packed.source
    n, degree, level, steps, planes = (values.get(name) for name in ("n", "sh_degree", "level", "steps", "planes"))
    if not is_count(n, GAUSSIANS_MAX) or not is_count(degree, SH_DEGREE_MAX) or not is_count(level):
        raise InputError(
            f"{source}: damaged, its header says n {n}, sh_degree {degree}, level {level}, which is invalid; {WAY_OUT}"
        )
    assert isinstance(n, int) and isinstance(degree, int) and isinstance(level, int)
    header = _Header(n, degree, level, None, planes if isinstance(planes, dict) else {})
    for name in header.stream_widths:
        if not is_count(header.planes.get(name), PLANES_MAX) or header.planes[name] == 0:
            raise InputError(f"{source}: damaged, its header does not say how many planes {name} has; {WAY_OUT}")
    if level == 0:
        return header
    given = steps if isinstance(steps, dict) else {}
    most = {**dict.fromkeys(Exponents._fields, 0), "means": EXPONENT_MAX}
    if set(given) != set(most) or not all(
        type(step) is int and -EXPONENT_MAX <= step <= most[name] for name, step in given.items()
    ):
        raise InputError(f"{source}: damaged, its header does not say which steps its fields have; {WAY_OUT}")
    return header._replace(steps=Exponents(**given))


def describe(content: bytes, source: str | Path) -> list[tuple[str, str]]:
    """Return the level of a file and the error bounds of its values, as pairs of name and text.

    Raises
    ------
    InputError
        The header is refused, as by :func:`decode`.
    """
    header = _check_header(parse(CONTAINER, content, source))
    if header.steps is None:
        return [("level", "0: every float32 as it was, in Morton order")]
    half = {name: 2.0 ** (exponent - 1) for name, exponent in header.steps._asdict().items()}
    degrees = math.degrees(lattice.rotation_bound(header.steps.quats))
    return [
        ("level", f"{header.level} of {levels.N_LEVELS - 1}"),
        ("centres", f"within {half['means']:.3g} world units along each axis"),
        ("rotations", f"within {degrees:.2g} degrees"),
        ("scales", f"within {100 * math.expm1(half['log_scales']):.2g} %"),
        ("opacities", f"within {half['opacity_logits'] / 4:.2g}"),  # the sigmoid is nowhere steeper than 1/4
        ("SH coefficients", f"within {half['sh_dc']:.2g} (degree 0) and {half['sh_rest']:.2g}"),
    ]


MSZ = Format(
    suffix=".msz",
    summary="lattices of 13 precisions, zstandard",
    levels=levels.describe_levels(),
    default_level=levels.DEFAULT,
    encode=encode,
    decode=decode,
    describe=describe,
    write_label=partial(write_label, CONTAINER),
    read_label=partial(read_label, CONTAINER),
)
"""The format of this project."""
