"""The command ``minisplat-ref velocity freeze``, which writes the scene at one time as a PLY for any viewer."""

import argparse
from pathlib import Path
from typing import Any

from minisplat_ref.extensions.velocity.model import MovingGaussians, freeze_gaussians
from minisplat_ref.io.ply import load_ply, save_ply


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "freeze",
        help="write the scene at one time, for viewers without motion",
        epilog="example: minisplat-ref velocity freeze runs/moving/point_cloud.ply --time 0.5 --out still.ply",
    )
    parser.add_argument("ply", type=Path, metavar="PLY", help="point_cloud.ply of a run of recipe velocity")
    parser.add_argument("--time", type=float, default=0.0, metavar="T", help="time of the scene (default 0)")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="PLY to write")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Move the Gaussians to where they are at that time, and write them without velocities."""
    still = freeze_gaussians(load_ply(args.ply, MovingGaussians), args.time)
    save_ply(args.out, still)
    print(f"{len(still.means):,} Gaussians at time {args.time:g} in {args.out}")
    return 0
