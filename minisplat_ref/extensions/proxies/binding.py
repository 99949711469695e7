"""Gaussians bound to the triangles of a mesh: the mesh is deformed, and they follow.

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
"""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.proxies.nearest import nearest_triangles
from minisplat_ref.mechanisms.editing.deformation import Deformation, deform
from minisplat_ref.mechanisms.meshes.mesh import Mesh, frames
from minisplat_ref.types import Floats, Gaussians, Ints

UNBOUND = -1


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
        As for :func:`~minisplat_ref.extensions.proxies.nearest.nearest_triangles`.
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
