"""Codes of vectors, and what both kinds of ``.omg`` store in the same way: centres, integers, and codes with indices.

Sub-vector quantisation splits vectors into parts, and each part has its own codebook. A vector of d numbers becomes
d / w parts of w numbers, and each part the index of the nearest of its K codes. So d / w times log2 K bits choose among
K^(d / w) vectors, while only K d numbers are stored. One codebook for whole vectors would need K^(d / w) codes to be as
fine; at equal and *low* rates, though, it is the better one, since it can exploit the dependence between parts.

Codes are fitted by Lloyd's algorithm, which assigns each vector to the nearest code and moves each code to the mean of
its vectors. The initial codes decide how well rare vectors fare. With random vectors as initial codes, most codes lie
where vectors are dense, and a dozen iterations do not move them out: for the log scales of 10,250 Gaussians with 64
codes each, the largest error was 1.53. Here codes start evenly over the space that vectors occupy. The largest error is
0.11, and a tenth of the decibels are lost. Nothing is random, so the same vectors have the same codes.

Centres are half floats of their offset from one point, in Morton order, as differences in planes of bytes. A half
float's bits, read as a whole number with its sign, ascend as the halves do. So neighbours in the order differ by small
whole numbers, and decoding is exact.
"""

from collections.abc import Collection, Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np
from scipy.spatial import cKDTree

from minisplat_ref.errors import InputError
from minisplat_ref.io.packing.container import WAY_OUT, Packed, is_count, unpack
from minisplat_ref.io.packing.pieces import pieces
from minisplat_ref.io.packing.planes import PLANES_MAX, from_planes, unzigzag, zigzag
from minisplat_ref.types import Floats, Ints

ITERATIONS = 12
QUAT_MIN = 2.0**-10  # replaces w in a code (w, x) of zero, since (y, z) may be zero, too
BITS_MAX = 50  # log2 of the cells per side
SAMPLES_MAX = 1 << 17  # vectors to which codes are fitted, evenly spaced among all
LARGEST_HALF = 65504.0
FARTHEST = 1e30  # distance of a centre of the scene from the origin along an axis
GAUSSIANS_MAX = 2**31 - 1


class Quantised(NamedTuple):
    """Vectors as indices into codebooks."""

    codes: tuple[Floats, ...]
    """A codebook [K, w] of float16 for each part; K may be less than was allowed."""
    indices: Ints
    """[N, P] rows of the codebooks, which have at most 2^16."""

    def vectors(self) -> Floats:
        """Return the vectors [N, P w] that the codes represent, float32."""
        parts = [codes[rows] for codes, rows in zip(self.codes, self.indices.T, strict=True)]
        return np.concatenate(parts, axis=1).astype(np.float32)


def quantise(vectors: Floats, width: int, n_codes: int) -> Quantised:
    """Return the vectors with each part replaced by the index of a code.

    Parameters
    ----------
    vectors : ndarray of shape (N, D)
        Finite, at most 65504 in magnitude, the largest float16.
    width : int
        w, numbers per part; it divides D.
    n_codes : int
        K, the largest number of codes per part.
    """
    codes, indices = [], []
    for begin in range(0, vectors.shape[1], width):
        part = vectors[:, begin : begin + width].astype(np.float64)
        book = np.unique(fit_codes(part, n_codes).astype(np.float16), axis=0)
        codes.append(book)
        indices.append(nearest(book.astype(np.float64), part, "finding codes").astype(np.uint16))
    return Quantised(tuple(codes), np.stack(indices, axis=1))


def fit_codes(vectors: Floats, n_codes: int) -> Floats:
    """Return at most K codes [K, w] for vectors [N, w]; if no more than K vectors differ, these are the codes."""
    different = np.unique(vectors[:: -(-len(vectors) // SAMPLES_MAX) or 1], axis=0)
    if len(different) <= n_codes:
        return different
    codes = _initial_codes(different, n_codes)
    for _ in range(ITERATIONS):
        rows = nearest(codes, different)
        counts = np.bincount(rows, minlength=n_codes)
        sums = np.stack([np.bincount(rows, weights=axis, minlength=n_codes) for axis in different.T], axis=1)
        codes = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], codes)
    return codes


def unit_quats(quats: Floats) -> Floats:
    """Return quaternions [N, 4] of length 1 with w >= 0, one of the two that represent each rotation."""
    unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    return unit * np.where(unit[:, :1] < 0, unit.dtype.type(-1), unit.dtype.type(1))


def _initial_codes(vectors: Floats, n_codes: int) -> Floats:
    """Return vectors [K, w] spread evenly over the occupied space: one per cell, of the largest cells that give K."""
    low = vectors.min(axis=0)
    side = float((vectors.max(axis=0) - low).max())
    for bits in range(1, BITS_MAX):
        cells = np.floor((vectors - low) / side * 2.0**bits)
        _, rows = np.unique(cells, axis=0, return_index=True)
        if len(rows) >= n_codes:
            break
    return vectors[rows[np.linspace(0, len(rows) - 1, n_codes).round().astype(int)]]


def nearest(codes: Floats, vectors: Floats, description: str = "fitting codes") -> Ints:
    """Return the row [N] of the code [K, w] nearest to each vector [N, w]; the description is for the progress bar."""
    rows = np.empty(len(vectors), np.int64)
    tree = cKDTree(codes) if len(vectors) else None
    for part in pieces(len(vectors), description):
        assert tree is not None
        rows[part] = tree.query(vectors[part])[1]
    return rows


def round_to_halves(values: Floats, name: str) -> Floats:
    """Return values as half floats.

    Raises
    ------
    InputError
        They are too large; ``name`` is their name.
    """
    check_halves(values, name)
    return values.astype(np.float16)


def check_halves(values: Floats, name: str) -> None:
    """Refuse values beyond half floats; arguments and errors as for :func:`round_to_halves`."""
    largest = max(values.max(initial=0.0), -values.min(initial=0.0))
    if not largest <= LARGEST_HALF:
        raise InputError(f"{name} reach {largest:.3g}, but half floats {LARGEST_HALF:g}: choose another format")


def encode_differences(halves: Floats) -> Any:
    """Return half floats [N, 3] as unsigned integers, the differences from row to row of their ordered bits."""
    bits = halves.view(np.int16).astype(np.int64)
    ordered = np.where(bits < 0, -(bits & 0x7FFF), bits)  # both zeros are 0
    return zigzag(np.diff(ordered, axis=0, prepend=0))


def decode_differences(differences: Any) -> Floats:
    """Return the half floats [N, 3] of :func:`encode_differences`."""
    ordered = np.cumsum(unzigzag(differences), axis=0)
    halves: Floats = np.where(ordered < 0, -ordered | 0x8000, ordered).astype(np.uint16).view(np.float16)
    return halves


class Header(Protocol):
    """The entries of a header that are read here."""

    @property
    def n(self) -> int:
        """Number of Gaussians N."""

    @property
    def codes(self) -> Mapping[str, list[int]]:
        """Numbers of codes of the parts of a vector, by its name."""

    @property
    def planes(self) -> Mapping[str, int]:
        """Number of planes of bytes of a stream of integers, by its name."""


def is_center(value: Any) -> bool:
    """Return whether this is a point, not too far away, from which centres have their offsets."""
    return isinstance(value, list) and len(value) == 3 and all(type(x) is float and abs(x) <= FARTHEST for x in value)


def are_codes(codes: Any, limits: Mapping[str, tuple[int, int]]) -> bool:
    """Return whether these are numbers of codes; ``limits`` has the number of parts and the most codes of one."""
    return (
        isinstance(codes, dict)
        and set(codes) == set(limits)
        and all(
            isinstance(codes[name], list)
            and len(codes[name]) == n_parts
            and all(is_count(k, most) for k in codes[name])
            for name, (n_parts, most) in limits.items()
        )
    )


def are_planes(planes: Any, vectors: Collection[str]) -> bool:
    """Return whether these are numbers of planes, of the centres and of the indices of each vector."""
    return (
        isinstance(planes, dict)
        and set(planes) == {"means", *vectors}
        and all(is_count(n_planes, PLANES_MAX) and n_planes for n_planes in planes.values())
    )


def refuse_header(packed: Packed) -> InputError:
    """Return the refusal of a header."""
    n = packed.header.get("n")
    return InputError(f"{packed.source}: damaged, its header does not describe Gaussians (n {n}); {WAY_OUT}")


def read_integers(packed: Packed, header: Header, name: str, n_columns: int) -> Any:
    """Return the unsigned integers [N, C] of a stream."""
    n_planes = header.planes[name]
    return from_planes(unpack(packed, name, n_planes * n_columns * header.n), n_planes, n_columns, header.n)


def read_codes(packed: Packed, header: Header, name: str, width: int) -> Quantised:
    """Return codebooks of half floats and indices [N, P] of a vector whose parts have ``width`` numbers each.

    Raises
    ------
    InputError
        An index has no code.
    """
    counts = header.codes[name]
    raw = unpack(packed, f"{name} codes", 2 * width * sum(counts))
    codes = np.split(np.frombuffer(raw, "<f2").reshape(-1, width), np.cumsum(counts)[:-1])
    indices: Ints = read_integers(packed, header, name, len(counts)).astype(np.int64)
    if (indices >= np.array(counts)).any():
        raise InputError(f"{packed.source}: damaged, {name} have codes that are not in their codebook; {WAY_OUT}")
    return Quantised(tuple(codes), indices)
