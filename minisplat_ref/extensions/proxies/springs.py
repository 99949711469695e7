"""The springs of a triangle mesh, and the masses of its vertices, as a model of a sheet of cloth.

A sheet of masses and springs (Provot 1995) has springs of three kinds, which here follow from the triangles:

- *structural*: along every edge;
- *shear*: between the two corners opposite an edge that is the longest side of both its triangles. Two such triangles
  are a quadrilateral cut along a diagonal, and this is the other diagonal;
- *bend*: between the corners opposite any other inner edge. Folding the sheet along the edge brings them closer.

A mass is the density times a third of the area of the triangles around a vertex.
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from minisplat_ref.mechanisms.meshes.mesh import Mesh
from minisplat_ref.types import Floats, Ints

LONGEST_RATIO = 1 - 1e-9  # rounding: a side of at least this part of the longest one counts as the longest


class Stiffness(NamedTuple):
    """Spring constants of the three kinds, force per length; 0 omits a kind."""

    structural: float
    shear: float
    bend: float


class Springs(NamedTuple):
    """Springs between vertices."""

    incidence: csr_array
    """[S, P] sparse; row s has 1 at one end of spring s and -1 at the other, so ``incidence @ x`` is ``x_a - x_b``."""
    rest_lengths: Floats
    """[S] world units."""
    stiffness: Floats
    """[S] force per length."""


def springs_between(ends: Ints, vertices: Floats, stiffness: Floats) -> Springs:
    """Return springs that are at rest where the vertices are.

    Parameters
    ----------
    ends : ndarray of shape (S, 2)
        Rows of the vertices that each spring connects.
    vertices : ndarray of shape (P, 3)
        World frame.
    stiffness : ndarray of shape (S,)
        Force per length.
    """
    n = len(ends)
    signs = np.tile([1.0, -1.0], n)
    incidence = csr_array((signs, (np.repeat(np.arange(n), 2), ends.ravel())), shape=(n, len(vertices)))
    lengths = np.linalg.norm(incidence @ vertices, axis=1)  # [S]
    return Springs(incidence, lengths, np.asarray(stiffness, np.float64))


def springs_of(mesh: Mesh, stiffness: Stiffness) -> Springs:
    """Return the structural, shear and bend springs of a mesh that is at rest.

    Parameters
    ----------
    mesh : Mesh
        At rest.
    stiffness : Stiffness
        Constants of the three kinds, force per length.
    """
    edges, shear, bend = find_springs(mesh)
    kinds = [(ends, k) for ends, k in zip((edges, shear, bend), stiffness, strict=True) if k > 0]
    ends = np.concatenate([ends for ends, _ in kinds])
    return springs_between(ends, mesh.vertices, np.repeat([k for _, k in kinds], [len(ends) for ends, _ in kinds]))


def find_springs(mesh: Mesh) -> tuple[Ints, Ints, Ints]:
    """Return the vertices [S, 2] that structural, shear and bend springs connect.

    Of an edge that more than two triangles share, only the first two have a shear or bend spring.
    """
    sides = np.concatenate([mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]], mesh.faces[:, [0, 1]]])  # [3 T, 2]
    opposite = mesh.faces.T.ravel()  # [3 T] the corner that a side lies opposite to
    corners = mesh.corners
    lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - np.roll(corners, -2, axis=1), axis=2)  # [T, 3] opposite k
    is_longest = (lengths >= LONGEST_RATIO * lengths.max(axis=1, keepdims=True)).T.ravel()  # [3 T]

    edges, edge_of = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True)
    order = np.argsort(edge_of.ravel(), kind="stable")  # sides grouped by their edge
    starts = np.searchsorted(edge_of.ravel()[order], np.arange(len(edges)))
    is_inner = np.bincount(edge_of.ravel(), minlength=len(edges)) > 1
    first, second = order[starts[is_inner]], order[starts[is_inner] + 1]
    across = np.column_stack([opposite[first], opposite[second]])  # [inner edges, 2]
    is_diagonal = is_longest[first] & is_longest[second]
    is_other = across[:, 0] != across[:, 1]  # not two copies of one triangle
    return edges, across[is_diagonal & is_other], across[~is_diagonal & is_other]


def vertex_masses(mesh: Mesh, density: float) -> Floats:
    """Return the masses [P] of the vertices, which get a third of the mass of each of their triangles.

    A vertex without a triangle gets the mean mass; it falls, but no Gaussian is bound to it.

    Parameters
    ----------
    mesh : Mesh
        At rest.
    density : float
        Mass per area.
    """
    corners = mesh.corners
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2  # [T]
    masses = density / 3 * np.bincount(mesh.faces.ravel(), np.repeat(areas, 3), minlength=len(mesh.vertices))
    return np.where(masses > 0, masses, masses.mean())


def stiffness_for_stretch(mesh: Mesh, weight: float, stretch: float) -> Stiffness:
    """Return spring constants with which a square sheet that hangs from one side stretches by about a given fraction.

    In a column of n springs of constant k and length e, each spring carries the weights w below it, so the column
    stretches by ``w n^2 / 2 k``, which over its length n e is ``n w / 2 k e``. So

        k = L w / (2 e^2 f),   L the mesh's longest extent, e its mean edge, f the fraction.

    Shear springs are as stiff as structural ones, bend springs a hundredth of that, since cloth folds easily.

    Parameters
    ----------
    mesh : Mesh
        At rest.
    weight : float
        Weight of the whole sheet, mass times gravity.
    stretch : float
        f, above 0.
    """
    edges, _, _ = find_springs(mesh)
    e = np.linalg.norm(mesh.vertices[edges[:, 0]] - mesh.vertices[edges[:, 1]], axis=1).mean()
    extent = np.ptp(mesh.vertices, axis=0).max()
    k = float(extent * weight / len(mesh.vertices) / (2 * e * e * stretch))
    return Stiffness(k, k, k / 100)
