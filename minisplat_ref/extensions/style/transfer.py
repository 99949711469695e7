"""The command ``minisplat-ref style transfer``, which paints a trained scene in the style of an image."""

import argparse
from pathlib import Path
from typing import Any

from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import add_number, integer
from minisplat_ref.interface.progress import progress_bar

DESCRIPTION = """\
Paint a trained scene in the style of an image. First the photographs get the
colours of the image, and large Gaussians are split while these are learned;
then base colours are trained so that renders have the features of the image.

RUN is a run that is rendered as 3DGS, without sky, exposures or poses. NEW is a
run folder for render, eval, info and convert, with a copy of the image. eval
compares it with the photographs, which are not in that style.

The features are classical filters (edges, stripes, colours), not VGG; --weights
takes those of a network, an .npz whose layout is in the docstring of
minisplat_ref/mechanisms/features/network.py.
"""
EPILOG = """\
example:
  minisplat-ref style transfer runs/fox waves.png --out runs/fox-waves"""


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "transfer",
        help="paint a trained scene in the style of an image",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("run_folder", type=Path, metavar="RUN", help="the --out folder of a training")
    parser.add_argument("image", type=Path, metavar="IMAGE", help="the style")
    parser.add_argument("--out", type=Path, required=True, metavar="NEW", help="new folder for the painted scene")
    add_number(parser, "--iterations", 1000, "of each of the two stages")
    parser.add_argument(
        "--strength",
        type=integer(1),
        default=10,
        metavar="W",
        help="weight of the style: 10 for views all around (default), 100 for views\nthat all face forward",
    )
    parser.add_argument("--weights", type=Path, metavar="NPZ", help="features of a network of your own")
    parser.add_argument("--scene", type=Path, metavar="PATH", help="where the photographs are now, if they have moved")
    add_number(parser, "--seed", 0, "of the trainings", minimum=0, metavar="S")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Read, paint, write; nothing is left where one of these fails.

    Raises
    ------
    InputError
        The run, the image or the weights cannot be used, or NEW is there already.
    """
    from minisplat_ref.extensions.style.run_files import open_run, write_run
    from minisplat_ref.extensions.style.styling import Plan, check_style, default_weights, read_style, stylise
    from minisplat_ref.io.atomic import making_folder
    from minisplat_ref.io.images import write_image
    from minisplat_ref.mechanisms.features.filters import CLASSICAL
    from minisplat_ref.mechanisms.features.network import load_bank

    if args.out.resolve() == args.run_folder.resolve():
        raise InputError(f"{args.out} is the run itself: give another --out")
    bank = CLASSICAL if args.weights is None else load_bank(args.weights)
    opened = open_run(args.run_folder, args.scene)
    camera = opened.scene.train_views[0].camera
    image = read_style(args.image, max(camera.width, camera.height))
    check_style(image / 255, bank, str(args.image))
    plan = Plan(bank, default_weights(bank, args.strength), args.iterations, args.seed)
    with making_folder(args.out) as folder, progress_bar("painting", "iterations", 2 * args.iterations) as bar:
        styled = stylise(
            opened.gaussians,
            opened.scene,
            image / 255,
            plan,
            conventions=opened.conventions,
            on_step=lambda _: bar.update(),
        )
        about = {
            "run": str(args.run_folder.resolve()),
            "image": str(args.image.resolve()),
            "features": bank.name,
            **plan.weights._asdict(),
            "iterations": args.iterations,
            "seed": args.seed,
        }
        write_run(folder, opened, styled.gaussians, about)
        write_image(folder / "style.png", image)
    print(
        f"{len(opened.gaussians.means):,} Gaussians became {len(styled.gaussians.means):,}; the run in {args.out} is"
        f" shown by minisplat-ref render {args.out}"
    )
    return 0
