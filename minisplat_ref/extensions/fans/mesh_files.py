"""Fans as files: meshes for other programs, and the population's own PLY, which is such a mesh, too.

A mesh file has a colour at each vertex, red, green, blue and opacity.

- ``.ply``: four bytes, in the world frame of the model.
- ``.glb``, glTF in one file: floats, in the frame and the colours of glTF, and a material that blends, is not lit and
  has two sides (:func:`minisplat_ref.mechanisms.meshes.files.to_glb`).
- ``.obj``: the world frame. The format has no opacity at a vertex, so that all triangles are opaque.

The population's PLY holds every fan whole, with floats ``rgba_0`` to ``rgba_3`` besides the bytes, so that it can be
trained further and rendered exactly. Its faces encode how many sides a fan has, and whether it is flat.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.fans.model import SOLID_PLANES, Fans, FanShape, mesh_of
from minisplat_ref.io.label import Label, to_comments
from minisplat_ref.io.ply import COLORS, MEANS, check_finite
from minisplat_ref.io.ply_faces import read_faces
from minisplat_ref.io.ply_file import property_names, read_vertices, write_vertices
from minisplat_ref.mechanisms.meshes.files import check_suffix, write_by_trimesh
from minisplat_ref.mechanisms.peeling.layers import TranslucentMesh, check_translucent, to_bytes
from minisplat_ref.types import Floats

BYTES = (*COLORS, "alpha")
FLOATS = ("rgba_0", "rgba_1", "rgba_2", "rgba_3")
LABEL = Label("fans")


def write_mesh(path: Path, mesh: TranslucentMesh) -> None:
    """Write a mesh in the format of its suffix, complete or not at all.

    Raises
    ------
    InputError
        As for :func:`minisplat_ref.mechanisms.meshes.files.check_suffix`, or the file cannot be written.
    """
    check_suffix(path)
    if path.suffix.lower() == ".ply":
        write_vertices(path, _columns(mesh.vertices, to_bytes(mesh.rgba)), mesh.faces)
        return
    write_by_trimesh(path, mesh.vertices, mesh.rgba, mesh.faces, alphaMode="BLEND", doubleSided=True)


def save_fans(path: str | Path, fans: Fans, label: Label = LABEL) -> None:
    """Write a population of fans as a PLY in float32, complete or not at all; its label names its renderer.

    Raises
    ------
    InputError
        If a value is NaN or beyond float32, or the folder does not exist.
    """
    mesh = mesh_of(fans)
    with np.errstate(over="ignore"):  # becomes infinite, which check_finite names
        columns = _columns(mesh.vertices, to_bytes(mesh.rgba))
        columns |= zip(FLOATS, mesh.rgba.astype(np.float32).T, strict=True)
    check_finite(path, columns)
    write_vertices(path, columns, mesh.faces, to_comments(label))


def is_fans(path: str | Path) -> bool:
    """Return whether a PLY has the properties that :func:`save_fans` writes.

    Raises
    ------
    InputError
        If the file cannot be opened or its header is malformed.
    """
    return set(FLOATS) <= set(property_names(path))


def load_fans(path: str | Path, population: Any = Fans) -> Fans:
    """Read a file of :func:`save_fans`, in float32.

    Raises
    ------
    InputError
        If the file is missing or damaged, or holds another mesh or numbers out of range.
    """
    columns = read_vertices(path)
    missing = [name for name in (*MEANS, *FLOATS) if name not in columns]
    if missing:
        raise InputError(f"{path}: not a PLY of fans, no property {', '.join(missing)}; give that of a run of fans")
    check_finite(path, {name: columns[name] for name in (*MEANS, *FLOATS)})
    vertices, rgba = (
        np.stack([columns[name] for name in names], axis=1).astype(np.float32) for names in (MEANS, FLOATS)
    )
    polygons = read_faces(path)
    if len(vertices) == 0 and not polygons:
        return _split_fans(vertices, rgba, 0, 1, FanShape().n_sides)
    faces = np.array(polygons) if all(len(polygon) == 3 for polygon in polygons) else np.zeros((0, 3), int)
    n = len(np.unique(faces[:, 0])) if len(faces) else 0
    if n == 0 or len(vertices) % n or len(faces) % n:
        raise InputError(f"{path}: its faces make no fans; give the PLY of a run as it is")
    n_rim, n_faces = len(vertices) // n - 1, len(faces) // n
    planes = 1 if n_faces == n_rim else SOLID_PLANES
    owned = n_rim // planes
    is_possible = n_rim == planes * owned and n_faces == (n_rim if planes == 1 else n_rim + 2 * SOLID_PLANES)
    if not is_possible or (planes == SOLID_PLANES and owned % 4 != 2):
        raise InputError(
            f"{path}: {n_faces} triangles about {n_rim} vertices make no fan; give the PLY of a run as it is"
        )
    fans = _split_fans(vertices, rgba, n, planes, owned)
    mesh = mesh_of(fans)
    if not np.array_equal(mesh.faces, faces):
        raise InputError(f"{path}: its triangles are not those of {n:,} fans, one after the other; do not sort them")
    check_translucent(mesh, path)
    return fans


def _columns(vertices: Floats, rgba: NDArray[np.uint8]) -> dict[str, NDArray]:
    """Return the columns of a mesh's vertices."""
    return dict(zip((*MEANS, *BYTES), (*vertices.astype(np.float32).T, *rgba.T), strict=True))


def _split_fans(vertices: Floats, rgba: Floats, n: int, planes: int, owned: int) -> Fans:
    """Return the fans of vertices [N V, 3] and RGBA [N V, 4]."""
    v = 1 + planes * owned
    vertices, rgba = vertices.reshape(n, v, 3), rgba.reshape(n, v, 4)
    fields = vertices[:, 0], vertices[:, 1:].reshape(n, planes, owned, 3), rgba[:, :, :3], rgba[:, :, 3]
    return Fans._make(np.ascontiguousarray(field) for field in fields)
