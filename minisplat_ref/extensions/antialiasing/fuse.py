"""The command ``minisplat-ref antialiasing fuse``, which writes filtered Gaussians as Gaussians for any viewer."""

import argparse
from pathlib import Path
from typing import Any

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.antialiasing.model import EPS2D, FilteredGaussians, apply_filters
from minisplat_ref.io.ply import further_properties, load_ply, read_label, save_ply
from minisplat_ref.io.run_files import model_file

DESCRIPTION = """\
Write the Gaussians of a run of recipe antialiasing for viewers that do not know
its filters. The filter in space goes into scales and opacities, once and for
all. The one in the image cannot: it is the viewer's. A viewer that can be told
to draw antialiased shows the result best.
"""
EPILOG = """\
examples:
  minisplat-ref antialiasing fuse runs/fox fox.ply
  minisplat-ref convert fox.ply fox.spz"""


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "fuse",
        help="write the filtered Gaussians for other viewers",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="run's folder, or the PLY of one")
    parser.add_argument("out", type=Path, metavar="OUT", help="PLY to write")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Read, filter, write.

    Raises
    ------
    InputError
        The model has no filters or cannot be read, or the PLY to write is the one that is read, or no PLY.
    """
    file = model_file(args.model)
    if args.out.suffix.lower() != ".ply":
        raise InputError(f"{args.out} is not named like a PLY: give a name that ends in .ply, and convert that")
    if "filter_sigmas" not in further_properties(file):
        raise InputError(f"{file} has no filters: give a run of recipe antialiasing, or its point_cloud.ply")
    if args.out.exists() and args.out.samefile(file):
        raise InputError(f"{args.out} would lose its filters: give another OUT")
    filtered = load_ply(file, FilteredGaussians)
    save_ply(args.out, apply_filters(filtered), read_label(file)._replace(extension=None))
    print(
        f"{len(filtered.means):,} Gaussians in {args.out}; in a viewer that can draw antialiased, switch that on"
        f" (the filter of the run has {EPS2D:g} px^2 in the image, that of 3DGS 0.3)"
    )
    return 0
