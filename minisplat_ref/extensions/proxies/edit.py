"""The command ``minisplat-ref proxies edit``, which scales, rotates and moves a part of a scene."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.proxies.affine import (
    Affine,
    about_point,
    check_selected,
    edit_gaussians,
    in_ball,
    in_box,
    rotation_about,
)
from minisplat_ref.extensions.proxies.nearest import nearest_triangles
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.io.ply import save_ply
from minisplat_ref.mechanisms.editing.model_file import load_label, load_model
from minisplat_ref.mechanisms.meshes.mesh import load_mesh
from minisplat_ref.types import Bools, Floats

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
    """Read, edit, write."""
    linear = _linear(args)
    gaussians = load_model(args.model)
    means = gaussians.means.astype(np.float64)
    is_selected = _select(args, means)
    check_selected(is_selected, args.model)
    pivot = means[is_selected].mean(axis=0) if args.about is None else np.array(args.about)
    affine: Affine = about_point(linear, pivot, np.array(args.translate or (0.0, 0.0, 0.0)))
    save_ply(args.out, edit_gaussians(gaussians, affine, is_selected), load_label(args.model))
    print(f"{is_selected.sum():,} of {len(means):,} Gaussians edited, in {args.out}")
    return 0


def _linear(args: argparse.Namespace) -> Floats:
    """Return the matrix A [3, 3] that the arguments describe."""
    if args.matrix is not None:
        if args.scale is not None or args.rotate is not None:
            raise InputError("--matrix takes the place of --scale and --rotate: leave them out")
        return np.array(args.matrix).reshape(3, 3)
    scale = args.scale or [1.0]
    if len(scale) not in (1, 3):
        raise InputError(f"--scale has {len(scale)} numbers: give one factor, or three, one for each axis")
    return rotation_about(args.rotate or (0.0, 0.0, 0.0)) * np.broadcast_to(scale, 3)


def _select(args: argparse.Namespace, means: Floats) -> Bools:
    """Return which Gaussians [N] are in all selections."""
    if (args.near is None) != (args.within is None):
        raise InputError("--near MESH and --within D belong together: give both, or neither")
    is_selected = np.ones(len(means), bool)
    if args.box is not None:
        is_selected &= in_box(means, np.array(args.box[:3]), np.array(args.box[3:]))
    if args.sphere is not None:
        is_selected &= in_ball(means, np.array(args.sphere[:3]), args.sphere[3])
    if args.near is not None:

        def bar(parts: Any) -> Any:
            return with_progress(parts, "nearest triangles", "parts")

        is_selected &= nearest_triangles(means, load_mesh(args.near), bar).distances <= args.within
    return is_selected
