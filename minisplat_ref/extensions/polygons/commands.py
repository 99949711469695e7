"""The commands ``polygons export`` and ``polygons edit``: polygons as a file, and Gaussians that follow them."""

import argparse
from pathlib import Path
from typing import Any

from minisplat_ref.extensions.polygons.soup import carry_gaussians, load_corners, make_soup, save_soup
from minisplat_ref.io.ply import save_ply
from minisplat_ref.mechanisms.editing.model_file import load_label, load_model
from minisplat_ref.mechanisms.meshes.fans import N_SIDES

EDIT_EPILOG = """\
example: move vertices of soup.ply in a mesh tool, then
  minisplat-ref polygons edit runs/fox soup.ply --out edited.ply
  minisplat-ref render edited.ply --cameras orbit"""


def add_parser(commands: Any) -> None:
    """Add both commands."""
    add_export(commands)
    add_edit(commands)


def add_export(commands: Any) -> None:
    """Add the command ``export``."""
    parser = commands.add_parser(
        "export",
        help="write a model's Gaussians as flat polygons, to edit them with a mesh tool",
        epilog="example: minisplat-ref polygons export runs/fox --out soup.ply",
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="PLY of Gaussians, or a run's folder")
    parser.add_argument("--out", type=Path, required=True, metavar="SOUP", help="PLY of polygons to write")
    parser.add_argument("--sides", type=int, default=N_SIDES, metavar="N", help=f"of a polygon (default {N_SIDES})")
    parser.set_defaults(run=export_polygons)


def export_polygons(args: argparse.Namespace) -> int:
    """Read the model and write its polygons."""
    gaussians = load_model(args.model)
    soup = save_soup(args.out, gaussians, args.sides)
    left_out = len(gaussians.means) - len(soup.rows)
    print(
        f"{len(soup.rows):,} polygons of {args.sides} corners in {args.out}"
        + (f"; {left_out:,} Gaussians are too faint to have one" if left_out else "")
    )
    return 0


def add_edit(commands: Any) -> None:
    """Add the command ``edit``."""
    parser = commands.add_parser(
        "edit",
        help="carry an edit of a model's polygons back to its Gaussians",
        description="Apply an edit of exported polygons to the Gaussians of the model.",
        epilog=EDIT_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="that was exported: PLY, or a run's folder")
    parser.add_argument("soup", type=Path, metavar="SOUP", help="PLY of its polygons, with vertices moved")
    parser.add_argument("--out", type=Path, required=True, metavar="PLY", help="of Gaussians, to write")
    parser.set_defaults(run=carry_edit)


def carry_edit(args: argparse.Namespace) -> int:
    """Read the edited polygons, fit the Gaussians to them, and write these."""
    gaussians = load_model(args.model)
    n_polygons = len(make_soup(gaussians, 3).rows)
    corners = load_corners(args.soup, n_polygons)
    edited, n_edited = carry_gaussians(gaussians, make_soup(gaussians, corners.shape[1]), corners, args.soup)
    save_ply(args.out, edited, load_label(args.model))
    print(f"{n_edited:,} of {len(gaussians.means):,} Gaussians follow their polygons, in {args.out}")
    return 0
