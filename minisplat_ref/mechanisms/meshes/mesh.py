"""A triangle mesh: its files, the frame of a triangle, and the coordinates of a point in it.

A triangle with the corners p0, p1, p2 has the frame

    E = [e1, e2, h n],   e1 = p1 - p0,   e2 = p2 - p0,   n = e1 x e2 / |e1 x e2|,   h = sqrt(|e1 x e2|)

in which a point is ``x = p0 + E (b1, b2, w)``: (1 - b1 - b2, b1, b2) are the barycentric coordinates of its projection
onto the plane of the triangle, and w is its signed distance from that plane in units of h. As h scales with the
triangle, a mesh that is rotated, translated and scaled takes its points along exactly.

Left out are textures, normals and colours of a mesh, and formats other than PLY.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.io.ply import MEANS, check_finite
from minisplat_ref.io.ply_faces import read_faces
from minisplat_ref.io.ply_file import read_vertices, write_vertices
from minisplat_ref.types import Bools, Floats, Ints

HEIGHT_MIN = 1e-6  # of a triangle over its longest side; below, its frame loses more than half of float64's digits


class Mesh(NamedTuple):
    """A triangle mesh."""

    vertices: Floats
    """[P, 3] float64, world frame."""
    faces: Ints
    """[T, 3] rows of the vertices at the corners of each triangle."""

    @property
    def corners(self) -> Floats:
        """[T, 3, 3] world frame: triangle, corner, axis."""
        return self.vertices[self.faces]


def frames(mesh: Mesh) -> Floats:
    """Return the frames E of the triangles, as matrices whose columns are ``e1, e2, h n``.

    Parameters
    ----------
    mesh : Mesh
        T triangles, each with an area.

    Returns
    -------
    ndarray of shape (T, 3, 3)
        E, world_from_triangle, in world units.
    """
    p0, p1, p2 = np.moveaxis(mesh.corners, 1, 0)  # [T, 3] each
    e1, e2 = p1 - p0, p2 - p0
    across = np.cross(e1, e2)  # h^2 n
    h = np.sqrt(np.linalg.norm(across, axis=1, keepdims=True))  # [T, 1]
    return np.stack([e1, e2, across / h], axis=2)


def load_mesh(path: str | Path) -> Mesh:
    """Read a triangle mesh from a PLY file; faces of more than three corners become triangle fans.

    Parameters
    ----------
    path : str or Path
        PLY with vertices and faces.

    Raises
    ------
    InputError
        The file cannot be read, has no faces, or :func:`check_mesh` refuses its mesh.
    """
    columns = read_vertices(path)
    missing = [name for name in MEANS if name not in columns]
    if missing:
        raise InputError(f"{path}: not a mesh, its vertices have no property {', '.join(missing)}; export it again")
    coordinates = {name: columns[name].astype(np.float64) for name in MEANS}
    check_finite(path, coordinates)
    polygons = read_faces(path)
    if not polygons:
        raise InputError(f"{path}: a mesh of no faces; give a triangle mesh, or make one with: proxies cage MODEL MESH")
    triangles = [np.stack([np.repeat(p[:1], len(p) - 2), p[1:-1], p[2:]], axis=1) for p in polygons if len(p) > 2]
    if len(triangles) < len(polygons):
        first = next(i for i, p in enumerate(polygons) if len(p) < 3)
        raise InputError(f"{path}: face {first} has {len(polygons[first])} corners, not 3 or more; remove that face")
    mesh = Mesh(np.stack(list(coordinates.values()), axis=1), np.concatenate(triangles))
    check_mesh(mesh, path)
    return mesh


def save_mesh(path: str | Path, mesh: Mesh) -> None:
    """Write a mesh as a PLY with float64 vertices; the file is complete or not written at all."""
    write_vertices(path, dict(zip(MEANS, mesh.vertices.T, strict=True)), mesh.faces)


def check_mesh(mesh: Mesh, source: str | Path) -> None:
    """Refuse corners that do not exist and triangles without an area.

    Parameters
    ----------
    mesh : Mesh
        The mesh to check.
    source : str or Path
        Its name, with which messages begin.

    Raises
    ------
    InputError
        The mesh is bad; the line names the first bad face.
    """
    is_absent = (mesh.faces < 0) | (mesh.faces >= len(mesh.vertices))  # [T, 3]
    if is_absent.any():
        face, corner = np.argwhere(is_absent)[0]
        raise InputError(
            f"{source}: face {face} has the corner {mesh.faces[face, corner]}, but there are {len(mesh.vertices)}"
            " vertices, counted from 0; export the mesh again"
        )
    is_flat = flat_triangles(mesh.corners)
    if is_flat.any():
        raise InputError(
            f"{source}: triangle {np.argmax(is_flat)} has no area ({is_flat.sum()} of {len(is_flat)} have none): its"
            " corners coincide or lie on one line; merge vertices that coincide, or remove those faces"
        )


def flat_triangles(corners: Floats) -> Bools:
    """Return which triangles [T], of ``corners`` [T, 3, 3], have no area: their corners coincide or lie on one line."""
    longest = side_lengths(corners).max(axis=1, initial=0)  # [T]
    doubled = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)  # 2 area
    return np.asarray(~(doubled > HEIGHT_MIN * longest**2))


def side_lengths(corners: Floats) -> Floats:
    """Return the lengths [T, 3] of the sides of triangles: of side k from corner k to the next."""
    return np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)


def check_same_faces(rest: Mesh, deformed: Mesh, source: str | Path) -> None:
    """Refuse a deformed mesh whose numbers of vertices or whose faces differ from those of the mesh at rest.

    Parameters
    ----------
    rest, deformed : Mesh
        Both meshes.
    source : str or Path
        Name of the deformed mesh, for the message.

    Raises
    ------
    InputError
        They differ; the message names the difference.
    """
    if len(deformed.vertices) != len(rest.vertices) or not np.array_equal(deformed.faces, rest.faces):
        raise InputError(
            f"{source}: {len(deformed.vertices)} vertices and {len(deformed.faces)} triangles, not the"
            f" {len(rest.vertices)} and {len(rest.faces)} of the mesh at rest in the same order; move vertices only,"
            " and export without merging or sorting them"
        )
