"""``.ksplat``: the format of mkkellogg's GaussianSplats3D, version 0.1, which is read and not written.

A header of 4,096 bytes, headers of 1,024 bytes for sections, and then each section: the sizes of its partly filled
buckets, the centres of its buckets, and its Gaussians. Three compression levels differ in the data of a Gaussian:

=========== ============ ==================================== =====================
level       0            1                                    2
=========== ============ ==================================== =====================
centre      3 x float32  3 x uint16 about the bucket's centre as level 1
scales      3 x float32  3 x float16                          as level 1
rotation    4 x float32  4 x float16, wxyz                    as level 1
colour      4 x uint8, RGB and opacity in 255ths              the same
harmonics   float32      float16                              uint8 between two bounds
=========== ============ ==================================== =====================

Harmonics are stored degree by degree, of each first all red ones. A centre is ``(u - r) b / (2 r)`` from that of its
bucket, of edge length b, with r = 32767 unless the section has another value. Sections of different degrees are filled
up with zeros. A scale of 0 is read as e^-10, as splat-transform does. The frame is that of the PLY.
"""

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.io.formats import Format
from minisplat_ref.io.formats.levels8 import WAY_OUT, decode_logits, decode_sh_dc, finish, refuse_size
from minisplat_ref.types import Floats, Gaussians

HEADER_BYTES, SECTION_BYTES = 4096, 1024
HEADER = struct.Struct("<BBxxIIIIH14xff")  # version, sections at most, sections, splats at most, splats, level, bounds
SECTION = struct.Struct("<IIIIfHxxIIIIH")
DEGREE_MAX = 2
BOUND = 1.5  # of harmonics in 8 bits, where the header has zeros
RANGE = 32767
LOG_SCALE_OF_ZERO = -10.0
N_REST = (0, 3, 8)  # coefficients of each channel, by degree
REST_DTYPES = ("<f4", "<f2", "u1")  # by level


class _Section(NamedTuple):
    n: int
    n_stored: int
    capacity: int
    n_buckets: int
    block: float
    bucket_bytes: int
    half_range: int
    n_bytes: int
    n_full: int
    n_partial: int
    degree: int


class _File(NamedTuple):
    version: tuple[int, int]
    level: int
    bounds: tuple[float, float]
    sections: list[tuple[_Section, int]]
    """With the places where their bytes begin; empty ones are left out."""


def decode(content: bytes, source: str | Path) -> Gaussians:
    """Return the Gaussians of a file, float32.

    Raises
    ------
    InputError
        The file is damaged, of another version, or claims more than it holds.
    """
    file = _parse(content, source)
    degree = max((section.degree for section, _ in file.sections), default=0)
    parts = [_read_section(content, file, section, begin, source) for section, begin in file.sections]
    if not parts:
        shapes = ((0, 3), (0, 4), (0, 3), (0,), (0, 3), (0, N_REST[degree], 3))
        return Gaussians(*(np.zeros(shape, np.float32) for shape in shapes))
    parts = [
        part._replace(sh_rest=np.pad(part.sh_rest, ((0, 0), (0, N_REST[degree] - part.sh_rest.shape[1]), (0, 0))))
        for part in parts
    ]
    return finish(source, Gaussians(*(np.concatenate(fields) for fields in zip(*parts, strict=True))))


def _row(level: int, degree: int) -> np.dtype:
    center, other = ("<f4", "<f4") if level == 0 else ("<u2", "<f2")
    fields = [("means", center, 3), ("scales", other, 3), ("quats", other, 4), ("rgba", "u1", 4)]
    return np.dtype([*fields, ("rest", REST_DTYPES[level], 3 * N_REST[degree])])


def _read_section(content: bytes, file: _File, section: _Section, begin: int, source: str | Path) -> Gaussians:
    row = _row(file.level, section.degree)
    sizes = np.frombuffer(content, "<u4", section.n_partial, begin).astype(np.int64)
    begin += sizes.nbytes // 2
    stored = np.frombuffer(content, np.uint8, section.n_buckets * section.bucket_bytes, begin)
    begin += stored.nbytes
    rows = np.frombuffer(content, row, section.n_stored, begin)[: section.n]
    means: Floats = rows["means"].astype(np.float64)
    if file.level > 0:
        full = np.full(section.n_full, section.capacity)
        ends = np.cumsum(np.concatenate([full, sizes]))
        if section.n > ends.max(initial=0) or len(ends) > section.n_buckets:
            raise InputError(f"{source}: damaged, its buckets hold fewer than {section.n:,} Gaussians; {WAY_OUT}")
        buckets = np.searchsorted(ends, np.arange(section.n), side="right")  # [n]
        centers = stored.reshape(section.n_buckets, section.bucket_bytes)[:, :12].copy().view("<f4")  # [B, 3]
        step = section.block / 2.0 / section.half_range
        with np.errstate(over="ignore", invalid="ignore"):
            means = (means - section.half_range) * step + centers[buckets]
    scales = rows["scales"].astype(np.float64)
    bad = np.flatnonzero(~(scales >= 0).all(axis=1))
    if bad.size:
        raise InputError(f"{source}: row {bad[0]} has the scales {scales[bad[0]].tolist()}; {WAY_OUT}")
    rest = rows["rest"].astype(np.float64)
    if file.level == 2:
        low, high = file.bounds
        rest = low + (high - low) * rest / 255.0
    bands = [
        rest[:, begin:end].reshape(section.n, 3, -1).transpose(0, 2, 1)
        for begin, end in ((0, 9), (9, 24))[: section.degree]
    ]
    return Gaussians(
        means=means,
        quats=rows["quats"].astype(np.float64),
        log_scales=np.where(scales > 0, np.log(np.where(scales > 0, scales, 1.0)), LOG_SCALE_OF_ZERO),
        opacity_logits=decode_logits(rows["rgba"][:, 3]),
        sh_dc=decode_sh_dc(rows["rgba"][:, :3]),
        sh_rest=np.concatenate([np.zeros((section.n, 0, 3)), *bands], axis=1),
    )


def _parse(content: bytes, source: str | Path) -> _File:
    refuse_size(source, HEADER_BYTES, len(content))
    major, minor, n_sections, _, _, n, level, low, high = HEADER.unpack_from(content)
    if (major, minor) != (0, 1):
        raise InputError(f"{source}: .ksplat of version {major}.{minor}, but this program reads version 0.1")
    begin = HEADER_BYTES + n_sections * SECTION_BYTES
    refuse_size(source, begin, len(content))
    if level not in (0, 1, 2) or not -1e6 < low <= high < 1e6:
        raise InputError(f"{source}: damaged, level {level} and harmonics from {low:g} to {high:g}; {WAY_OUT}")
    sections = []
    for i in range(n_sections):
        section = _Section._make(SECTION.unpack_from(content, HEADER_BYTES + i * SECTION_BYTES))
        section = section._replace(half_range=section.half_range or RANGE)
        if section.n == 0:
            continue  # room for one that was never filled
        if section.degree > DEGREE_MAX or section.n > section.n_stored or (level and section.bucket_bytes < 12):
            raise InputError(
                f"{source}: damaged, section {i} is of degree {section.degree}, with {section.n:,} of"
                f" {section.n_stored:,} Gaussians; {WAY_OUT}"
            )
        sections.append((section, begin))
        begin += 4 * section.n_partial + section.n_buckets * section.bucket_bytes
        begin += section.n_stored * _row(level, section.degree).itemsize
        refuse_size(source, begin, len(content))
        if section.n_full > section.n_buckets:
            raise InputError(
                f"{source}: damaged, {section.n_full:,} of {section.n_buckets:,} buckets are full; {WAY_OUT}"
            )
    if sum(section.n for section, _ in sections) != n:
        raise InputError(f"{source}: damaged, its sections do not have {n:,} Gaussians together; {WAY_OUT}")
    return _File((major, minor), level, (low or -BOUND, high or BOUND), sections)


def encode(gaussians: Gaussians, level: int) -> bytes:
    """Refuse: the format is read only.

    Raises
    ------
    InputError
        Always.
    """
    raise InputError("a .ksplat is read, but not written: choose .spz or .splat, which the same viewers show")


def describe(content: bytes, source: str | Path) -> list[tuple[str, str]]:
    """Return version and level of a file, as pairs of name and text.

    Raises
    ------
    InputError
        The file is refused, as by :func:`decode`.
    """
    file = _parse(content, source)
    version = ".".join(map(str, file.version))
    return [("ksplat version", version), ("level", str(file.level)), ("sections", str(len(file.sections)))]


KSPLAT = Format(
    suffix=".ksplat",
    summary="GaussianSplats3D's, read only",
    levels=(),
    default_level=0,
    encode=encode,
    decode=decode,
    describe=describe,
)
"""The format of GaussianSplats3D."""
