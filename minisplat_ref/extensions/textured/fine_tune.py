"""The command ``minisplat-ref textured fine-tune``, which adds textures to a scene that was trained without any."""

import argparse
from pathlib import Path
from typing import Any

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.textured.model import DEGREE
from minisplat_ref.interface.arguments import add_background, add_number
from minisplat_ref.interface.progress import progress_bar
from minisplat_ref.io.label import Label
from minisplat_ref.io.ply import load_ply, save_ply
from minisplat_ref.io.run_files import read_background


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "fine-tune",
        help="train textures for the Gaussians of a run, whose number stays",
        epilog="example: minisplat-ref textured fine-tune SCENE runs/few/point_cloud.ply --out textured.ply",
    )
    parser.add_argument("scene", metavar="SCENE", help="folder that the run was trained on")
    parser.add_argument("ply", type=Path, metavar="PLY", help="its point_cloud.ply; the paper uses Mini-Splatting")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="PLY to write")
    add_number(parser, "--downscale", 1, "make photographs D times smaller", metavar="D")
    add_number(parser, "--iterations", 1000, "length")
    parser.add_argument(
        "--degree", type=int, default=DEGREE, metavar="L", help="degree of textures, 1 to 3 (default 3)"
    )
    parser.add_argument(
        "--replace", action="store_true", help="replace the view-dependent colour by textures, as in the paper"
    )
    parser.add_argument("--frozen", action="store_true", help="train no positions and shapes, as the paper's text says")
    add_number(parser, "--seed", 0, "of the training", minimum=0, metavar="S")
    add_background(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Train, write the PLY, and print the change on the test views.

    Raises
    ------
    InputError
        The scene, the PLY or the output cannot be used, or a number is out of range.
    """
    from minisplat_ref.datasets.named_scenes import read_scene
    from minisplat_ref.extensions.textured.recipe import fine_tune, measure, prepare
    from minisplat_ref.training.representation import count_floats

    if not 1 <= args.degree <= DEGREE:
        raise InputError(f"--degree is {args.degree}: give 1, 2 or 3")
    if not args.out.parent.is_dir():
        raise InputError(f"{args.out.parent} is no folder: make it, or give another --out")
    gaussians = load_ply(args.ply)
    if len(gaussians.means) == 0:
        raise InputError(f"{args.ply} holds no Gaussians: give the PLY of a run")
    scene = read_scene(args.scene, args.downscale, background=read_background(args.ply, args.background))
    before = measure(gaussians, scene, scene.test_views)
    with progress_bar("textures", "iterations", args.iterations) as bar:
        start = prepare(gaussians, args.degree, args.replace)
        textured = fine_tune(
            start, scene, args.iterations, args.seed, is_frozen=args.frozen, on_step=lambda _: bar.update()
        )
    after = measure(textured, scene, scene.test_views)
    save_ply(args.out, textured, Label("textured"))
    print(
        f"{len(gaussians.means):,} Gaussians, {count_floats(gaussians)} numbers each: test PSNR {before.psnr:.2f} dB,"
        f" SSIM {before.ssim:.4f}\nwith textures, {count_floats(textured)} numbers each: {after.psnr:.2f} dB,"
        f" {after.ssim:.4f}; in {args.out}"
    )
    return 0
