"""``undistort``: copies a scene, its photographs warped to pinhole cameras."""

import argparse
from pathlib import Path

from minisplat_ref.interface.arguments import Commands, HelpFormatter

DESCRIPTION = """\
Copy a scene without lens distortion: photographs and masks are warped to the
pinhole camera that COLMAP chooses for their lens, with the same focal length
and no blank pixels. Poses and points stay.

The renderer knows pinholes only. train --undistort does the same while it
loads, each time.
"""
EPILOG = """\
example:
  minisplat-ref undistort photos/fox --out photos/fox-pinhole"""


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "undistort",
        help="copy a scene without lens distortion",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument(
        "scene", type=Path, metavar="SCENE", help="folder of a COLMAP scene or of a transforms.json, or that file"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder for the copy")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Write the copy, and print where it is."""
    from minisplat_ref.datasets.undistort import undistort_scene

    undistort_scene(args.scene, args.out)
    print(args.out)
    return 0
