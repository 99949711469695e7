"""PLY files: trained Gaussians in the 3DGS layout, and the vertices of any point cloud.

The 3DGS layout holds one vertex per Gaussian: ``x y z``, normals (unused, zero), ``f_dc_0..2``, ``f_rest_*``,
``opacity``, ``scale_0..2``, ``rot_0..3``, all before their activations. The higher spherical harmonics are
channel-major: all red coefficients, then all green, then all blue, whereas :class:`Gaussians` keeps RGB last. Rotations
are wxyz, the frame is COLMAP's (x right, y down, z forward).

Files are read by property name, so order, normals and extra properties do not matter; ASCII, little- and big-endian,
any scalar type. Left out: faces and other elements, lists, compressed variants.
"""

import itertools
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.constants import SH_DEGREE_MAX
from minisplat_ref.errors import InputError
from minisplat_ref.io.atomic import replacing
from minisplat_ref.types import Floats, Gaussians
from minisplat_ref.validation import check_quats

MEANS = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
SH_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALES = ("scale_0", "scale_1", "scale_2")
QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
COLORS = ("red", "green", "blue")

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
BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
GRAY = 128  # colour of a point cloud that has none
HEADER_LINE_MAX = 4096  # bytes; no header line is longer, and a file without line breaks must not be read whole


def load_ply(path: str | Path, population: Any = Gaussians) -> Any:
    """Read trained Gaussians from a PLY in the 3DGS layout.

    Parameters
    ----------
    path : str or Path
        The file; spherical harmonics of degree 0 to 3, with or without normals. Bytes after the declared vertices do
        not matter.
    population : type
        :class:`Gaussians`, or a NamedTuple that has its fields and others, which come from the properties that
        :func:`save_ply` has written.

    Returns
    -------
    Gaussians, or whatever ``population`` is
        N may be 0. float64 if any property of the file is, else float32.

    Raises
    ------
    InputError
        If the file is missing, truncated, not a PLY of Gaussians, or holds NaN, infinity or a zero quaternion.
    """
    header, columns = _read(path)
    rest_names = _sh_rest_names(columns, path)
    further = {field: _further_names(columns, field) for field in population._fields if field not in Gaussians._fields}
    names = (*MEANS, *SH_DC, *rest_names, "opacity", *SCALES, *QUATS)
    missing = [name for name in names if name not in columns]
    if missing:
        raise InputError(f"{path}: not a PLY of Gaussians, no property {', '.join(missing)}; {_way_out(header)}")
    missing = [field for field, properties in further.items() if not properties]
    if missing:
        raise InputError(
            f"{path}: no property {', '.join(missing)}: it was not trained with this extension; leave the extension out"
        )
    names = (*names, *(name for properties in further.values() for name in properties))
    check_finite(path, {name: columns[name] for name in names})
    dtype = np.result_type(np.float32, *(columns[name].dtype for name in names if columns[name].dtype.kind == "f"))

    def stack(names: tuple[str, ...]) -> Floats:
        return np.stack([columns[name].astype(dtype) for name in names], axis=1)

    quats = stack(QUATS)  # [N, 4]
    check_quats(path, quats)
    n, n_rest = len(quats), len(rest_names) // 3
    rest = stack(rest_names) if rest_names else np.zeros((n, 0), dtype)  # [N, 3 (K-1)], channel-major
    return population(
        means=stack(MEANS),
        quats=quats,
        log_scales=stack(SCALES),
        opacity_logits=columns["opacity"].astype(dtype),
        sh_dc=stack(SH_DC),
        sh_rest=np.ascontiguousarray(rest.reshape(n, 3, n_rest).transpose(0, 2, 1)),  # [N, K-1, 3]
        **{
            field: columns[field].astype(dtype) if properties == (field,) else stack(properties)
            for field, properties in further.items()
        },
    )


def _further_names(columns: Iterable[str], field: str) -> tuple[str, ...]:
    """Properties of a further field: ``FIELD`` if its shape is [N], ``FIELD_0``, ``FIELD_1``, ... if it is [N, k]."""
    numbered = [name for name in columns if re.fullmatch(rf"{re.escape(field)}_\d+", name)]
    return (field,) if field in columns else tuple(sorted(numbered, key=lambda name: int(name.rpartition("_")[2])))


def further_properties(path: str | Path) -> tuple[str, ...]:
    """Return the names of the properties that a PLY of Gaussians has beyond those of 3DGS, such as an extension's.

    Raises
    ------
    InputError
        If the file cannot be opened or its header is malformed.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            dtype = _read_header(file, path).dtype
    except OSError as error:
        raise InputError(f"{path}: cannot be opened ({error.strerror})") from None
    usual = {*MEANS, *NORMALS, *SH_DC, "opacity", *SCALES, *QUATS}
    return tuple(name for name in dtype.names or () if name not in usual and not name.startswith("f_rest_"))


def save_ply(path: str | Path, gaussians: Any) -> None:
    """Write trained Gaussians as a PLY in the 3DGS layout: binary, little-endian, float32, with zero normals.

    Parameters
    ----------
    path : str or Path
        File to make or replace; it is complete or not there.
    gaussians : Gaussians, or a NamedTuple that has its fields and others
        Any spherical-harmonic degree, which is kept; N may be 0. A further field of shape [N] becomes a property of its
        name, one of shape [N, k] the properties ``NAME_0``, ``NAME_1``, ...: other readers skip them.

    Raises
    ------
    InputError
        If a value is NaN or beyond float32, or the folder does not exist.
    """
    n, n_rest = gaussians.sh_rest.shape[:2]
    rest_names = tuple(f"f_rest_{i}" for i in range(3 * n_rest))
    further = {name: field for name, field in gaussians._asdict().items() if name not in Gaussians._fields}
    fields = (
        (MEANS, gaussians.means),
        (NORMALS, np.zeros((n, 3))),
        (SH_DC, gaussians.sh_dc),
        (rest_names, gaussians.sh_rest.transpose(0, 2, 1).reshape(n, 3 * n_rest)),
        (("opacity",), gaussians.opacity_logits[:, None]),
        (SCALES, gaussians.log_scales),
        (QUATS, gaussians.quats),
        *(_further_properties(name, field) for name, field in further.items()),
    )
    columns: dict[str, NDArray] = {}
    with np.errstate(over="ignore"):  # becomes infinite, which check_finite names
        for names, values in fields:
            columns |= zip(names, values.astype(np.float32).T, strict=True)
    check_finite(path, columns)
    write_vertices(path, columns)


def _further_properties(name: str, field: NDArray) -> tuple[tuple[str, ...], NDArray]:
    """Names of the properties of a further field, and their values [N, k]."""
    if field.ndim == 1:
        return (name,), field[:, None]
    if field.ndim == 2:
        return tuple(f"{name}_{i}" for i in range(field.shape[1])), field
    raise TypeError(f"field {name} has {field.ndim} axes, a PLY holds two: give the extension save and load of its own")


def read_point_cloud(path: str | Path) -> tuple[Floats, NDArray[np.uint8]]:
    """Read the points of a PLY, with their colours.

    Returns
    -------
    points : ndarray of shape (P, 3)
        float64, the file's frame and unit.
    colors : ndarray of shape (P, 3)
        uint8; floating colours of the file count as [0, 1]; middle gray if it has none.
    """
    columns = read_vertices(path)
    missing = [name for name in MEANS if name not in columns]
    if missing:
        raise InputError(f"{path}: not a point cloud, it has no property {', '.join(missing)}")
    check_finite(path, {name: columns[name] for name in (*MEANS, *COLORS) if name in columns})
    points = np.stack([columns[name].astype(np.float64) for name in MEANS], axis=1)  # [P, 3]
    if not all(name in columns for name in COLORS):
        return points, np.full(points.shape, GRAY, np.uint8)
    colors = np.stack([columns[name] for name in COLORS], axis=1)  # [P, 3]
    if colors.dtype.kind == "f":
        colors = np.rint(colors * 255.0)
    return points, colors.clip(0, 255).astype(np.uint8)


def read_vertices(path: str | Path) -> dict[str, NDArray]:
    """Read every property of the vertices of a PLY file.

    Returns
    -------
    dict of ndarray of shape (P,)
        One column per property, in the file's order and scalar type, native byte order.

    Raises
    ------
    InputError
        If the file is missing, malformed or ends before its last declared vertex.
    """
    return _read(path)[1]


class _Header(NamedTuple):
    encoding: str
    n_skipped: int
    """Rows of elements before the vertices, ASCII only."""
    n: int
    """Number of vertices."""
    dtype: np.dtype
    """Of a vertex, structured."""
    n_faces: int


def _read(path: str | Path) -> tuple[_Header, dict[str, NDArray]]:
    """Header and vertices of a file."""
    path = Path(path)
    try:
        file = path.open("rb")
    except OSError as error:
        raise InputError(f"{path}: cannot be opened ({error.strerror})") from None
    with file:
        header = _read_header(file, path)
        with np.errstate(over="ignore"):  # text beyond float32 becomes infinite, which check_finite names
            rows = (_read_ascii if header.encoding == "ascii" else _read_binary)(file, path, header)
    names = rows.dtype.names or ()
    return header, {name: rows[name].astype(rows[name].dtype.newbyteorder("=")) for name in names}


def write_vertices(path: str | Path, columns: Mapping[str, NDArray]) -> None:
    """Write columns of equal length P as the vertices of a little-endian PLY, complete or not at all.

    Each property has the scalar type of its column: uint8, int32, float32 and so on.
    """
    type_names = {code: name for name, code in reversed(SCALAR_TYPES.items()) if not name[-1].isdigit()}
    dtype = np.dtype([(name, column.dtype.newbyteorder("<")) for name, column in columns.items()])
    rows = np.empty(len(next(iter(columns.values()))), dtype)  # [P]
    for name, column in columns.items():
        rows[name] = column
    properties = "".join(f"property {type_names[c.dtype.str[1:]]} {name}\n" for name, c in columns.items())
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    with replacing(path) as temporary:
        temporary.write_bytes(header.encode("ascii") + rows.tobytes())


def check_finite(path: str | Path, columns: Mapping[str, NDArray]) -> None:
    """Raise an InputError that names the property and the first row of a NaN or an infinity."""
    for name, column in columns.items():
        bad_rows = np.flatnonzero(~np.isfinite(column))
        if bad_rows.size:
            raise InputError(
                f"{path}: property {name} is {column[bad_rows[0]]} in row {bad_rows[0]}"
                f" ({bad_rows.size} of {column.size} rows are not finite); remove those rows"
            )


def _sh_rest_names(columns: Mapping[str, NDArray], path: str | Path) -> tuple[str, ...]:
    """Names of the higher coefficients, f_rest_0 first: the file may list them in any order."""
    n_rest = sum(name.startswith("f_rest_") for name in columns)
    allowed = [3 * ((degree + 1) ** 2 - 1) for degree in range(SH_DEGREE_MAX + 1)]
    if n_rest not in allowed:
        raise InputError(
            f"{path}: {n_rest} properties f_rest_*, but spherical harmonics of degree 0 to {SH_DEGREE_MAX}"
            f" have {', '.join(map(str, allowed[:-1]))} or {allowed[-1]}; export it again"
        )
    return tuple(f"f_rest_{i}" for i in range(n_rest))


def _way_out(header: _Header) -> str:
    """What to do with a PLY that does not hold Gaussians."""
    names = header.dtype.names or ()
    if "packed_position" in names:
        return "it is a compressed splat: export it as a plain PLY"
    if header.n_faces:
        return f"it is a mesh of {header.n_faces:,} faces, which is not rendered: give a trained point_cloud.ply"
    if all(name in names for name in MEANS):
        return "it is a point cloud: give it as a scene's points, or give a trained point_cloud.ply"
    return "give a trained point_cloud.ply"


def _read_header(file: BinaryIO, path: Path) -> _Header:
    """Read up to the line end_header."""
    if file.readline(8).strip() != b"ply":
        raise InputError(f"{path}: not a PLY file, it does not begin with 'ply'")
    encoding, element, n_skipped, n, n_faces = "", "", 0, -1, 0
    properties: list[tuple[str, str]] = []
    words: list[str] = []
    while words != ["end_header"]:
        words = file.readline(HEADER_LINE_MAX).decode("ascii", errors="replace").split()
        match words:
            case ["end_header"]:
                pass
            case []:
                raise InputError(f"{path}: truncated, the PLY header has no end_header; copy or export the file again")
            case ["format", name, _] if name in BYTE_ORDERS:
                encoding = name
            case ["element", element, count] if count.isdecimal():
                if element == "vertex":
                    n = int(count)
                    continue
                n_skipped += int(count) if n < 0 else 0
                n_faces += int(count) if element == "face" else 0
            case ["property", kind, name] if kind in SCALAR_TYPES:
                if element == "vertex":
                    properties.append((name, SCALAR_TYPES[kind]))
            case ["property", "list", *_] if element != "vertex":
                pass
            case ["comment" | "obj_info", *_]:
                pass
            case _:
                raise InputError(f"{path}: cannot read the header line '{' '.join(words)}'; export the PLY again")
    names = [name for name, _ in properties]
    if not encoding or n < 0 or not names or len(set(names)) < len(names):
        raise InputError(
            f"{path}: the PLY header lacks its format, vertices or properties, or repeats one; export it again"
        )
    if n_skipped and encoding != "ascii":
        raise InputError(f"{path}: elements stand before the vertices; export the PLY with its vertices first")
    dtype = np.dtype([(name, BYTE_ORDERS[encoding] + code) for name, code in properties])
    return _Header(encoding, n_skipped, n, dtype, n_faces)


def _read_binary(file: BinaryIO, path: Path, header: _Header) -> NDArray:
    """Read the n declared vertices; what follows them is not looked at."""
    n, dtype = header.n, header.dtype
    found = path.stat().st_size - file.tell()
    expected = n * dtype.itemsize
    if found < expected:
        raise InputError(
            f"{path}: truncated, {n} vertices of {dtype.itemsize} bytes need {expected} bytes after the header"
            f" but there are {found}; copy or export the file again"
        )
    return np.frombuffer(file.read(expected), dtype)


def _read_ascii(file: BinaryIO, path: Path, header: _Header) -> NDArray:
    """Read the n declared vertices, one a line."""
    n, n_properties = header.n, len(header.dtype.names or ())
    found = path.stat().st_size - file.tell()
    if found + 1 < header.n_skipped + 2 * n * n_properties:  # a line, or a character and a gap for each number
        raise InputError(f"{path}: truncated, {n} vertices expected, {found} bytes found; copy or export it again")
    rows = np.empty(n, header.dtype)
    lines = itertools.islice(file, header.n_skipped, header.n_skipped + n)
    row = -1
    for row, line in enumerate(lines):
        try:
            rows[row] = tuple(float(word) for word in line.split())
        except (ValueError, OverflowError):
            text = line[:60].decode("ascii", errors="replace").strip()
            raise InputError(
                f"{path}: row {row} is '{text}', not {n_properties} numbers; copy or export it again"
            ) from None
    if row + 1 < n:
        raise InputError(f"{path}: truncated, {n} vertices expected, {row + 1} lines found; copy or export it again")
    return rows
