"""Coarse meshes to bind a scene to: a sheet through its Gaussians, or their convex hull; ``proxies cage``."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.editing.model_file import load_model
from minisplat_ref.mechanisms.meshes.mesh import Mesh, check_mesh, save_mesh
from minisplat_ref.types import Floats

MIDDLE_FRACTION = 0.98  # of the Gaussians along each axis; the rest are floaters, which would inflate the mesh


def grid(origin: Floats, right: Floats, up: Floats, n_cells: tuple[int, int]) -> Mesh:
    """Return a flat parallelogram of cells, each cut into two triangles along a diagonal.

    Parameters
    ----------
    origin : ndarray of shape (3,)
        The corner where both sides begin, world frame.
    right, up : ndarray of shape (3,)
        The sides, world units.
    n_cells : tuple of 2 ints
        Cells along ``right`` and ``up``; vertex (i, j) is row ``j (n + 1) + i``. Normals point along ``right x up``.
    """
    n, m = n_cells
    j, i = np.mgrid[: m + 1, : n + 1]
    vertices = origin + (i / n)[..., None] * right + (j / m)[..., None] * up  # [m + 1, n + 1, 3]
    a = (np.arange(m)[:, None] * (n + 1) + np.arange(n)).ravel()  # lower left corner of each cell
    b, c, d = a + 1, a + n + 2, a + n + 1
    faces = np.stack([np.column_stack([a, b, c]), np.column_stack([a, c, d])], axis=1)
    return Mesh(vertices.reshape(-1, 3), faces.reshape(-1, 3))


def sheet_through(means: Floats, n_cells: int) -> Mesh:
    """Return a flat rectangular sheet through points, in the plane in which they spread most.

    The two largest principal axes of the middle 98 % of the points along each coordinate span the plane and give the
    directions of the borders; cells are about square.

    Parameters
    ----------
    means : ndarray of shape (N, 3)
        Points, world frame.
    n_cells : int
        Cells along the longer side.

    Raises
    ------
    InputError
        There are fewer than three points, or they lie on one line.
    """
    points = _middle(means)
    centre = points.mean(axis=0)
    axes = np.linalg.svd(points - centre, full_matrices=False)[2][:2]  # [2, 3]
    along = (points - centre) @ axes.T  # [N, 2]
    low, high = np.quantile(along, [(1 - MIDDLE_FRACTION) / 2, (1 + MIDDLE_FRACTION) / 2], axis=0)
    sides = high - low
    n_across = max(1, round(n_cells * float(sides[1] / sides[0]))) if sides[0] > 0 else 1
    mesh = grid(centre + low @ axes, sides[0] * axes[0], sides[1] * axes[1], (n_cells, n_across))
    check_mesh(mesh, "the sheet through the Gaussians")
    return mesh


def convex_hull(means: Floats) -> Mesh:
    """Return the convex hull of the middle 98 % of points [N, 3] along each coordinate; normals point outwards.

    Raises
    ------
    InputError
        There are fewer than four points, or they lie in one plane.
    """
    points = _middle(means)
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        raise InputError(
            f"{len(points)} Gaussians have no convex hull, since they lie in one plane: give --cells N for a sheet"
        ) from None
    corners = points[hull.simplices]  # [T, 3, 3]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    is_inward = np.sum(normals * hull.equations[:, :3], axis=1) < 0
    simplices = np.where(is_inward[:, None], hull.simplices[:, ::-1], hull.simplices)
    used, faces = np.unique(simplices, return_inverse=True)
    mesh = Mesh(points[used], faces.reshape(-1, 3))
    check_mesh(mesh, "the convex hull of the Gaussians")
    return mesh


def _middle(means: Floats) -> Floats:
    """Return the points that are in the middle 98 % along each coordinate."""
    means = means.astype(np.float64)
    if len(means) < 3:
        raise InputError(f"{len(means)} Gaussians are too few for a mesh: give a larger model")
    low, high = np.quantile(means, [(1 - MIDDLE_FRACTION) / 2, (1 + MIDDLE_FRACTION) / 2], axis=0)
    return means[((means >= low) & (means <= high)).all(axis=1)]


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "cage",
        help="make a coarse mesh around a model's Gaussians to bind them to",
        epilog="example: minisplat-ref proxies cage runs/fox/point_cloud.ply cage.ply --hull",
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="PLY of Gaussians")
    parser.add_argument("out", type=Path, metavar="MESH", help="PLY of a mesh to write")
    kind = parser.add_mutually_exclusive_group(required=True)
    kind.add_argument("--hull", action="store_true", help="make the convex hull of the middle 98 %% of them")
    kind.add_argument("--cells", type=int, metavar="N", help="make a flat sheet through them, N cells long")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Write the mesh."""
    if args.cells is not None and args.cells < 1:
        raise InputError(f"--cells is {args.cells}: give at least 1")
    means = load_model(args.model).means
    mesh = convex_hull(means) if args.hull else sheet_through(means, args.cells)
    save_mesh(args.out, mesh)
    print(f"a mesh of {len(mesh.vertices):,} vertices and {len(mesh.faces):,} triangles in {args.out}")
    return 0
