"""The command ``minisplat-ref polygons edit``: Gaussians that follow their edited polygons."""

import argparse
from pathlib import Path
from typing import Any

from minisplat_ref.extensions.polygons.soup import carry_gaussians, load_corners, soup_of
from minisplat_ref.io.ply import save_ply
from minisplat_ref.mechanisms.editing.model_file import load_label, load_model

EPILOG = """\
example: move vertices of soup.ply in a mesh tool, then
  minisplat-ref polygons edit runs/fox soup.ply --out edited.ply
  minisplat-ref render edited.ply --cameras orbit"""


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "edit",
        help="carry an edit of a model's polygons back to its Gaussians",
        description="Apply an edit of exported polygons to the Gaussians of the model.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="that was exported: PLY, or a run's folder")
    parser.add_argument("soup", type=Path, metavar="SOUP", help="PLY of its polygons, with vertices moved")
    parser.add_argument("--out", type=Path, required=True, metavar="PLY", help="of Gaussians, to write")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Read, fit, write."""
    gaussians = load_model(args.model)
    n_polygons = len(soup_of(gaussians, 3).rows)
    corners = load_corners(args.soup, n_polygons)
    edited, n_edited = carry_gaussians(gaussians, soup_of(gaussians, corners.shape[1]), corners, args.soup)
    save_ply(args.out, edited, load_label(args.model))
    print(f"{n_edited:,} of {len(gaussians.means):,} Gaussians follow their polygons, in {args.out}")
    return 0
