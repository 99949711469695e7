"""The command ``minisplat-ref segment render``: the labels that cameras see, as ids and as colours."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.segment.maps import label_map
from minisplat_ref.extensions.segment.model import read_labels, read_subject
from minisplat_ref.interface.palette import SERIES
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.io import write_image
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.types import Ints

EPILOG = """\
example:
  minisplat-ref segment render labelled.ply --cameras runs/fox/cameras.json \\
    --out labels"""


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "render",
        help="draw the labels that the cameras see",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("model", type=Path, metavar="PLY", help="with labels, from segment label")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder for ids/ and colors/")
    parser.add_argument("--cameras", type=Path, metavar="JSON", help="cameras.json (default: beside the PLY)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Draw every camera's labels.

    Raises
    ------
    InputError
        The model has no labels or there are no cameras.
    """
    subject = read_subject(args.model, args.cameras)
    labels = read_labels(subject)
    if labels.max(initial=0) > np.iinfo(np.uint16).max:
        raise InputError(
            f"{args.model}: a label of {labels.max()} does not fit into a PNG; number objects below 65,536"
        )
    with making_folder(args.out) as folder:
        for view in with_progress(subject.cameras, "rendering", "views"):
            ids = label_map(subject.placed, labels, subject.renderer, view.camera)
            for kind, image in (
                ("ids", ids.astype(np.uint8 if ids.max() < 256 else np.uint16)),
                ("colors", paint(ids)),
            ):
                file = folder / kind / f"{view.name}.png"
                file.parent.mkdir(parents=True, exist_ok=True)
                write_image(file, image)
    print(f"labels of {len(subject.cameras)} cameras in {args.out}: ids/ has numbers, colors/ is to look at")
    return 0


def paint(ids: Ints) -> NDArray[np.uint8]:
    """Return an image [H, W, 3] of labels [H, W]: black is the background, colours repeat after eight labels."""
    colors = [[0, 0, 0], *([int(color[i : i + 2], 16) for i in (1, 3, 5)] for color in SERIES)]
    rows = np.where(ids > 0, 1 + (ids - 1) % len(SERIES), 0)
    return np.array(colors, np.uint8)[rows]
