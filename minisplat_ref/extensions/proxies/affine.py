"""Affine edits of a part of a scene: x -> A x + b for the Gaussians that a box, a ball or a mesh selects.

A Gaussian under an affine map is a Gaussian, so nothing is approximated in its shape:

    mu' = A mu + b,   Sigma' = A Sigma A^T

(``mechanisms.editing.deformation`` has the factorisation of the covariance into a quaternion and scales, and the
rotation of colours). A Gaussian belongs to a selection if its centre does; one that straddles the border is not cut.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.editing.deformation import Deformation, deform
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.types import Bools, Floats, Gaussians

STRETCH_MIN = 1e-9  # smallest singular value of A over its largest; below this, Gaussians would be numerically flat


class Affine(NamedTuple):
    """The map x -> A x + b."""

    A: Floats
    """[3, 3] float64."""
    b: Floats
    """[3] float64, world units."""


def about_point(linear: Floats, pivot: Floats, translation: Floats) -> Affine:
    """Return the map that applies A about a fixed point p, then translates: ``x -> p + A (x - p) + t``.

    Parameters
    ----------
    linear : ndarray of shape (3, 3)
        A.
    pivot : ndarray of shape (3,)
        p, world frame.
    translation : ndarray of shape (3,)
        t, world units.
    """
    A = np.asarray(linear, np.float64)
    return Affine(A, (pivot - A @ pivot) + translation)


def rotation_about(axis_angle: Sequence[float]) -> Floats:
    """Return the matrix of a rotation vector: its direction is the axis, its length the angle, in degrees.

    Parameters
    ----------
    axis_angle : sequence of 3 floats
        Right-handed; zeros give the identity exactly.
    """
    degrees = np.asarray(axis_angle, np.float64)
    angle = math.radians(float(np.linalg.norm(degrees)))
    axis = degrees / max(float(np.linalg.norm(degrees)), np.finfo(np.float64).tiny)
    return rotation_matrices(np.array([[math.cos(angle / 2), *(math.sin(angle / 2) * axis)]]))[0]


def in_box(means: Floats, low: Floats, high: Floats) -> Bools:
    """Return which centres [N, 3] lie in an axis-aligned box, its faces included: [N] booleans."""
    is_inside: Bools = np.all((means >= low) & (means <= high), axis=1)
    return is_inside


def in_ball(means: Floats, centre: Floats, radius: float) -> Bools:
    """Return which centres [N, 3] lie in a ball, its surface included: [N] booleans."""
    return np.linalg.norm(means - centre, axis=1) <= radius


def edit_gaussians(gaussians: Gaussians, affine: Affine, is_selected: Bools) -> Gaussians:
    """Return the Gaussians with x -> A x + b applied to a selection.

    Parameters
    ----------
    gaussians : Gaussians
        The Gaussians before the edit.
    affine : Affine
        The map; a reflection, with det A < 0, is allowed.
    is_selected : ndarray of shape (N,) of booleans
        The others keep their bytes. Under the identity all keep them; under a translation all fields but the means do.

    Returns
    -------
    Gaussians
        In the dtype of ``gaussians``.

    Raises
    ------
    InputError
        A or b is not finite, or A is singular, so that it would flatten Gaussians.
    """
    A, b = affine
    if not (np.isfinite(A).all() and np.isfinite(b).all()):
        raise InputError("the map A x + b is not finite; give finite numbers")
    stretches = np.linalg.svd(A, compute_uv=False)  # descending
    if not stretches[2] > STRETCH_MIN * stretches[0]:
        raise InputError(
            f"A stretches by {stretches[0]:g}, {stretches[1]:g} and {stretches[2]:g}, which flattens Gaussians;"
            " scale by numbers that are not 0"
        )
    maps = Deformation(np.stack([np.eye(3), A]), is_selected.astype(np.int64))
    means = gaussians.means.astype(np.float64)
    is_identity = np.array_equal(A, np.eye(3)) and not b.any()
    moved = means if is_identity else np.where(is_selected[:, None], means @ A.T + b, means)
    return deform(gaussians, moved, maps)


def check_selected(is_selected: Bools, source: str | Path) -> None:
    """Refuse an empty selection.

    Parameters
    ----------
    is_selected : ndarray of shape (N,) of booleans
        The selection.
    source : str or Path
        The model's file, for the message.

    Raises
    ------
    InputError
        Nothing is selected; the line names the model.
    """
    if not is_selected.any():
        raise InputError(
            f"{source}: none of its {len(is_selected):,} Gaussians is selected; minisplat-ref info shows where they"
            " are: give a larger --box, --sphere or --within"
        )
