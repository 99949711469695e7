"""PLY files: trained Gaussians in the 3DGS layout, and point clouds.

The 3DGS layout holds one vertex per Gaussian: ``x y z``, normals (unused, zero), ``f_dc_0..2``, ``f_rest_*``,
``opacity``, ``scale_0..2``, ``rot_0..3``, all before their activations. The higher spherical harmonics are
channel-major: all red coefficients, then all green, then all blue, whereas :class:`Gaussians` keeps RGB last. Rotations
are wxyz, the frame is COLMAP's (x right, y down, z forward).

Files are read by property name, so order, normals and extra properties do not matter; :mod:`.ply_file` reads the bytes,
:mod:`.ply_dialects` has other programs' names of the properties. Left out: compressed variants.
"""

import re
import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.constants import SH_C0, SH_DEGREE_MAX
from minisplat_ref.errors import InputError, InputWarning, one_line
from minisplat_ref.io.label import NO_LABEL, Label, from_comments, to_comments
from minisplat_ref.io.ply_dialects import as_usual, renamed
from minisplat_ref.io.ply_file import (
    comments_of,
    count_rows,
    property_names,
    read_pieces,
    read_vertices,
    write_vertices,
)
from minisplat_ref.io.ply_foreign import describe_columns, describe_ranges
from minisplat_ref.types import Floats, Gaussians
from minisplat_ref.validation import check_quats

MEANS = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
SH_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALES = ("scale_0", "scale_1", "scale_2")
QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
COLORS = ("red", "green", "blue")
PRECISION = 1e-4  # of its largest scale, by which rounding may move a centre; it is 1e-5 in a scene at the origin
COLOR_NAMES = (
    COLORS,
    ("r", "g", "b"),
    *(tuple(f"{word}{color}" for color in COLORS) for word in ("diffuse_", "vertex_", "ambient_", "color_", "scalar_")),
    ("color_r", "color_g", "color_b"),
    SH_DC,
)
"""Names of colours in the PLY files of different programs, upper case aside; the first that are there count."""

OTHER_FIELDS = {"filter_3D": "filter_sigmas"}
"""Columns of other programs that are fields of our extensions."""

GRAY = 128  # colour of a point cloud that has none


def load_ply(path: str | Path, population: Any = Gaussians) -> Any:
    """Read trained Gaussians from a PLY in the 3DGS layout.

    Parameters
    ----------
    path : str or Path
        The file; spherical harmonics of degree 0 to 3, with or without normals. Bytes after the declared vertices do
        not matter.
    population : type
        :class:`Gaussians`, or a NamedTuple with its fields and others, which are read from the properties that
        :func:`save_ply` writes.

    Returns
    -------
    Gaussians, or whatever ``population`` is
        N may be 0. float64 if any property of the file is, else float32.

    Raises
    ------
    InputError
        If the file is missing, truncated, not a PLY of Gaussians, or holds NaN, a zero quaternion, or an infinity other
        than those that :mod:`.ply_dialects` understands.

    Warns
    -----
    InputWarning
        Of columns that 3DGS does not draw, and of values that are hardly its own (:mod:`.ply_foreign`); not of those of
        an extension that the file names.
    """
    if population is Gaussians and (found := _load_in_pieces(Path(path))) is not None:
        _warn_of_foreign(path, found)
        return found
    columns = as_usual(path, read_vertices(path))
    for theirs, ours in OTHER_FIELDS.items():
        if ours in population._fields and ours not in columns and theirs in columns:
            columns[ours] = columns[theirs]
    rest_names = _sh_rest_names(columns, path)
    further = {field: _further_names(columns, field) for field in population._fields if field not in Gaussians._fields}
    names = (*MEANS, *SH_DC, *rest_names, "opacity", *SCALES, *QUATS)
    missing = [name for name in names if name not in columns]
    if missing:
        raise InputError(f"{path}: not a PLY of Gaussians, no property {', '.join(missing)}; {_way_out(path, columns)}")
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
    read = population(
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
    _warn_of_foreign(path, read)
    return read


def _load_in_pieces(path: Path) -> Gaussians | None:
    """Read a binary file with the usual properties into its fields, a few rows at a time, so that it is there once.

    None for a file with other names, or with values that are not finite, of which the reader of columns knows more.
    """
    rest = [name for name in property_names(path) if name.startswith("f_rest_")]
    n_rest = len(rest) // 3
    names = (*MEANS, *SH_DC, *(f"f_rest_{i}" for i in range(3 * n_rest)), "opacity", *SCALES, *QUATS)
    if 3 * n_rest != len(rest) or n_rest not in [(degree + 1) ** 2 - 1 for degree in range(SH_DEGREE_MAX + 1)]:
        return None
    found = read_pieces(path, names)
    if found is None:
        return None
    n, dtype, pieces = found
    shapes = ((3,), (4,), (3,), (), (3,), (n_rest, 3))
    fields = Gaussians(*(np.empty((n, *shape), dtype) for shape in shapes))
    start = 0
    for rows in pieces:
        part = slice(start, start + len(rows))
        start += len(rows)
        for field, group in ((0, MEANS), (1, QUATS), (2, SCALES), (4, SH_DC)):
            for i, name in enumerate(group):
                fields[field][part, i] = rows[name]
        fields.opacity_logits[part] = rows["opacity"]
        for i in range(3 * n_rest):
            fields.sh_rest[part, i % n_rest, i // n_rest] = rows[f"f_rest_{i}"]
        if not all(np.isfinite(field[part]).all() for field in fields):
            return None
    check_quats(path, fields.quats)
    return fields


def _warn_of_foreign(path: str | Path, population: Any) -> None:
    """Warn of what is left out or unlikely."""
    notes = describe_ranges(population)
    if isinstance(population, Gaussians) and read_label(path).extension is None:
        notes = [f"not drawn are {sentence}" for sentence in describe_columns(further_properties(path))] + notes
    if notes:
        warnings.warn(one_line(f"{path}: {'; '.join(notes)}"), InputWarning, stacklevel=3)


def _further_names(columns: Iterable[str], field: str) -> tuple[str, ...]:
    """Return a further field's properties: ``FIELD`` if it has shape [N], ``FIELD_0``, ``FIELD_1``, ... for [N, k]."""
    numbered = [name for name in columns if re.fullmatch(rf"{re.escape(field)}_\d+", name)]
    return (field,) if field in columns else tuple(sorted(numbered, key=lambda name: int(name.rpartition("_")[2])))


def further_properties(path: str | Path) -> tuple[str, ...]:
    """Return the names of the properties that a PLY of Gaussians has beyond those of 3DGS, such as an extension's.

    Raises
    ------
    InputError
        If the file cannot be opened or its header is malformed.
    """
    names = property_names(path)
    others = renamed(names)
    usual = {*MEANS, *NORMALS, *SH_DC, "opacity", *SCALES, *QUATS, *others}
    if not any(others.get(name, name) in SH_DC for name in names):
        usual |= set(color_names(names) or ())
    return tuple(name for name in names if name not in usual and not name.startswith("f_rest_"))


def save_ply(path: str | Path, gaussians: Any, label: Label = NO_LABEL) -> None:
    """Write trained Gaussians as a PLY in the 3DGS layout: binary, little-endian, float32, with zero normals.

    Centres in float64 that float32 would move by much of the Gaussians' size, such as those of a scene in UTM
    coordinates, become properties of type double.

    Parameters
    ----------
    path : str or Path
        File to create or replace, completely or not at all.
    gaussians : Gaussians, or a NamedTuple that has its fields and others
        Of any spherical-harmonic degree; N may be 0. A further field of shape [N] becomes a property with its name, one
        of shape [N, k] the properties ``NAME_0``, ``NAME_1``, ...; other readers skip them.
    label : Label
        The label in the header, which names the file's renderer.

    Raises
    ------
    InputError
        If a value is NaN or beyond float32, or the folder does not exist.
    """
    n, n_rest = gaussians.sh_rest.shape[:2]
    rest_names = tuple(f"f_rest_{i}" for i in range(3 * n_rest))
    further = {name: field for name, field in gaussians._asdict().items() if name not in Gaussians._fields}
    fields = (
        (MEANS, gaussians.means.T),
        (NORMALS, np.zeros((3, n), np.float32)),
        (SH_DC, gaussians.sh_dc.T),
        (rest_names, [gaussians.sh_rest[:, k, c] for c in range(3) for k in range(n_rest)]),
        (("opacity",), gaussians.opacity_logits[None]),
        (SCALES, gaussians.log_scales.T),
        (QUATS, gaussians.quats.T),
        *(_further_properties(name, field) for name, field in further.items()),
    )
    columns: dict[str, NDArray] = {}  # where they are float32, views: a large population is not copied
    with np.errstate(over="ignore"):  # becomes infinite, which check_finite names
        for names, values in fields:
            dtype = np.float64 if names == MEANS and are_far(gaussians) else np.float32
            columns |= zip(names, (column.astype(dtype, copy=False) for column in values), strict=True)
    check_finite(path, columns)
    write_vertices(path, columns, comments=to_comments(label))


def read_label(path: str | Path) -> Label:
    """Return the label of a PLY.

    Raises
    ------
    InputError
        If the file cannot be opened, or its header or its label is malformed.
    """
    return from_comments(comments_of(path), path)


def are_far(gaussians: Any) -> bool:
    """Return whether centres lie so far from the origin that float32 would move most by a large part of their size."""
    means, log_scales = gaussians.means, getattr(gaussians, "log_scales", None)
    if means.dtype != np.float64 or log_scales is None or not len(means):
        return False
    with np.errstate(over="ignore", invalid="ignore"):
        moved = np.abs(means - means.astype(np.float32)).max(axis=1)  # [N]
        return bool(np.median(moved / np.exp(log_scales.max(axis=1).astype(np.float64))) > PRECISION)


def _further_properties(name: str, field: NDArray) -> tuple[tuple[str, ...], NDArray]:
    """Return the names of a further field's properties, and their values [k, N]."""
    if field.ndim == 1:
        return (name,), field[None]
    if field.ndim == 2:
        return tuple(f"{name}_{i}" for i in range(field.shape[1])), field.T
    raise TypeError(f"field {name} has {field.ndim} axes, a PLY holds two: give the extension save and load of its own")


class PointCloud(NamedTuple):
    """Points with colours."""

    points: Floats
    """[P, 3] float64, the file's frame and unit."""
    colors: NDArray[np.uint8]
    """[P, 3] RGB."""
    has_colors: bool
    """Whether the colours are the file's; they are middle gray if it has none."""
    n_dropped: int
    """Points of the file that were left out because a coordinate or colour is not finite, or beyond float32."""

    @property
    def dropped(self) -> str:
        """Return half a sentence on the points that were left out, empty if there are none."""
        n = len(self.points) + self.n_dropped
        return f"{self.n_dropped:,} of {n:,} points are not finite" if self.n_dropped else ""


NO_POINTS = PointCloud(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), False, 0)


def load_points(path: str | Path) -> PointCloud:
    """Read the points of any PLY, with their colours.

    To train from them, replace the scene's own points at the start, in the scene's world frame::

        start = scene._replace(points=cloud.points, point_colors=cloud.colors)
        train(scene, recipe, seed=0, state=initial_state(start, recipe, seed=0))

    Parameters
    ----------
    path : str or Path
        The file, with the properties ``x``, ``y``, ``z`` and, for colours, ``red``, ``green``, ``blue`` or one of the
        other triples of ``COLOR_NAMES``: integers from 0 to 255, floats from 0 to 1, or coefficients ``f_dc_0`` to
        ``f_dc_2`` of Gaussians. Everything else is ignored.

    Returns
    -------
    PointCloud
        P may be 0.

    Raises
    ------
    InputError
        If the file cannot be read, has no coordinates, or its colours are out of range.
    """
    columns = read_vertices(path)
    missing = [name for name in MEANS if name not in columns]
    if missing:
        raise InputError(f"{path}: not a point cloud, it has no property {', '.join(missing)}")
    names = color_names(columns)
    with np.errstate(over="ignore", invalid="ignore"):  # the latter of a signalling NaN
        used = np.stack([columns[name] for name in (*MEANS, *(names or ()))], axis=1, dtype=np.float64)
        is_finite = np.isfinite(used.astype(np.float32)).all(axis=1)  # [P]
    used = used[is_finite]  # [P, 3 or 6]
    points = np.ascontiguousarray(used[:, :3])
    if names is None:
        colors = np.full(points.shape, GRAY, np.uint8)
    elif names == SH_DC:
        colors = np.rint(255.0 * np.clip(0.5 + SH_C0 * used[:, 3:], 0.0, 1.0)).astype(np.uint8)
    else:
        colors = _as_bytes(path, columns, names, used[:, 3:])
    return PointCloud(points, colors, names is not None, int(np.count_nonzero(~is_finite)))


def color_names(names: Collection[str]) -> tuple[str, str, str] | None:
    """Return which of a cloud's properties are its colours: the three as any program calls them; None without."""
    known = {name.casefold(): name for name in names}
    found = (tuple(known.get(name) for name in group) for group in COLOR_NAMES)
    return next(((r, g, b) for r, g, b in found if r is not None and g is not None and b is not None), None)


def _as_bytes(
    path: str | Path, columns: Mapping[str, NDArray], names: Sequence[str], colors: Floats
) -> NDArray[np.uint8]:
    """Return colours [P, 3] as bytes, converted by the type that each has in the file."""
    is_float = [columns[name].dtype.kind == "f" for name in names]
    levels = np.rint(colors * np.where(is_float, 255.0, 1.0))  # [P, 3]
    for name, column, values, floats in zip(names, levels.T, colors.T, is_float, strict=True):
        is_bad = (column < 0) | (column > 255)
        if is_bad.any():
            raise InputError(
                f"{path}: {name} is {values[is_bad][0]:g}; colours are integers from 0 to 255 or floats from 0 to 1:"
                f" export them as {'floats in this range, or ' if floats else ''}uchar"
            )
    return levels.astype(np.uint8)


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
    """Return the names of the higher coefficients, f_rest_0 first; the file may list them in any order."""
    n_rest = sum(name.startswith("f_rest_") for name in columns)
    allowed = [3 * ((degree + 1) ** 2 - 1) for degree in range(SH_DEGREE_MAX + 1)]
    if n_rest not in allowed:
        raise InputError(
            f"{path}: {n_rest} properties f_rest_*, but spherical harmonics of degree 0 to {SH_DEGREE_MAX}"
            f" have {', '.join(map(str, allowed[:-1]))} or {allowed[-1]}; export it again"
        )
    return tuple(f"f_rest_{i}" for i in range(n_rest))


def _way_out(path: str | Path, columns: Mapping[str, NDArray]) -> str:
    """Return advice for a PLY that does not contain Gaussians."""
    if "packed_position" in columns:
        return "it is SuperSplat's: let its name end in .compressed.ply"
    n_faces = count_rows(path, "face")
    if n_faces:
        return f"it is a mesh of {n_faces:,} faces, which is not rendered: give a trained point_cloud.ply"
    if "opacity" in columns or any(name in columns for name in (*SCALES, *QUATS)):
        return "export it again with all properties of Gaussians (colours may also be red, green, blue)"
    if all(name in columns for name in MEANS):
        return "it is a point cloud: give it as a scene's points, or give a trained point_cloud.ply"
    return "give a trained point_cloud.ply"
