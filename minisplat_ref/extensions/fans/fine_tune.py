"""The command ``minisplat-ref fans fine-tune``: fans whose vertices are optimised against photographs."""

import argparse
from pathlib import Path
from typing import Any

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.fans.arguments import add_shape, load_as_fans, shape_of
from minisplat_ref.interface.arguments import add_number
from minisplat_ref.interface.progress import progress_bar

EPILOG = """\
example:
  minisplat-ref fans fine-tune photos/fox runs/fox fans.ply --downscale 4
  minisplat-ref render fans.ply --cameras runs/fox/cameras.json
  minisplat-ref fans export fans.ply fox.glb"""


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "fine-tune",
        help="optimise positions, colours and opacities of a scene's vertices",
        description="Make fans of a trained scene and train their vertices, by the loss of 3DGS.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("scene", metavar="SCENE", help="folder of photographs that the model was trained on")
    parser.add_argument("model", type=Path, metavar="MODEL", help="PLY of Gaussians or of fans, or a run's folder")
    parser.add_argument("out", type=Path, metavar="OUT", help="PLY of fans to write")
    add_number(parser, "--downscale", 1, "make photographs D times smaller", metavar="D")
    add_number(parser, "--iterations", 1000, "length")
    add_number(parser, "--seed", 0, "of the training", minimum=0, metavar="S")
    add_shape(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Train, write, and report the change on the test views.

    Raises
    ------
    InputError
        The scene, the model or the output cannot be used, or a number is out of range.
    """
    from minisplat_ref.datasets.named_scenes import read_scene
    from minisplat_ref.extensions.fans.mesh_files import save_fans
    from minisplat_ref.extensions.fans.tuning import fine_tune, measure

    if args.out.suffix.lower() != ".ply":
        raise InputError(f"{args.out}: fine-tuned fans are written as a .ply, of which fans export makes other formats")
    if not args.out.parent.is_dir():
        raise InputError(f"{args.out.parent} is no folder: make it, or give another OUT")
    start = load_as_fans(args.model, shape_of(args))
    scene = read_scene(args.scene, args.downscale)
    before = measure(start, scene, scene.test_views)
    with progress_bar("vertices", "iterations", args.iterations) as bar:
        fans = fine_tune(start, scene, args.iterations, args.seed, lambda _: bar.update())
    after = measure(fans, scene, scene.test_views)
    save_fans(args.out, fans)
    print(
        f"{len(start.means):,} fans: test PSNR {before.psnr:.2f} dB, SSIM {before.ssim:.4f}\n"
        f"fine-tuned, {len(fans.means):,} fans: {after.psnr:.2f} dB, {after.ssim:.4f}; in {args.out}"
    )
    return 0
