"""Axes of a file of Gaussians, and Gaussians in other axes.

Three letters name where x, y and z of a file point as seen from a camera: R or L, U or D, F or B (right, left, up,
down, forward, backward). A PLY of 3DGS, and this program, have RDF. The names and their order are those of the record
``SPZ_ADOBE_coordinate_system`` that an SPZ may have, whose number is the place in :data:`AXES`, from 1.

Axes A, whose columns are those of the file in RDF, change a centre to ``A x``, a covariance to ``A Sigma A^T`` and a
colour to that of the direction ``A^T d``. A is a permutation with signs, so that scales are exchanged, and a rotation
(w, v) becomes ``(w, det(A) A v)``. Left-handed axes mirror what a file holds, as its other readers do.
"""

from functools import cache

import numpy as np

from minisplat_ref.constants import SH_DEGREE_MAX
from minisplat_ref.errors import InputError
from minisplat_ref.reference.spherical_harmonics import sh_basis
from minisplat_ref.types import Floats, Gaussians

OURS = "RDF"
AXES = tuple(f"{x}{y}{z}" for z in "BF" for y in "DU" for x in "LR") + tuple(
    f"{x}{y}{z}" for y in "FB" for z in "DU" for x in "LR"
)
WORDS = {"R": "right", "L": "left", "U": "up", "D": "down", "F": "forward", "B": "backward"}
_COLUMNS = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}
N_DIRECTIONS = 64  # at which harmonics are compared; more than they have coefficients


def check_axes(name: str) -> str:
    """Return the name of axes in upper case.

    Raises
    ------
    InputError
        There are no such axes.
    """
    if name.upper() not in AXES:
        raise InputError(f"axes {name!r} do not exist: choose from {', '.join(AXES)}")
    return name.upper()


def describe_axes(name: str) -> str:
    """Return the name of axes with what it means."""
    return f"{name} ({', '.join(f'{axis} {WORDS[letter]}' for axis, letter in zip('xyz', name, strict=True))})"


def ours_from(name: str) -> Floats:
    """Return the matrix A [3, 3] that changes coordinates of a file to RDF; its transpose changes them back."""
    return np.array([_COLUMNS[letter] for letter in name], np.float64).T


def turn(gaussians: Gaussians, A: Floats) -> Gaussians:
    """Return Gaussians in other axes, in the precision that they have.

    Parameters
    ----------
    gaussians : Gaussians
    A : ndarray of shape (3, 3)
        A permutation with signs.
    """
    if np.array_equal(A, np.eye(3)):
        return gaussians
    order, signs = np.argmax(np.abs(A), axis=1), A.sum(axis=1)  # coordinate i becomes signs[i] x[order[i]]
    quats, signs_of_rotation = gaussians.quats.copy(), np.linalg.det(A).round() * signs
    quats[:, 1:] = gaussians.quats[:, 1:][:, order] * signs_of_rotation.astype(quats.dtype)
    return gaussians._replace(
        means=gaussians.means[:, order] * signs.astype(gaussians.means.dtype),
        quats=quats,
        log_scales=gaussians.log_scales[:, order],
        sh_rest=_turn_harmonics(gaussians.sh_rest, A),
    )


def _turn_harmonics(sh_rest: Floats, A: Floats) -> Floats:
    """Return the coefficients [N, K-1, 3] of colours that are turned by A."""
    M = _harmonics_matrix(tuple(map(tuple, A.tolist())))[: sh_rest.shape[1], : sh_rest.shape[1]].astype(sh_rest.dtype)
    if np.array_equal(M, np.diag(np.diag(M))):  # signs alone, which need no second array of products
        return sh_rest * np.diag(M)[:, None]
    return np.einsum("ij,njc->nic", M, sh_rest)


@cache
def _harmonics_matrix(A: tuple[tuple[float, ...], ...]) -> Floats:
    """Return M with ``sum_j M_ij c_j`` the coefficient i of degree 1 to 3 of ``d -> c(A^T d)``."""
    d = np.random.default_rng(0).normal(size=(N_DIRECTIONS, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    turned, _, _, _ = np.linalg.lstsq(sh_basis(d, SH_DEGREE_MAX), sh_basis(d @ np.array(A), SH_DEGREE_MAX), rcond=None)
    return np.round(turned[1:, 1:], 12)  # exactly 0 and 1 where these are meant
