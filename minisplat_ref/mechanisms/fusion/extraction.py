"""The surface of a volume: marching cubes by scikit-image, colours, and the largest connected parts."""

from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.fusion.volume import Grid, Volume
from minisplat_ref.mechanisms.meshes.mesh import flat_triangles, side_lengths
from minisplat_ref.types import Bools, Floats, Ints

SHORT_SIDE = 1e-3  # of a flat triangle's longest side, our choice; the ends of a shorter one become one vertex


class ColoredMesh(NamedTuple):
    """A triangle mesh with a colour at each vertex."""

    vertices: Floats
    """[P, 3] float64, world frame."""
    faces: Ints
    """[T, 3] rows of the vertices, counter-clockwise seen from outside."""
    colors: Floats
    """[P, 3] RGB in [0, 1]."""

    @property
    def corners(self) -> Floats:
        """[T, 3, 3] world frame: triangle, corner, axis."""
        return self.vertices[self.faces]


def marching_cubes_package() -> Any:
    """Return ``skimage.measure``.

    Raises
    ------
    InputError
        It is not installed.
    """
    try:
        from skimage import measure
    except ImportError:
        raise InputError(
            "marching cubes are scikit-image's, which is not installed: pip install 'minisplat_ref[meshes]'"
        ) from None
    return measure


def extract(volume: Volume, grid: Grid, min_views: int) -> ColoredMesh:
    """Return the surface of distance 0, in the cells whose eight corners all were seen by ``min_views`` views.

    Raises
    ------
    InputError
        There is no such place, or scikit-image is not installed.
    """
    measure = marching_cubes_package()
    is_cell = _whole_cells(volume.weights >= min_views)
    distances = volume.distances
    try:
        places, faces, _, _ = measure.marching_cubes(
            distances, 0.0, mask=np.pad(is_cell, ((1, 0), (1, 0), (1, 0))), gradient_direction="descent"
        )
    except (ValueError, RuntimeError):  # no cell is crossed; which of the two depends on what there is instead
        raise InputError(
            f"no surface: no cell of the grid was seen by {min_views} views and crossed by what they show"
        ) from None
    colors = [map_coordinates(volume.colors[..., c], places.T, order=1, mode="nearest") for c in range(3)]
    vertices = grid.to_world(np.array(grid.origin) + grid.voxel * places.astype(np.float64))
    return without_flat(ColoredMesh(vertices, faces.astype(np.int64), np.clip(np.stack(colors, axis=1), 0, 1)))


def _whole_cells(is_seen: Bools) -> Bools:
    """Return which cells [nx - 1, ny - 1, nz - 1] have eight seen corners, of voxels [nx, ny, nz]."""
    for axis in range(3):
        is_seen = np.logical_and(np.delete(is_seen, -1, axis), np.delete(is_seen, 0, axis))
    return is_seen


def without_flat(mesh: ColoredMesh) -> ColoredMesh:
    """Return a mesh without the triangles that have no area, as others refuse them.

    They occur where the surface runs through the centre of a voxel: marching cubes then put corners of several cells in
    one place. Such corners become one, which leaves no hole; a flat triangle without a short side is left out.
    """
    is_flat = flat_triangles(mesh.corners)
    if not is_flat.any():
        return mesh
    n, flat = len(mesh.vertices), mesh.faces[is_flat]
    sides = side_lengths(mesh.corners[is_flat])  # [F, 3]
    is_short = sides <= SHORT_SIDE * sides.max(axis=1, keepdims=True)
    ends = flat[is_short], np.roll(flat, -1, axis=1)[is_short]
    _, place = connected_components(coo_array((np.ones(len(ends[0]), bool), ends), shape=(n, n)), directed=False)
    _, first = np.unique(place, return_index=True)  # the vertex that stands for all in its place
    faces = first[place[mesh.faces]]
    is_kept = ~flat_triangles(mesh.vertices[faces])
    return mesh._replace(faces=faces[is_kept])


def keep_largest(mesh: ColoredMesh, n_parts: int) -> ColoredMesh:
    """Return the ``n_parts`` connected parts of a mesh that have the most triangles; of equals the first."""
    n = len(mesh.vertices)
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]]])
    graph = coo_array((np.ones(len(edges), bool), (edges[:, 0], edges[:, 1])), shape=(n, n))
    _, part_of_vertex = connected_components(graph, directed=False)
    part_of_face = part_of_vertex[mesh.faces[:, 0]]
    sizes = np.bincount(part_of_face, minlength=part_of_vertex.max(initial=-1) + 1)
    kept = np.argsort(-sizes, kind="stable")[:n_parts]
    faces = mesh.faces[np.isin(part_of_face, kept)]
    used, rows = np.unique(faces, return_inverse=True)
    return ColoredMesh(mesh.vertices[used], rows.reshape(faces.shape), mesh.colors[used])
