"""The command ``minisplat-ref omg pack``, which writes a training's codes and networks as ``.omg``."""

import argparse
from pathlib import Path
from typing import Any

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.omg.method import OMG
from minisplat_ref.extensions.omg.population import OmgGaussians
from minisplat_ref.types import Frame, Model


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "pack",
        help="write the codes and networks of a run as .omg",
        description="Write the codes and networks of a run of the recipe omg, as they were trained,\n"
        "into one file, which every command reads that reads a PLY. (convert fits codes\n"
        "to the Gaussians of any run.)",
        epilog="example: minisplat-ref omg pack runs/small/checkpoint.npz --out small.omg",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("checkpoint", type=Path, metavar="CHECKPOINT", help="checkpoint.npz in the folder of the run")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="file to write, named .omg")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Write the file, and print its size.

    Raises
    ------
    InputError
        The checkpoint is none of the recipe omg, or not trained to the end; or the file cannot be written.
    """
    from minisplat_ref.extensions.omg.trained_file import describe, encode
    from minisplat_ref.io.formats import write_content

    if args.out.suffix.lower() != ".omg":
        raise InputError(f"{args.out} is not named .omg, by which commands know what it is: give another --out")
    model, frame = read_training(args.checkpoint)
    try:
        content = encode(model, frame)
    except InputError as error:
        raise InputError(f"{args.checkpoint}: {error}") from None
    write_content(args.out, content)
    n = len(model.gaussians.means)
    print(f"{n:,} Gaussians in {args.out}, {len(content):,} bytes, {len(content) / max(n, 1):.1f} each")
    print(*(f"  {name}: {value}" for name, value in describe(content, args.out)), sep="\n")
    return 0


def read_training(path: Path) -> tuple[Model, Frame]:
    """Return the population and the shared parameters of a checkpoint, and their frame.

    Raises
    ------
    InputError
        It is damaged, or of another recipe.
    """
    from minisplat_ref.io.checkpoint import load_checkpoint
    from minisplat_ref.training.saved_state import read_bundles, read_frame, recorded_recipe

    if path.is_dir():
        raise InputError(f"{path} is a folder: give the checkpoint.npz in it")
    arrays, metadata = load_checkpoint(path)
    recipe, _ = recorded_recipe(metadata)
    if recipe != OMG.name:
        raise InputError(f"{path} was trained by recipe {recipe}, which has no codes: train with --recipe {OMG.name}")
    bundles = read_bundles(path, arrays, OmgGaussians)
    return Model(bundles.gaussians, bundles.shared), read_frame(path, metadata)
