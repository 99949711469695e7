"""The PLY container: a header that names elements and their properties, then the rows; its vertices as columns.

Reading supports ASCII, little- and big-endian, any scalar type, elements and properties in any order. Other elements
and list properties are skipped; :mod:`.ply_faces` reads faces. Writing supports little-endian vertices, and faces of
equally many corners.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.errors import InputError
from minisplat_ref.io.atomic import replacing

SCALAR_TYPES = {
    **{name: "i1" for name in ("char", "int8")},
    **{name: "u1" for name in ("uchar", "uint8")},
    **{name: "i2" for name in ("short", "int16")},
    **{name: "u2" for name in ("ushort", "uint16")},
    **{name: "i4" for name in ("int", "int32")},
    **{name: "u4" for name in ("uint", "uint32")},
    **{name: "f4" for name in ("float", "float32")},
    **{name: "f8" for name in ("double", "float64")},
}
COUNT_TYPES = [name for name, code in SCALAR_TYPES.items() if code[0] != "f"]
BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
CORNERS = ("vertex_indices", "vertex_index")  # names of a face's list in different programs; we write the first
ROWS_AT_ONCE = 1 << 16  # assembled for writing
HEADER_LINE_MAX = 1 << 20  # bytes; no header line is longer, and a file without line breaks must not be read whole
TABLE = ".csv"  # of splat-transform, whose columns have the names of a PLY's
HEADER_MAX = 1 << 24  # bytes of a header


class Property(NamedTuple):
    """A column, or a list in every row."""

    name: str
    dtype: np.dtype
    """Of the value, or of every value of the list, in the file's byte order."""
    count_dtype: np.dtype | None
    """Of the number of values that precedes a list; None for a single value."""


class Element(NamedTuple):
    """Rows of one kind."""

    name: str
    n: int
    """Number of rows."""
    properties: Sequence[Property]
    """Of each row, in order."""

    @property
    def scalars(self) -> list[Property]:
        """Return the properties that are not lists."""
        return [p for p in self.properties if p.count_dtype is None]

    @property
    def has_lists(self) -> bool:
        """Return whether rows may differ in length."""
        return len(self.scalars) < len(self.properties)

    @property
    def dtype(self) -> np.dtype:
        """Return the structured dtype of a row without its lists; all names must differ."""
        return np.dtype([(p.name, p.dtype) for p in self.scalars])


class Header(NamedTuple):
    """The contents of a file's header."""

    encoding: str
    elements: Sequence[Element]
    """All of them, in the file's order."""
    comments: Sequence[str] = ()
    """Without the word ``comment``, with one space between two words."""

    @property
    def before(self) -> Sequence[Element]:
        """Return the elements whose rows come before the vertices."""
        return self.elements[: [element.name for element in self.elements].index("vertex")]

    @property
    def vertices(self) -> Element:
        """Return the element that is read."""
        return self.elements[len(self.before)]


def count_rows(path: str | Path, name: str) -> int:
    """Return the total number of rows of the elements of a name, such as ``face``; 0 if there are none.

    Raises
    ------
    InputError
        If the file cannot be opened or its header is malformed.
    """
    path = Path(path)
    if path.suffix.lower() == TABLE:
        return 0
    with open_ply(path) as file:
        return sum(element.n for element in read_header(file, path).elements if element.name == name)


def property_names(path: str | Path) -> tuple[str, ...]:
    """Return the names of the scalar properties of the vertices.

    Raises
    ------
    InputError
        If the file cannot be opened or its header is malformed.
    """
    path = Path(path)
    with open_ply(path) as file:
        if path.suffix.lower() == TABLE:
            return _table_names(file, path)
        return read_header(file, path).vertices.dtype.names or ()


def comments_of(path: str | Path) -> Sequence[str]:
    """Return the comments in the header.

    Raises
    ------
    InputError
        If the file cannot be opened or its header is malformed.
    """
    path = Path(path)
    with open_ply(path) as file:
        return () if path.suffix.lower() == TABLE else read_header(file, path).comments


def read_vertices(path: str | Path) -> dict[str, NDArray]:
    """Read every property of the vertices of a PLY file; lists are left out.

    Returns
    -------
    dict of ndarray of shape (P,)
        One column per property, in the file's order and scalar type, native byte order.

    Raises
    ------
    InputError
        If the file is missing, malformed or ends before its last declared vertex.
    """
    path = Path(path)
    with open_ply(path) as file:
        if path.suffix.lower() == TABLE:
            return _read_table(file, path)
        header = read_header(file, path)
        if header.encoding == "ascii":
            with np.errstate(over="ignore"):  # values beyond their type become infinite, for which readers check
                rows = _read_ascii(file, path, sum(element.n for element in header.before), header.vertices)
        else:
            for element in header.before:
                pass_over(file, path, element)
            rows = _read_binary(file, path, header.vertices)
    return {name: rows[name].astype(rows[name].dtype.newbyteorder("=")) for name in rows.dtype.names or ()}


def read_pieces(path: Path, names: Collection[str]) -> tuple[int, np.dtype, Iterator[NDArray]] | None:
    """Read the vertices of a binary file a few at a time, for a reader that puts them where they belong.

    Parameters
    ----------
    path : Path
    names : collection of str
        Properties that must be there, as floats.

    Returns
    -------
    tuple or None
        The number of vertices, the result type of the properties, and structured arrays of rows, one after the other;
        None for a file that :func:`read_vertices` has to read.

    Raises
    ------
    InputError
        If the file is malformed, or ends before its last declared vertex.
    """
    with open_ply(path) as file:
        if path.suffix.lower() == TABLE:
            return None
        header = read_header(file, path)
        kinds = {p.name: p.dtype for p in header.vertices.scalars}
        is_usual = set(names) <= kinds.keys() and all(kinds[name].kind == "f" for name in names)
        if header.encoding == "ascii" or header.before or header.vertices.has_lists or not is_usual:
            return None
        begin, vertices = file.tell(), header.vertices
        _check_binary(file, path, vertices)
    dtype = np.result_type(np.float32, *(kinds[name].newbyteorder("=") for name in names))
    return vertices.n, dtype, _pieces(path, begin, vertices)


def _pieces(path: Path, begin: int, vertices: Element) -> Iterator[NDArray]:
    with open_ply(path) as file:
        file.seek(begin)
        for start in range(0, vertices.n, ROWS_AT_ONCE):
            n = min(ROWS_AT_ONCE, vertices.n - start)
            yield np.frombuffer(read_exactly(file, path, n * vertices.dtype.itemsize), vertices.dtype)


def _table_names(file: BinaryIO, path: Path) -> tuple[str, ...]:
    """Return the names in the first line of a table of splat-transform, between commas."""
    names = tuple(name.strip() for name in file.readline(HEADER_LINE_MAX).decode("utf-8-sig", "replace").split(","))
    if len(set(names)) < len(names) or not all(names) or len(names) < 2:
        raise InputError(f"{path}: its first line is not names of columns between commas; export it again as .ply")
    return names


def _read_table(file: BinaryIO, path: Path) -> dict[str, NDArray]:
    """Return the columns of a table of splat-transform, float32."""
    names = _table_names(file, path)
    rows: list[tuple[float, ...]] = []
    for row, line in enumerate(file):
        words = line.split(b",")
        try:
            rows.append(tuple(map(float, words)))
        except ValueError:
            raise InputError(f"{path}: row {row} is not {len(names)} numbers; export it again") from None
        if len(words) != len(names):
            raise InputError(f"{path}: row {row} is not {len(names)} numbers; export it again")
    with np.errstate(over="ignore"):
        table = np.array(rows, np.float64).reshape(-1, len(names)).astype(np.float32)
    return {name: np.ascontiguousarray(column) for name, column in zip(names, table.T, strict=True)}


def write_vertices(
    path: str | Path, columns: Mapping[str, NDArray], faces: NDArray | None = None, comments: Sequence[str] = ()
) -> None:
    """Write columns of equal length P as the vertices of a little-endian PLY, complete or not at all.

    Each property has the scalar type of its column: uint8, int32, float32 and so on. Faces [F, c], rows of vertices,
    have the same number of corners each, at most 255. Comments are lines of the header, without the word ``comment``.
    """
    type_names = {code: name for name, code in reversed(SCALAR_TYPES.items()) if not name[-1].isdigit()}
    dtype = np.dtype([(name, column.dtype.newbyteorder("<")) for name, column in columns.items()])
    n = len(next(iter(columns.values())))
    properties = "".join(f"property {type_names[c.dtype.str[1:]]} {name}\n" for name, c in columns.items())
    if faces is not None:
        properties += f"element face {len(faces)}\nproperty list uchar int {CORNERS[0]}\n"
    lines = "".join(f"comment {comment}\n" for comment in comments)
    header = f"ply\nformat binary_little_endian 1.0\n{lines}element vertex {n}\n{properties}end_header\n"
    with replacing(path) as temporary, open(temporary, "wb") as file:
        file.write(header.encode())
        for start in range(0, n, ROWS_AT_ONCE):  # so that they are never all in memory twice
            part = slice(start, start + ROWS_AT_ONCE)
            rows = np.empty(len(range(n)[part]), dtype)
            for name, column in columns.items():
                rows[name] = column[part]
            file.write(rows.data)
        if faces is not None:
            lists = np.empty(len(faces), [("n", "u1"), ("corners", "<i4", faces.shape[1])])
            lists["n"], lists["corners"] = faces.shape[1], faces
            file.write(lists.tobytes())


def open_ply(path: Path) -> BinaryIO:
    """Open a file, or raise an InputError with the reason why it cannot be opened."""
    try:
        return path.open("rb")
    except OSError as error:
        raise InputError(f"{path}: cannot be opened ({error.strerror})") from None


def read_header(file: BinaryIO, path: Path) -> Header:
    """Read up to the line end_header; check that there are vertices, and that no two of their columns share a name."""
    if file.readline(8).strip() != b"ply":
        raise InputError(f"{path}: not a PLY file, it does not begin with 'ply'")
    encoding = ""
    declared: list[tuple[str, int, list[tuple[str, str, str | None]]]] = []  # (name, n, [(name, type, list's count)])
    comments: list[str] = []
    words: list[str] = []
    while words != ["end_header"]:
        line = file.readline(HEADER_LINE_MAX)
        words = line.decode(errors="replace").split()
        if line and not words and file.tell() < HEADER_MAX:
            continue  # a blank line, or one of a carriage return alone
        match words:
            case ["end_header"]:
                pass
            case []:
                raise InputError(f"{path}: truncated, the PLY header has no end_header; copy or export the file again")
            case ["format", name, _] if name in BYTE_ORDERS:
                encoding = name
            case ["element", name, count] if count.isdecimal():
                declared.append((name, int(count), []))
            case ["property", kind, name] if kind in SCALAR_TYPES and declared:
                declared[-1][2].append((name, kind, None))
            case ["property", "list", count, kind, name] if count in COUNT_TYPES and kind in SCALAR_TYPES and declared:
                declared[-1][2].append((name, kind, count))
            case ["comment", *text]:
                comments.append(" ".join(text))
            case ["obj_info", *_]:
                pass
            case _:
                raise InputError(f"{path}: cannot read the header line '{' '.join(words)}'; export the PLY again")
    order = BYTE_ORDERS.get(encoding, "=")
    elements = [
        Element(name, n, [_property(name, kind, count, order) for name, kind, count in properties])
        for name, n, properties in declared
    ]
    i = next((i for i, element in enumerate(elements) if element.name == "vertex"), -1)
    names = [p.name for p in elements[i].scalars] if i >= 0 else []
    if not encoding or not names or len(set(names)) < len(names):
        raise InputError(
            f"{path}: the PLY header lacks its format, vertices or properties, or repeats one; export it again"
        )
    return Header(encoding, elements, comments)


def _property(name: str, kind: str, count: str | None, order: str) -> Property:
    count_dtype = None if count is None else np.dtype(order + SCALAR_TYPES[count])
    return Property(name, np.dtype(order + SCALAR_TYPES[kind]), count_dtype)


def pass_over(file: BinaryIO, path: Path, element: Element) -> None:
    """Move the file's position past an element, in a binary file."""
    if element.has_lists:
        for _ in range(element.n):
            _read_row(file, path, element)
    else:
        n_bytes = element.n * sum(p.dtype.itemsize for p in element.properties)
        if n_bytes > path.stat().st_size:
            raise InputError(f"{path}: truncated, its elements {element.name} end behind it; copy or export it again")
        file.seek(n_bytes, 1)


def _read_binary(file: BinaryIO, path: Path, vertices: Element) -> NDArray:
    """Read the declared vertices and ignore everything after them."""
    n, dtype = vertices.n, vertices.dtype
    if vertices.has_lists:
        return np.frombuffer(b"".join(_read_row(file, path, vertices) for _ in range(n)), dtype)
    _check_binary(file, path, vertices)
    return np.frombuffer(file.read(n * dtype.itemsize), dtype)


def _check_binary(file: BinaryIO, path: Path, vertices: Element) -> None:
    """Refuse a binary file that ends before its last declared vertex, from where it is read."""
    n, dtype = vertices.n, vertices.dtype
    found = max(0, path.stat().st_size - file.tell())
    expected = n * dtype.itemsize
    if found < expected:
        raise InputError(
            f"{path}: truncated, {n} vertices of {dtype.itemsize} bytes need {expected} bytes but there are {found};"
            " copy or export the file again"
        )


def _read_row(file: BinaryIO, path: Path, element: Element) -> bytes:
    """Read the scalars of a row that also has lists."""
    scalars = b""
    for name, dtype, count_dtype in element.properties:
        if count_dtype is None:
            scalars += read_exactly(file, path, dtype.itemsize)
            continue
        count = int(np.frombuffer(read_exactly(file, path, count_dtype.itemsize), count_dtype)[0])
        if count < 0:
            raise InputError(f"{path}: a list {name} has {count} values; export the PLY again")
        file.seek(count * dtype.itemsize, 1)
    return scalars


def read_exactly(file: BinaryIO, path: Path, n: int) -> bytes:
    """Read n bytes, which must be there."""
    data = file.read(n)
    if len(data) < n:
        raise InputError(f"{path}: truncated, it ends before its last declared row; copy or export the file again")
    return data


def _read_ascii(file: BinaryIO, path: Path, n_before: int, vertices: Element) -> NDArray:
    """Read the declared vertices, one per line, after the lines of other elements."""
    n, n_scalars = vertices.n, len(vertices.scalars)
    found = path.stat().st_size - file.tell()
    if found + 1 < n_before + 2 * n * n_scalars:  # a line, or a character and a gap for each number
        raise InputError(f"{path}: truncated, {n} vertices expected, {found} bytes found; copy or export it again")
    rows = np.empty(n, vertices.dtype)
    row = -1
    for row, line in enumerate(islice(file, n_before, n_before + n)):
        text = line.decode("ascii", errors="replace")
        words = text.split()
        try:
            rows[row] = tuple(map(float, _scalars(words, vertices) if vertices.has_lists else words))
        except (ValueError, OverflowError):
            raise InputError(
                f"{path}: row {row} is '{text[:60].strip()}', not {n_scalars} numbers; copy or export it again"
            ) from None
    if row + 1 < n:
        raise InputError(f"{path}: truncated, {n} vertices expected, {row + 1} lines found; copy or export it again")
    return rows


def _scalars(words: Sequence[str], element: Element) -> list[str]:
    """Return the words of a line that do not belong to lists."""
    scalars, rest = [], iter(words)
    for _, _, count_dtype in element.properties:
        word = next(rest, "")  # "" is no number and fails below
        if count_dtype is None:
            scalars.append(word)
        else:
            values = list(islice(rest, int(word)))
            if len(values) < int(word):
                raise ValueError("a list is too short")
    if next(rest, None) is not None:
        raise ValueError("there are more words than properties")
    return scalars
