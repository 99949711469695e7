"""The commands ``segment label`` and ``segment render``: labels from masks, and what cameras see of them."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.segment.files import read_labels, read_masks, read_subject, save_labelled, save_part
from minisplat_ref.extensions.segment.votes import UNSEEN, Votes, assign_labels, belongs, count_votes, label_map
from minisplat_ref.interface.palette import SERIES
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.io import write_image
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.types import Ints

LABEL_DESCRIPTION = """\
Give every Gaussian a label, from masks of some photographs: NAME.png for the
photograph NAME, whose pixels are ids and 0 is the background. Each Gaussian
takes the label in whose pixels it has the largest share; one that no mask's
camera sees gets -1. --extract and --remove write one object alone, or
everything else.
"""
LABEL_EPILOG = """\
examples:
  minisplat-ref segment label runs/fox --masks masks --out labelled.ply
  minisplat-ref segment label runs/fox --masks masks --extract 1 --out head.ply
  minisplat-ref segment label runs/fox --masks masks --remove 1 --bias -0.3 \\
    --out without.ply"""

RENDER_EPILOG = """\
example:
  minisplat-ref segment render labelled.ply --cameras runs/fox/cameras.json \\
    --out labels"""


def add_parser(commands: Any) -> None:
    """Add both commands."""
    add_label(commands)
    add_render(commands)


def add_label(commands: Any) -> None:
    """Add the command ``label``."""
    parser = commands.add_parser(
        "label",
        help="label Gaussians from masks, take an object out or away",
        description=LABEL_DESCRIPTION,
        epilog=LABEL_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("run_folder", type=Path, metavar="RUN", help="folder of a run, or a PLY with its cameras")
    parser.add_argument("--masks", type=Path, required=True, metavar="DIR", help="folder of NAME.png")
    parser.add_argument("--out", type=Path, required=True, metavar="PLY", help="file to write")
    parser.add_argument("--bias", type=float, default=0.0, metavar="G", help="above 0 for the background (default 0)")
    parser.add_argument("--cameras", type=Path, metavar="JSON", help="cameras.json (default: beside the PLY)")
    part = parser.add_mutually_exclusive_group()
    part.add_argument("--extract", type=int, metavar="ID", help="write the Gaussians of one object alone")
    part.add_argument("--remove", type=int, metavar="ID", help="write all but those of one object")
    parser.set_defaults(run=label_gaussians)


def label_gaussians(args: argparse.Namespace) -> int:
    """Read masks, count votes, write.

    Raises
    ------
    InputError
        Model or masks cannot be used, the bias is not in [-1, 1], or no mask has the requested object.
    """
    if not -1 <= args.bias <= 1:
        raise InputError(f"--bias is {args.bias:g}: give a number from -1 to 1")
    if args.out.suffix.lower() != ".ply":
        raise InputError(f"{args.out} is not named like a PLY: give a name that ends in .ply, and convert that")
    subject = read_subject(args.run_folder, args.cameras)
    masks = read_masks(args.masks, subject.cameras)
    ids = sorted({0, *(int(label) for _, mask in masks for label in np.unique(mask))})
    wanted = args.extract if args.extract is not None else args.remove
    if wanted is not None and wanted not in ids[1:]:
        option = "--extract" if args.extract is not None else "--remove"
        raise InputError(f"{option} {wanted}: the masks have {', '.join(map(str, ids[1:])) or 'no object'}")
    bar = with_progress(masks, "counting votes", "masks")
    votes = count_votes(subject.placed, subject.renderer, ((view.camera, mask) for view, mask in bar), ids)
    n = len(subject.population.means)
    if wanted is None:
        found = assign_labels(votes, args.bias)
        save_labelled(args.out, subject, found)
        print(f"{n:,} Gaussians with labels in {args.out}, from {len(masks)} masks\n\n{table(votes, found)}")
    else:
        is_object = belongs(votes, wanted, args.bias)
        is_kept = is_object if args.extract is not None else ~is_object
        save_part(args.out, subject, is_kept)
        print(f"{np.count_nonzero(is_kept):,} of {n:,} Gaussians in {args.out}, from {len(masks)} masks")
    n_unseen = np.count_nonzero(~votes.is_seen)
    if n_unseen:
        print(f"{n_unseen:,} are seen by no camera that has a mask: they have no label")
    return 0


def table(votes: Votes, found: Any) -> str:
    """Return a line for each label: the number of Gaussians, and the share of their weight in its pixels."""
    rows = []
    for row, label in enumerate(votes.ids):
        is_own = found == label
        total = votes.weights[:, is_own].sum()
        share = f"{votes.weights[row, is_own].sum() / total:.3f}" if total > 0 else ""
        rows.append([str(label), f"{np.count_nonzero(is_own):,}", share])
    rows.append([str(UNSEEN), f"{np.count_nonzero(found == UNSEEN):,}", ""])
    return markdown_table(["label", "Gaussians", "of their weight in its pixels"], rows)


def add_render(commands: Any) -> None:
    """Add the command ``render``."""
    parser = commands.add_parser(
        "render",
        help="draw the labels that the cameras see",
        epilog=RENDER_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("model", type=Path, metavar="PLY", help="with labels, from segment label")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder for ids/ and colors/")
    parser.add_argument("--cameras", type=Path, metavar="JSON", help="cameras.json (default: beside the PLY)")
    parser.set_defaults(run=render_labels)


def render_labels(args: argparse.Namespace) -> int:
    """Render every camera's labels.

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
