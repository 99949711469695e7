"""Gaussians bound to the triangles of a mesh, which follow when it is deformed; ``minisplat-ref proxies follow``.

After GaMeS (Waczynska et al. 2024, arXiv 2402.01459), which puts Gaussians onto the faces of a mesh by barycentric
coordinates and derives rotation and scales from the corners, so that whatever moves the mesh moves the scene. Each
Gaussian is bound to the nearest triangle. In the frame E of that triangle (``mechanisms.meshes.mesh``) it has place and
axes

    (b1, b2, w) = E^-1 (mu - p0)      barycentric coordinates (1 - b1 - b2, b1, b2), signed offset w along the normal
    L = E^-1 R diag(s)                its rotation and scales

which it keeps when the mesh has moved, with the corners p' and the frame E':

    mu' = p0' + E' (b1, b2, w)
    Sigma' = E' L (E' L)^T = F Sigma F^T,   F = E' E^-1

F is the deformation gradient of the triangle, with stretch and shear. It is the same for all Gaussians of a triangle,
so the code computes F and not L. The covariance is refactored by singular values, and colours rotate with F's rotation
(``mechanisms.editing.deformation``).

Two things are exact. When the mesh is translated, rotated and scaled, so are the Gaussians; and an affine map within
the plane of a triangle acts exactly on them. Triangles whose corners have not moved leave their Gaussians as they are,
to the byte. The rest is approximate: a bent surface becomes flat pieces, and a Gaussian that crosses a side of its
triangle follows only the one that it is bound to. Corners do not determine a stretch across their plane; in that
direction a Gaussian grows as h does, with the square root of the area. Beyond the border of the mesh and far from its
surface the map of the nearest triangle is extrapolated, which magnifies its rotation; ``reach`` leaves Gaussians alone
that are farther away. Inside a hull around a solid object, Gaussians on either side of the middle belong to opposite
faces, and are torn apart when these rotate differently; a sheet, or a mesh close to the surface, serves better.

This deviates from GaMeS in two ways. Gaussians are bound as they are, so they may lie off the surface and have any
shape; the extension ``games`` trains them on the faces. And in GaMeS the scales of a flat Gaussian are two lengths of a
Gram-Schmidt frame of the triangle, which ignores shear.

The distance of x from a triangle is that from its plane, if the projection of x lies inside, and otherwise the least of
those from its three sides. Comparing every point with every triangle takes long; so a k-d tree of the triangles'
centres proposes the k nearest ones. A triangle extends no farther from its centre than r, the largest such distance in
the mesh, so if the best of the k lies nearer than the k-th centre less r, no other can be better. The points for which
this does not hold are searched again with more candidates.
"""

import argparse
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from minisplat_ref.errors import InputError
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.io.ply import save_ply
from minisplat_ref.mechanisms.editing.deformation import Deformation, deform
from minisplat_ref.mechanisms.editing.model_file import load_label, load_model
from minisplat_ref.mechanisms.meshes.mesh import Mesh, check_same_faces, frames, load_mesh
from minisplat_ref.types import Floats, Gaussians, Ints

FIRST_CANDIDATES = 8
PAIRS_AT_ONCE = 1 << 18  # of points and triangles; a dozen arrays of 3 float64 each, so 75 MB
UNBOUND = -1

DESCRIPTION = """\
Bind the Gaussians of a model to a mesh, and write them deformed as the mesh was
deformed: in a modelling program, or by a script that moves its vertices. Both
meshes must have the same faces.
"""
EPILOG = """\
example:
  minisplat-ref proxies follow runs/fox rest.ply deformed.ply fox-deformed.ply"""


class Nearest(NamedTuple):
    """The nearest triangle of each point."""

    faces: Ints
    """[N] rows of the mesh's faces; of several that are equally near, the first."""
    distances: Floats
    """[N] world units."""


def triangle_distances(points: Floats, corners: Floats) -> Floats:
    """Return the distances of points from triangles.

    With the sides ``s_k = p_{k+1} - p_k`` and the normal n of a triangle, the projection of x lies inside where
    ``n . (s_k x (x - p_k)) >= 0`` for all k; the nearest point of a side is ``p_k + clip(t, 0, 1) s_k`` with
    ``t = s_k . (x - p_k) / s_k^2``.

    Parameters
    ----------
    points : ndarray of shape (..., 3)
        World frame.
    corners : ndarray of shape (..., 3, 3)
        World frame: triangle, corner, axis. Every triangle has an area.

    Returns
    -------
    ndarray of shape (...,)
        World units.
    """
    sides = np.roll(corners, -1, axis=-2) - corners  # [..., 3, 3]
    to_point = points[..., None, :] - corners  # [..., 3, 3]
    n = np.cross(sides[..., 0, :], sides[..., 1, :])
    n = n / np.linalg.norm(n, axis=-1, keepdims=True)  # [..., 3]
    is_inside = (np.einsum("...i,...ki->...k", n, np.cross(sides, to_point)) >= 0).all(axis=-1)
    t = np.clip(np.sum(sides * to_point, axis=-1) / np.sum(sides * sides, axis=-1), 0, 1)  # [..., 3]
    from_sides = np.linalg.norm(to_point - t[..., None] * sides, axis=-1).min(axis=-1)
    from_plane = np.abs(np.sum(n * to_point[..., 0, :], axis=-1))
    return np.where(is_inside, from_plane, from_sides)


def nearest_triangles(
    points: Floats, mesh: Mesh, progress: Callable[[Iterable[Ints]], Iterable[Ints]] = iter
) -> Nearest:
    """Return the nearest triangle of each point.

    Parameters
    ----------
    points : ndarray of shape (N, 3)
        World frame.
    mesh : Mesh
        It has at least one triangle, and every triangle has an area.
    progress : callable
        Wraps the batches in which points are searched, as :func:`~minisplat_ref.interface.progress.with_progress`.
    """
    points = points.astype(np.float64)
    centres = mesh.corners.mean(axis=1)  # [T, 3]
    reach = np.linalg.norm(mesh.corners - centres[:, None], axis=2).max()  # r
    tree = cKDTree(centres)
    faces, distances = np.zeros(len(points), np.int64), np.zeros(len(points))
    parts = np.array_split(np.arange(len(points)), max(1, len(points) * FIRST_CANDIDATES // PAIRS_AT_ONCE))
    for part in progress(parts):
        rows, k = part, min(FIRST_CANDIDATES, len(centres))
        while len(rows):
            n_at_once = max(1, PAIRS_AT_ONCE // k)
            is_settled = []
            for some in np.array_split(rows, -(-len(rows) // n_at_once)):
                to_centres, candidates = tree.query(points[some], k=np.arange(1, k + 1))  # [N', k], nearest first
                order = np.argsort(candidates, axis=1)  # the first face of equally near ones
                candidates = np.take_along_axis(candidates, order, axis=1)
                found = triangle_distances(points[some, None], mesh.corners[candidates])  # [N', k]
                best = found.argmin(axis=1)[:, None]  # [N', 1]
                faces[some] = np.take_along_axis(candidates, best, axis=1)[:, 0]
                distances[some] = np.take_along_axis(found, best, axis=1)[:, 0]
                is_settled.append(distances[some] < to_centres[:, -1] - reach)
            rows = rows[~np.concatenate(is_settled)] if k < len(centres) else rows[:0]
            k = min(4 * k, len(centres))
    return Nearest(faces, distances)


class Binding(NamedTuple):
    """Gaussians, and the coordinates of each in the frame of its triangle."""

    gaussians: Gaussians
    """N Gaussians, as they are while the mesh is at rest."""
    mesh: Mesh
    """The mesh at rest."""
    faces: Ints
    """[N] triangle of each Gaussian, or ``UNBOUND``."""
    barycentric: Floats
    """[N, 3] of the projection onto the plane of the triangle; sums to 1, not clipped to the triangle."""
    offsets: Floats
    """[N] signed distance from that plane over h; positive on the side of the normal."""

    @property
    def n_bound(self) -> int:
        """Number of Gaussians that follow the mesh."""
        return int(np.count_nonzero(self.faces != UNBOUND))


def bind(
    gaussians: Gaussians,
    mesh: Mesh,
    reach: float = np.inf,
    progress: Callable[[Iterable[Ints]], Iterable[Ints]] = iter,
) -> Binding:
    """Bind Gaussians to the nearest triangles of a mesh at rest.

    ::

        (b1, b2, w) = E^-1 (mu - p0)

    Parameters
    ----------
    gaussians : Gaussians
        N Gaussians.
    mesh : Mesh
        The mesh at rest, in the world frame of the Gaussians; every triangle has an area.
    reach : float
        Gaussians whose centre is farther than this from the surface, world units, are not bound and stay.
    progress : callable
        As for :func:`~minisplat_ref.extensions.proxies.binding.nearest_triangles`.
    """
    means = gaussians.means.astype(np.float64)
    nearest = nearest_triangles(means, mesh, progress)
    from_p0 = means - mesh.corners[nearest.faces, 0]  # [N, 3]
    b1, b2, w = np.einsum("nij,nj->in", np.linalg.inv(frames(mesh))[nearest.faces], from_p0)
    return Binding(
        gaussians,
        mesh,
        np.where(nearest.distances <= reach, nearest.faces, UNBOUND),
        np.stack([1 - b1 - b2, b1, b2], axis=1),
        w,
    )


def rebuild(deformed_mesh: Mesh, binding: Binding) -> Gaussians:
    """Return the Gaussians as the deformed mesh carries them.

    ::

        mu' = b0 p0' + b1 p1' + b2 p2' + w h' n',   Sigma' = F Sigma F^T,   F = E' E^-1

    Parameters
    ----------
    deformed_mesh : Mesh
        It has the faces of the mesh at rest, and every triangle has an area.
    binding : Binding
        From :func:`bind`.

    Returns
    -------
    Gaussians
        N rows in the dtype and order of the bound ones. Those of triangles that have not moved, and those that are not
        bound, keep their bytes.
    """
    rest, gaussians = binding.mesh, binding.gaussians
    E_rest, E = frames(rest), frames(deformed_mesh)  # [T, 3, 3]
    is_still = (deformed_mesh.corners == rest.corners).all(axis=(1, 2))  # [T]
    F = np.where(is_still[:, None, None], np.eye(3), E @ np.linalg.inv(E_rest))
    F = np.concatenate([F, np.eye(3)[None]])  # the last, row -1, is that of Gaussians that are not bound
    faces = binding.faces
    is_carried = (faces != UNBOUND) & ~is_still[faces]  # [N]
    carried = (
        np.einsum("nk,nki->ni", binding.barycentric, deformed_mesh.corners[faces])
        + binding.offsets[:, None] * E[faces, :, 2]
    )  # [N, 3]
    means = np.where(is_carried[:, None], carried, gaussians.means.astype(np.float64))
    return deform(gaussians, means, Deformation(F, faces))


def check_bound(binding: Binding, reach: float, source: str | Path) -> None:
    """Refuse a binding that binds no Gaussian.

    Parameters
    ----------
    binding : Binding
        From :func:`bind`.
    reach : float
        World units, for the message.
    source : str or Path
        The model's file, for the message.

    Raises
    ------
    InputError
        Nothing is bound; the line names model and reach.
    """
    if binding.n_bound == 0:
        raise InputError(
            f"{source}: none of its {len(binding.faces):,} Gaussians is within {reach:g} of the mesh; give a larger"
            " --reach, or a mesh in the frame of the model"
        )


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "follow",
        help="deform a scene as a mesh was deformed",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="PLY of Gaussians, or a run's folder")
    parser.add_argument("rest", type=Path, metavar="REST", help="PLY of the mesh that fits the model")
    parser.add_argument("deformed", type=Path, metavar="DEFORMED", help="PLY of the same mesh with moved vertices")
    parser.add_argument("out", type=Path, metavar="OUT", help="PLY to write")
    add_reach(parser)
    parser.set_defaults(run=run)


def add_reach(parser: argparse.ArgumentParser) -> None:
    """Add ``--reach``."""
    parser.add_argument(
        "--reach",
        type=float,
        default=float("inf"),
        metavar="D",
        help="bind only what is nearer to the mesh than D, world units (default: all)",
    )


def run(args: argparse.Namespace) -> int:
    """Bind the Gaussians, rebuild them on the deformed mesh, and write them."""
    gaussians, rest, deformed = load_model(args.model), load_mesh(args.rest), load_mesh(args.deformed)
    check_same_faces(rest, deformed, args.deformed)
    bar = partial(with_progress, description="nearest triangles", unit="parts")
    binding = bind(gaussians, rest, args.reach, bar)
    check_bound(binding, args.reach, args.model)
    save_ply(args.out, rebuild(deformed, binding), load_label(args.model))
    print(f"{binding.n_bound:,} of {len(gaussians.means):,} Gaussians follow the mesh, in {args.out}")
    return 0
