"""``.omg``: centres as half floats in Morton order, and everything else as codes of small codebooks.

===============  ==================  =======================================================================
centres          half floats         of the offset from the scene's median; packed as differences
scales           1 number per part   their logarithms
rotations        2 numbers per part  unit quaternions with w >= 0, in (w, x) and (y, z)
opacity          1 number per part   its logit; in the paper a network computes it
appearance       2 numbers per part  degree 0 (3 numbers) and the features of the higher harmonics
===============  ==================  =======================================================================

The higher harmonics of a scene, [N, 45], are features and a shared decoder. With the mean m of all rows and orthonormal
rows b_k, the principal directions,

    h_i = m + sum_k f_ik b_k,   f_ik = b_k . (h_i - m)

is the linear decoder with the least squared error for its number of features (principal component analysis). It
replaces the paper's small networks, which read a position and three features and are trained with the scene.

Codebooks and decoder are half floats. Indices and centres are planes of bytes that zstandard packs, where the paper
uses Huffman coding, a point-cloud coder and xz. The error has no bound other than the codebooks; ``describe`` reports
the number of codes. Decoding gives the same Gaussians on every machine except for the last bit of the higher harmonics,
which are a matrix product.
"""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import SH_DEGREE_MAX
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.omg import trained_file
from minisplat_ref.extensions.omg.codes import (
    FARTHEST,
    GAUSSIANS_MAX,
    QUAT_MIN,
    Quantised,
    are_codes,
    are_planes,
    check_halves,
    decode_differences,
    encode_differences,
    is_center,
    quantise,
    read_codes,
    read_integers,
    refuse_header,
    round_to_halves,
    unit_quats,
)
from minisplat_ref.io.formats import Format
from minisplat_ref.io.label import Label
from minisplat_ref.io.packing.container import Container, Packed, is_count, pack, parse, read_label, unpack, write_label
from minisplat_ref.io.packing.morton import morton_order
from minisplat_ref.io.packing.pieces import pieces
from minisplat_ref.io.packing.planes import count_planes, to_planes
from minisplat_ref.types import Floats, Gaussians, Ints
from minisplat_ref.validation import check_gaussians

CONTAINER = Container(b"OMG\n", version=1)
CODES_MAX = 2**16


class Decoder(NamedTuple):
    """A linear map from features to harmonics, in float16 as it is stored."""

    mean: Floats
    """[D] m."""
    directions: Floats
    """[F, D] b_k."""

    def harmonics(self, features: Floats) -> Floats:
        """Return ``h = m + f b`` [N, D] of features [N, F], float32."""
        directions = self.directions.astype(np.float32)
        return (self.mean.astype(np.float32) + features.astype(np.float32) @ directions).astype(np.float32)


def fit_decoder(harmonics: Floats, n_features: int) -> Decoder:
    """Return the linear decoder of harmonics [N, D] with the least squared error.

    Parameters
    ----------
    harmonics : ndarray of shape (N, D)
        h.
    n_features : int
        F; it is reduced to D or N where these are smaller.
    """
    n, d = harmonics.shape
    rows = harmonics.astype(np.float64)
    mean = rows.mean(axis=0) if n else np.zeros(d)
    return principal_decoder(mean, (rows - mean).T @ (rows - mean), n_features)


def principal_decoder(mean: Floats, squares: Floats, n_features: int) -> Decoder:
    """Return the decoder of the principal directions.

    Parameters
    ----------
    mean : ndarray of shape (D,)
        m.
    squares : ndarray of shape (D, D)
        ``sum_i (h_i - m) (h_i - m)^T``.
    n_features : int
        F; it is reduced to D if that is smaller.
    """
    values, vectors = np.linalg.eigh(squares)  # ascending
    strongest = np.argsort(-values, kind="stable")[: min(n_features, len(mean))]
    return Decoder(mean.astype(np.float16), vectors[:, strongest].T.astype(np.float16))


def compute_features(harmonics: Floats, decoder: Decoder) -> Floats:
    """Return the features ``f_ik = b_k . (h_i - m)`` [N, F] of harmonics [N, D], float64."""
    mean, directions = decoder.mean.astype(np.float64), decoder.directions.astype(np.float64)
    return (harmonics.astype(np.float64) - mean) @ directions.T


class Sizes(NamedTuple):
    """Number of codes in each codebook, and number of features of the higher harmonics."""

    scales: int
    rotations: int
    opacities: int
    appearance: int
    n_features: int
    """Odd, so that together with three colours it is even and splits into pairs."""


LEVELS = (
    Sizes(scales=1024, rotations=8192, opacities=256, appearance=8192, n_features=9),
    Sizes(scales=256, rotations=2048, opacities=128, appearance=4096, n_features=5),
    Sizes(scales=64, rotations=512, opacities=64, appearance=1024, n_features=3),
    Sizes(scales=32, rotations=128, opacities=32, appearance=256, n_features=3),
    Sizes(scales=16, rotations=64, opacities=16, appearance=64, n_features=1),
)
"""Level 2 has the codebooks of the paper."""
WIDTHS = {"scales": 1, "rotations": 2, "opacities": 1, "appearance": 2}


def encode(gaussians: Gaussians, level: int) -> bytes:
    """Return the content of a file that holds the Gaussians.

    Parameters
    ----------
    gaussians : Gaussians
        N Gaussians; N may be 0.
    level : int
        Index into ``LEVELS``.

    Raises
    ------
    InputError
        A value is not finite, or beyond half floats, or zstandard is missing.
    """
    sizes = LEVELS[level]
    check_gaussians(gaussians, "Gaussians")
    n, n_rest = gaussians.sh_rest.shape[:2]
    center = _center(gaussians)
    if not np.abs(center).max() <= FARTHEST:
        raise InputError(
            f"means are {np.abs(center).max():.3g} from the origin: move the scene, or choose another format"
        )
    offsets = round_to_halves(gaussians.means - center, "means")
    order = morton_order(offsets)
    check_halves(gaussians.sh_rest, "sh_rest")
    decoder = _fit_decoder(gaussians, order, sizes.n_features)
    vectors = _vectors(gaussians, order, decoder)
    quantised = {name: quantise(values, WIDTHS[name], getattr(sizes, name)) for name, values in vectors.items()}
    is_zero = (quantised["rotations"].codes[0] == 0).all(axis=1)
    quantised["rotations"].codes[0][is_zero] = [QUAT_MIN, 0.0]
    integers = _integers(offsets[order], quantised)
    n_features = len(decoder.directions)
    header = {
        "n": n,
        "sh_degree": math.isqrt(n_rest + 1) - 1,
        "level": level,
        "center": [float(x) for x in center],
        "n_features": n_features,
        "codes": {name: [len(codes) for codes in of_parts.codes] for name, of_parts in quantised.items()},
        "planes": {name: count_planes(int(values.max(initial=0))) for name, values in integers.items()},
    }
    return pack(CONTAINER, header, _streams(integers, quantised, decoder))


def _streams(
    integers: Mapping[str, Any], quantised: Mapping[str, Quantised], decoder: Decoder
) -> Iterator[tuple[str, bytes]]:
    for name, values in integers.items():
        yield name, to_planes(values.astype(np.uint64, copy=False))[0]
    for name, of_parts in quantised.items():
        yield f"{name} codes", b"".join(codes.tobytes() for codes in of_parts.codes)
    yield "decoder", decoder.mean.tobytes() + decoder.directions.tobytes()


def _harmonics(gaussians: Gaussians, order: Ints, description: str) -> Iterator[tuple[slice, Floats]]:
    """Yield rows of a file with their harmonics [n, 3 (K-1)], a piece at a time."""
    for part in pieces(len(order), description):
        rows = gaussians.sh_rest[order[part]].astype(np.float64)
        yield part, rows.reshape(len(rows), rows.shape[1] * 3)


def _fit_decoder(gaussians: Gaussians, order: Ints, n_features: int) -> Decoder:
    """Return :func:`fit_decoder` of all rows in the order of the file, summed a piece at a time."""
    n, d = len(order), 3 * gaussians.sh_rest.shape[1]
    mean, squares = np.zeros(d), np.zeros((d, d))
    for _, rows in _harmonics(gaussians, order, "averaging"):
        mean += rows.sum(axis=0)
    mean /= max(n, 1)
    for _, rows in _harmonics(gaussians, order, "fitting"):
        squares += (rows - mean).T @ (rows - mean)
    return principal_decoder(mean, squares, n_features)


def _vectors(gaussians: Gaussians, order: Ints, decoder: Decoder) -> dict[str, Floats]:
    """Return the vectors [N, D] that are quantised, in half floats, by the names of their codebooks."""
    n, n_appearance = len(order), 3 + len(decoder.directions)
    vectors = {
        "scales": round_to_halves(gaussians.log_scales[order], "scales"),
        "rotations": np.empty((n, 4), np.float16),
        "opacities": round_to_halves(gaussians.opacity_logits[order, None], "opacities"),
        "appearance": np.zeros((n, n_appearance + n_appearance % 2), np.float16),
    }
    for part, harmonics in _harmonics(gaussians, order, "encoding"):
        colors = gaussians.sh_dc[order[part]].astype(np.float64)
        appearance = np.concatenate([colors, compute_features(harmonics, decoder)], axis=1)
        vectors["appearance"][part, :n_appearance] = round_to_halves(appearance, "appearance")
        vectors["rotations"][part] = unit_quats(gaussians.quats[order[part]].astype(np.float64))
    return vectors


def _center(gaussians: Gaussians) -> Floats:
    """Return the median [3] of the centres, float32."""
    median: Floats = np.median(gaussians.means, axis=0) if len(gaussians.means) else np.zeros(3)
    return median.astype(np.float32)


def find_order(gaussians: Gaussians) -> Ints:
    """Return the rows [N] of the Gaussians in the order of a file."""
    return morton_order(round_to_halves(gaussians.means - _center(gaussians), "means"))


def _integers(offsets: Floats, quantised: Mapping[str, Quantised]) -> dict[str, Any]:
    """Return the integers that are packed as planes of bytes: differences of the centres, and indices."""
    return {"means": encode_differences(offsets), **{name: of_parts.indices for name, of_parts in quantised.items()}}


def decode(content: bytes, source: str | Path) -> Gaussians:
    """Return the Gaussians of a file, float32.

    Parameters
    ----------
    content : bytes
        The whole file.
    source : str or Path
        Its name, for messages.

    Raises
    ------
    InputError
        The file is damaged, or of another kind or version.
    """
    packed = parse(CONTAINER, content, source)
    header = _check_header(packed)
    n, n_rest = header.n, (header.sh_degree + 1) ** 2 - 1
    offsets = decode_differences(read_integers(packed, header, "means", 3))
    vectors = {name: read_codes(packed, header, name, width).vectors() for name, width in WIDTHS.items()}
    raw = unpack(packed, "decoder", 2 * (1 + header.n_features) * 3 * n_rest)
    table = np.frombuffer(raw, "<f2").reshape(1 + header.n_features, 3 * n_rest)
    features = vectors["appearance"][:, 3 : 3 + header.n_features]
    with np.errstate(over="ignore", invalid="ignore"):  # of damaged files; values that are not finite are refused
        harmonics = Decoder(table[0], table[1:]).harmonics(features)
        means = np.asarray(header.center, np.float32) + offsets.astype(np.float32)
    gaussians = Gaussians(
        means=means,
        quats=vectors["rotations"],
        log_scales=vectors["scales"],
        opacity_logits=vectors["opacities"][:, 0],
        sh_dc=np.ascontiguousarray(vectors["appearance"][:, :3]),
        sh_rest=harmonics.reshape(n, n_rest, 3),
    )
    check_gaussians(gaussians, source)
    return gaussians


class _Header(NamedTuple):
    """The checked content of a header."""

    n: int
    sh_degree: int
    level: int
    center: tuple[float, ...]
    n_features: int
    codes: Mapping[str, list[int]]
    planes: Mapping[str, int]


def _check_header(packed: Packed) -> _Header:
    """Return the header after checking every value that is read."""
    values = {name: packed.header.get(name) for name in _Header._fields}
    n, degree, level, center, n_features, codes, planes = values.values()
    is_right = (
        is_count(n, GAUSSIANS_MAX)
        and is_count(degree, SH_DEGREE_MAX)
        and is_count(level)
        and is_center(center)
        and is_count(n_features, 3 * ((SH_DEGREE_MAX + 1) ** 2 - 1))
        and are_planes(planes, WIDTHS)
    )
    if is_right:
        assert isinstance(n_features, int)
        n_parts = {"scales": 3, "rotations": 2, "opacities": 1, "appearance": -(-(3 + n_features) // 2)}
        is_right = are_codes(codes, {name: (n_parts[name], CODES_MAX) for name in WIDTHS})
    if not is_right:
        raise refuse_header(packed)
    return _Header(**values)  # type: ignore[arg-type]


def describe(content: bytes, source: str | Path) -> list[tuple[str, str]]:
    """Return the level of a file and its codebooks, as pairs of name and text.

    Raises
    ------
    InputError
        The header is refused, as by :func:`decode`.
    """
    header = _check_header(parse(CONTAINER, content, source))
    rows = [("level", f"{header.level} of {len(LEVELS) - 1}")]
    rows += [("centres", "half floats of the offset from the median")]
    rows += [(name, f"{', '.join(map(str, counts))} codes") for name, counts in header.codes.items()]
    return [*rows, ("features", f"{header.n_features} for the higher harmonics")]


def _is_trained(content: bytes) -> bool:
    """Return whether a file holds codes and networks as they were trained."""
    return content[:4] == trained_file.CONTAINER.magic


def _decode(content: bytes, source: str | Path) -> Gaussians:
    """Read either kind of file."""
    return trained_file.decode(content, source) if _is_trained(content) else decode(content, source)


def _describe(content: bytes, source: str | Path) -> list[tuple[str, str]]:
    return trained_file.describe(content, source) if _is_trained(content) else describe(content, source)


def _write_label(content: bytes, label: Label) -> bytes:
    return write_label(trained_file.CONTAINER if _is_trained(content) else CONTAINER, content, label)


def _read_label(content: bytes, source: str | Path) -> Label:
    return read_label(trained_file.CONTAINER if _is_trained(content) else CONTAINER, content, source)


OMG_FILE = Format(
    suffix=".omg",
    summary="codebooks of sub-vectors, zstandard",
    levels=tuple(f"{sizes.appearance} codes of appearance" for sizes in LEVELS),
    default_level=2,
    encode=encode,
    decode=_decode,
    describe=_describe,
    write_label=_write_label,
    read_label=_read_label,
)
"""The format ``.omg``: fitted to any Gaussians, or of a training (:mod:`.trained_file`)."""
