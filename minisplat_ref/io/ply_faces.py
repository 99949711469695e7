"""The faces of a PLY file: for each, which vertices are its corners."""

from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.errors import InputError
from minisplat_ref.io.ply_file import CORNERS, Element, Property, open_ply, pass_over, read_exactly, read_header

Corners = NDArray[np.int64]


def read_faces(path: str | Path) -> list[Corners]:
    """Read the faces of a PLY file: the rows of the vertices that are their corners.

    Returns
    -------
    list of ndarray of shape (c,)
        With the number of corners of each in the file. Empty if it has no faces, or faces without a list of corners.

    Raises
    ------
    InputError
        If the file is missing, malformed or ends before its last declared face, or a corner is no whole number.
    """
    path = Path(path)
    with open_ply(path) as file:
        header = read_header(file, path)
        i = next((i for i, element in enumerate(header.elements) if element.name == "face"), None)
        if i is None:
            return []
        before, faces = header.elements[:i], header.elements[i]
        corners = next((p for p in faces.properties if p.count_dtype is not None and p.name in CORNERS), None)
        if corners is None:
            return []
        if corners.dtype.kind == "f":
            raise InputError(f"{path}: its property {corners.name} is not of integers; export the mesh again")
        if header.encoding == "ascii":
            lines = islice(file, sum(element.n for element in before), None)
            return [_of_words(path, line.split(), faces, corners) for line in _take_declared(lines, path, faces.n)]
        for element in before:
            pass_over(file, path, element)
        return [_of_bytes(file, path, faces, corners) for _ in range(faces.n)]


def _of_bytes(file: BinaryIO, path: Path, faces: Element, corners: Property) -> Corners:
    """Read a row of a binary file, and return its corners."""
    n_bytes, found = path.stat().st_size, b""
    for p in faces.properties:
        count = 1
        if p.count_dtype is not None:
            count = int(np.frombuffer(read_exactly(file, path, p.count_dtype.itemsize), p.count_dtype)[0])
        if not 0 <= count <= n_bytes:  # before memory is allocated
            raise InputError(f"{path}: a list {p.name} has {count} values; export the PLY again")
        values = read_exactly(file, path, count * p.dtype.itemsize)
        if p is corners:
            found = values
    return np.frombuffer(found, corners.dtype).astype(np.int64)


def _take_declared(lines: Iterable[bytes], path: Path, n: int) -> Iterator[bytes]:
    """Yield the next n lines, which must be there."""
    n_found = 0
    for line in islice(lines, n):
        n_found += 1
        yield line
    if n_found < n:
        raise InputError(f"{path}: truncated, {n} faces expected, {n_found} lines found; copy or export it again")


def _of_words(path: Path, words: list[bytes], faces: Element, corners: Property) -> Corners:
    """Return the corners of a row of a text file."""
    rest, found = iter(words), []
    try:
        for p in faces.properties:
            count = 1 if p.count_dtype is None else int(next(rest, b""))
            values = list(islice(rest, count))
            if len(values) < count:
                raise ValueError("a list is too short")
            if p is corners:
                found = [int(value) for value in values]
        return np.array(found, np.int64)
    except (ValueError, OverflowError):
        text = b" ".join(words)[:60].decode("ascii", errors="replace")
        raise InputError(f"{path}: a face is '{text}', not a count and as many corners; export it again") from None
