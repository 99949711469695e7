"""Files of coloured meshes: ``.ply``, ``.obj`` and ``.glb`` (glTF in one file).

PLY and OBJ hold a mesh as the program does: in the frame of the scene, with colours in sRGB, a byte each. glTF defines
the axes, the colour space and the material of a mesh, to which :func:`to_glb` converts it.
"""

from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.io.formats import GLTF_AXES, write_content
from minisplat_ref.io.ply import COLORS, MEANS
from minisplat_ref.io.ply_file import write_vertices
from minisplat_ref.io.srgb import decode_srgb
from minisplat_ref.mechanisms.fusion.extraction import ColoredMesh
from minisplat_ref.types import Floats, Ints

SUFFIXES = (".ply", ".glb", ".obj")
UNLIT = "KHR_materials_unlit"
_COLOR = "_COLOR"  # trimesh writes floats only under such a name


def check_suffix(path: Path) -> None:
    """Refuse a name without a known format, or one that needs a package that is not installed.

    Raises
    ------
    InputError
        One line with the known suffixes, or the command that installs trimesh.
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
    """Write a mesh in the format of its suffix, complete or not at all.

    A PLY has float64 coordinates, so that a scene far from the origin keeps its place; glTF has float32.

    Raises
    ------
    InputError
        As for :func:`check_suffix`, or the file cannot be written.
    """
    check_suffix(path)
    if path.suffix.lower() == ".ply":
        colors = np.rint(255 * mesh.colors).astype(np.uint8)
        columns = dict(zip((*MEANS, *COLORS), (*mesh.vertices.T, *colors.T), strict=True))
        write_vertices(path, columns, mesh.faces)
    else:
        write_by_trimesh(path, mesh.vertices, mesh.colors, mesh.faces)


def write_by_trimesh(path: Path, vertices: Floats, colors: Floats, faces: Ints, **material: Any) -> None:
    """Write a mesh as ``.obj`` or ``.glb``, complete or not at all; the arguments are those of :func:`to_glb`.

    Raises
    ------
    InputError
        trimesh is not installed, or the file cannot be written.
    """
    if path.suffix.lower() == ".glb":
        content = to_glb(vertices, colors, faces, **material)
    else:
        levels = np.rint(255 * np.clip(colors, 0, 1)).astype(np.uint8)
        solid = trimesh_package().Trimesh(vertices, faces, vertex_colors=levels, process=False)
        content = solid.export(file_type="obj").encode()
    write_content(path, content)


def to_glb(vertices: Floats, colors: Floats, faces: Ints, **material: Any) -> bytes:
    """Return a mesh as glTF 2.0 in one file.

    - Positions are in the frame of glTF: x and y change sign.
    - ``COLOR_0`` is linear, by the curve of IEC 61966-2-1, and stored in float32. Bytes would keep 183 of the 256
      levels of sRGB and make the darkest seven black. Opacity is not encoded in sRGB and stays as it is.
    - The material is unlit (KHR_materials_unlit), because the colours contain the light of the photographs. A program
      without this extension lights a matt surface; glTF's default material is a metal, which mirrors its surroundings.
    - ``NORMAL`` is the mean of the triangles around a vertex, weighed by their areas, for those programs.
    - Triangles are visible from the front only, unless ``doubleSided`` is set. No camera has seen the back of
      a fused surface, and from outside a room one looks through its walls.

    Parameters
    ----------
    vertices : ndarray of shape (P, 3)
        World frame, world units.
    colors : ndarray of shape (P, 3) or (P, 4)
        sRGB, and opacity if there is one, clipped to [0, 1].
    faces : ndarray of shape (T, 3)
        Rows of the vertices, counter-clockwise seen from outside.
    **material
        Further properties of the material, by their names in glTF, such as ``alphaMode="BLEND"``.

    Raises
    ------
    InputError
        trimesh is not installed.
    """
    shares = np.clip(colors, 0, 1)
    linear = np.column_stack([decode_srgb(shares[:, :3]), shares[:, 3:]]).astype(np.float32)
    matt = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}

    def add_material(tree: dict[str, Any]) -> None:
        tree["extensionsUsed"] = [UNLIT]
        tree["materials"] = [matt | {"extensions": {UNLIT: {}}} | material]
        for mesh in tree.get("meshes", []):  # none if there are no triangles
            (primitive,) = mesh["primitives"]
            primitive["attributes"]["COLOR_0"] = primitive["attributes"].pop(_COLOR)
            primitive["material"] = 0

    turned = vertices * GLTF_AXES  # a rotation: the order of a triangle's corners stays
    solid = trimesh_package().Trimesh(turned, faces, vertex_attributes={_COLOR: linear}, process=False)
    if len(turned):
        solid.vertex_normals = vertex_normals(turned, faces)
    content: bytes = solid.export(file_type="glb", include_normals=len(turned) > 0, tree_postprocessor=add_material)
    return content


def vertex_normals(vertices: Floats, faces: Ints) -> Floats:
    """Return the unit normal of each vertex, the mean of its triangles weighed by their areas.

    Parameters
    ----------
    vertices : ndarray of shape (P, 3)
    faces : ndarray of shape (T, 3)
        Rows of the vertices, counter-clockwise seen from where the normals point.

    Returns
    -------
    ndarray of shape (P, 3)
        Along z where triangles are degenerate, cancel or are absent: a file may not hold a normal of no direction.
    """
    p0, p1, p2 = np.moveaxis(vertices[faces].astype(np.float64), 1, 0)  # [T, 3] each
    areas = np.cross(p1 - p0, p2 - p0)  # [T, 3], twice as long as the area
    sums = np.stack(
        [np.bincount(faces.ravel(), np.repeat(along, 3), len(vertices)) for along in areas.T], axis=1
    )  # [P, 3]
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    is_known = lengths > 0
    return np.where(is_known, sums / np.where(is_known, lengths, 1.0), [0.0, 0.0, 1.0])
