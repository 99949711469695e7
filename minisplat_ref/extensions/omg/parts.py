"""Parts that both kinds of ``.omg`` store in the same way: centres, integers in planes of bytes, codes with indices."""

from collections.abc import Collection, Mapping
from typing import Any, Protocol

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.omg.centers import FARTHEST
from minisplat_ref.extensions.omg.svq import Quantised
from minisplat_ref.io.packing.container import WAY_OUT, Packed, is_count, unpack
from minisplat_ref.io.packing.planes import PLANES_MAX, from_planes
from minisplat_ref.types import Ints

GAUSSIANS_MAX = 2**31 - 1


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


def no_gaussians(packed: Packed) -> InputError:
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
