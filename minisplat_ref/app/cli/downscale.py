"""``downscale``: writes a scene's photographs at a smaller size beside them."""

import argparse
from pathlib import Path

from minisplat_ref.interface.arguments import Commands, HelpFormatter

DESCRIPTION = """\
Write the photographs of a scene at 1/D of their size into SCENE/images_D.

train --downscale D reads that folder where it is there, and makes the
photographs smaller while loading where it is not: this saves time, no more.
"""
EPILOG = """\
example:
  minisplat-ref downscale photos/fox --downscale 4"""


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "downscale",
        help="write smaller copies of a scene's photographs",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("scene", type=Path, metavar="SCENE", help="scene with images/, or a folder of images")
    parser.add_argument("--downscale", type=int, default=2, metavar="D", help="make them D times smaller (default 2)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Write the images, and print where they are."""
    from minisplat_ref.datasets.downscale import downscale_images

    images = args.scene / "images"
    print(downscale_images(images if images.is_dir() else args.scene, args.downscale))
    return 0
