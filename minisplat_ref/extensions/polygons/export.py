"""The command ``minisplat-ref polygons export``: the polygons of a model as a file for mesh tools."""

import argparse
from pathlib import Path
from typing import Any

from minisplat_ref.extensions.polygons.soup import save_soup
from minisplat_ref.mechanisms.editing.model_file import load_model
from minisplat_ref.mechanisms.meshes.fans import N_SIDES


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "export",
        help="write a model's Gaussians as flat polygons, to edit them with a mesh tool",
        epilog="example: minisplat-ref polygons export runs/fox --out soup.ply",
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="PLY of Gaussians, or a run's folder")
    parser.add_argument("--out", type=Path, required=True, metavar="SOUP", help="PLY of polygons to write")
    parser.add_argument("--sides", type=int, default=N_SIDES, metavar="N", help=f"of a polygon (default {N_SIDES})")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Read and write."""
    gaussians = load_model(args.model)
    soup = save_soup(args.out, gaussians, args.sides)
    left_out = len(gaussians.means) - len(soup.rows)
    print(
        f"{len(soup.rows):,} polygons of {args.sides} corners in {args.out}"
        + (f"; {left_out:,} Gaussians are too faint to have one" if left_out else "")
    )
    return 0
