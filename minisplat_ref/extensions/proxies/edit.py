"""Affine edits of a part of a scene, and the command ``minisplat-ref proxies edit``.

The map x -> A x + b applies to the Gaussians that a box, a ball or a mesh selects. A Gaussian under an affine map is a
Gaussian, so nothing is approximated in its shape:

    mu' = A mu + b,   Sigma' = A Sigma A^T

(``mechanisms.editing.deformation`` has the factorisation of the covariance into a quaternion and scales, and the
rotation of colours). A Gaussian belongs to a selection if its centre does; one that straddles the border is not cut.
"""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.proxies.binding import nearest_triangles
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.io.ply import save_ply
from minisplat_ref.mechanisms.editing.deformation import Deformation, deform
from minisplat_ref.mechanisms.editing.model_file import load_label, load_model
from minisplat_ref.mechanisms.meshes.mesh import load_mesh
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.types import Bools, Floats, Gaussians

STRETCH_MIN = 1e-9  # smallest singular value of A over its largest; below this, Gaussians would be numerically flat

DESCRIPTION = """\
Apply x -> A x + b to a part of a scene: scale, then rotate, about a fixed
point, then move. Without a selection the whole scene is edited; with several
selections, what is in all of them.
"""
EPILOG = """\
examples:
  minisplat-ref proxies edit runs/fox out.ply --scale 2 --about 0 0 0
  minisplat-ref proxies edit runs/fox out.ply --sphere 0.1 0.4 2 0.5 \\
      --rotate 0 30 0 --translate 0 -0.2 0
  minisplat-ref proxies edit runs/fox out.ply --near head.ply --within 0.1 \\
      --matrix 1 0.3 0 0 1 0 0 0 1"""


class Affine(NamedTuple):
    """The map x -> A x + b."""

    A: Floats
    """[3, 3] float64."""
    b: Floats
    """[3] float64, world units."""


def make_affine(linear: Floats, pivot: Floats, translation: Floats) -> Affine:
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


def make_rotation(axis_angle: Sequence[float]) -> Floats:
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


def are_in_box(means: Floats, low: Floats, high: Floats) -> Bools:
    """Return which centres [N, 3] lie in an axis-aligned box, its faces included: [N] booleans."""
    is_inside: Bools = np.all((means >= low) & (means <= high), axis=1)
    return is_inside


def are_in_ball(means: Floats, centre: Floats, radius: float) -> Bools:
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


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "edit",
        help="scale, rotate and move a part of a scene, exactly",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="PLY of Gaussians, or a run's folder")
    parser.add_argument("out", type=Path, metavar="OUT", help="PLY to write")
    select = parser.add_argument_group("selection")
    _add(select, "--box", 6, "X0 Y0 Z0 X1 Y1 Z1", "select centres between two corners")
    _add(select, "--sphere", 4, "X Y Z R", "select centres in a ball")
    select.add_argument("--near", type=Path, metavar="MESH", help="select centres near the surface of a mesh (PLY)")
    select.add_argument("--within", type=float, metavar="D", help="largest distance for --near, world units")
    change = parser.add_argument_group("change")
    change.add_argument("--scale", type=float, nargs="+", metavar="S", help="scale by one factor, or one for each axis")
    _add(change, "--rotate", 3, "X Y Z", "rotate by axis times angle in degrees, right-handed")
    _add(change, "--translate", 3, "X Y Z", "move by a vector, world units")
    _add(change, "--about", 3, "X Y Z", "fixed point (default: the mean of the selected centres)")
    _add(change, "--matrix", 9, "A11 ... A33", "give A, row by row, in place of --scale and --rotate")
    parser.set_defaults(run=run)


def _add(group: Any, name: str, n: int, metavar: str, text: str) -> None:
    """Add an option of n numbers; negative ones need no equals sign, because they are separate arguments."""
    names = tuple(metavar.split()) if len(metavar.split()) == n else ("A11", *("...",) * (n - 2), "A33")
    group.add_argument(name, type=float, nargs=n, metavar=names, help=text)


def run(args: argparse.Namespace) -> int:
    """Read the Gaussians, edit the selected ones, and write all."""
    linear = _read_matrix(args)
    gaussians = load_model(args.model)
    means = gaussians.means.astype(np.float64)
    is_selected = _select(args, means)
    check_selected(is_selected, args.model)
    pivot = means[is_selected].mean(axis=0) if args.about is None else np.array(args.about)
    affine: Affine = make_affine(linear, pivot, np.array(args.translate or (0.0, 0.0, 0.0)))
    save_ply(args.out, edit_gaussians(gaussians, affine, is_selected), load_label(args.model))
    print(f"{is_selected.sum():,} of {len(means):,} Gaussians edited, in {args.out}")
    return 0


def _read_matrix(args: argparse.Namespace) -> Floats:
    """Return the matrix A [3, 3] that the arguments describe."""
    if args.matrix is not None:
        if args.scale is not None or args.rotate is not None:
            raise InputError("--matrix takes the place of --scale and --rotate: leave them out")
        return np.array(args.matrix).reshape(3, 3)
    scale = args.scale or [1.0]
    if len(scale) not in (1, 3):
        raise InputError(f"--scale has {len(scale)} numbers: give one factor, or three, one for each axis")
    return make_rotation(args.rotate or (0.0, 0.0, 0.0)) * np.broadcast_to(scale, 3)


def _select(args: argparse.Namespace, means: Floats) -> Bools:
    """Return which Gaussians [N] are in all selections."""
    if (args.near is None) != (args.within is None):
        raise InputError("--near MESH and --within D belong together: give both, or neither")
    is_selected = np.ones(len(means), bool)
    if args.box is not None:
        is_selected &= are_in_box(means, np.array(args.box[:3]), np.array(args.box[3:]))
    if args.sphere is not None:
        is_selected &= are_in_ball(means, np.array(args.sphere[:3]), args.sphere[3])
    if args.near is not None:

        def bar(parts: Any) -> Any:
            return with_progress(parts, "nearest triangles", "parts")

        is_selected &= nearest_triangles(means, load_mesh(args.near), bar).distances <= args.within
    return is_selected
