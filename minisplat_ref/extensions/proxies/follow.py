"""The command ``minisplat-ref proxies follow``, which makes a scene follow a mesh that was deformed elsewhere."""

import argparse
from functools import partial
from pathlib import Path
from typing import Any

from minisplat_ref.extensions.proxies.binding import bind, check_bound, rebuild
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.io.ply import save_ply
from minisplat_ref.mechanisms.editing.model_file import load_label, load_model
from minisplat_ref.mechanisms.meshes.mesh import check_same_faces, load_mesh

DESCRIPTION = """\
Bind the Gaussians of a model to a mesh, and write them deformed as the mesh was
deformed: in a modelling program, or by a script that moves its vertices. Both
meshes must have the same faces.
"""
EPILOG = """\
example:
  minisplat-ref proxies follow runs/fox rest.ply deformed.ply fox-deformed.ply"""


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
    """Bind, rebuild, write."""
    gaussians, rest, deformed = load_model(args.model), load_mesh(args.rest), load_mesh(args.deformed)
    check_same_faces(rest, deformed, args.deformed)
    bar = partial(with_progress, description="nearest triangles", unit="parts")
    binding = bind(gaussians, rest, args.reach, bar)
    check_bound(binding, args.reach, args.model)
    save_ply(args.out, rebuild(deformed, binding), load_label(args.model))
    print(f"{binding.n_bound:,} of {len(gaussians.means):,} Gaussians follow the mesh, in {args.out}")
    return 0
