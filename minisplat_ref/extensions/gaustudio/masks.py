"""The command ``minisplat-ref gaustudio masks``: masks of the sky as files, for inspection and correction."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.extensions.gaustudio.sky_masks import by_color
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.io import load_scene, write_image
from minisplat_ref.io.atomic import making_folder

EPILOG = """\
example:
  minisplat-ref gaustudio masks SCENE --out masks
  minisplat-ref train SCENE --recipe gaustudio \\
    --set sky_mask=from_files --set mask_folder=masks"""


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "masks",
        help="write what sky_mask=by_color takes for sky, to be mended by hand",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("scene", metavar="SCENE", help="folder of a scene")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder for NAME.png, white is sky")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Write a mask for each photograph, and report its fraction of sky."""
    scene = load_scene(args.scene, test_every=0)
    shares = []
    with making_folder(args.out) as folder:
        for view in with_progress(scene.train_views, "looking for skies", "photographs"):
            is_sky = by_color(view.load(), "")
            file = folder / f"{view.name}.png"
            file.parent.mkdir(parents=True, exist_ok=True)
            write_image(file, is_sky)
            shares.append(np.mean(is_sky))
    n_with = sum(share > 0 for share in shares)
    print(
        f"{len(shares)} masks in {args.out}: {n_with} show a sky, {np.mean(shares):.0%} of all pixels; look at them and"
        " mend what is wrong"
    )
    return 0
