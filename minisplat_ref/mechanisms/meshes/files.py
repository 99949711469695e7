"""Files of coloured meshes: ``.ply``, ``.obj`` and ``.glb`` (glTF in one file)."""

from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.io.formats import write_content
from minisplat_ref.io.ply import COLORS, MEANS
from minisplat_ref.io.ply_file import write_vertices
from minisplat_ref.mechanisms.fusion.extraction import ColoredMesh

SUFFIXES = (".ply", ".glb", ".obj")


def check_suffix(path: Path) -> None:
    """Refuse a name that says no format, or one that needs a package that is not installed.

    Raises
    ------
    InputError
        One line that says which suffixes there are, or how to install trimesh.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path} is not named like a mesh: give a name that ends in {', '.join(SUFFIXES)}")
    if path.suffix.lower() != ".ply":
        trimesh_package()


def trimesh_package() -> Any:
    """Return the package.

    Raises
    ------
    InputError
        It is not installed.
    """
    try:
        import trimesh
    except ImportError:
        raise InputError(
            "glTF and OBJ are written by trimesh, which is not installed: pip install 'minisplat_ref[meshes]', or write"
            " a .ply"
        ) from None
    return trimesh


def write_mesh(path: Path, mesh: ColoredMesh) -> None:
    """Write a mesh in the format that its suffix says, complete or not at all.

    A PLY has float64 coordinates, so that a scene far from the origin keeps its place; glTF has float32.

    Raises
    ------
    InputError
        As for :func:`check_suffix`, or the file cannot be written.
    """
    check_suffix(path)
    colors = np.rint(255 * mesh.colors).astype(np.uint8)
    if path.suffix.lower() == ".ply":
        columns = dict(zip((*MEANS, *COLORS), (*mesh.vertices.T, *colors.T), strict=True))
        write_vertices(path, columns, mesh.faces)
        return
    opaque = np.column_stack([colors, np.full(len(colors), 255, np.uint8)])
    solid = trimesh_package().Trimesh(mesh.vertices, mesh.faces, vertex_colors=opaque, process=False)
    content = solid.export(file_type=path.suffix.lower()[1:])
    write_content(path, content.encode() if isinstance(content, str) else content)
