"""``convert``: the Gaussians of a run or of a checkpoint as a PLY."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from minisplat_ref.errors import InputError
from minisplat_ref.experiments.arguments import Commands, HelpFormatter

if TYPE_CHECKING:
    from minisplat_ref.extensions.extension import Extension
    from minisplat_ref.types import Model

DESCRIPTION = """\
Write the Gaussians of a run, or of a checkpoint.npz by itself, as a PLY in the
3DGS layout: those of the newest whole checkpoint if the run has not ended.
"""
EPILOG = """\
example: minisplat-ref convert runs/fox fox.ply
"""


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "convert",
        help="write the Gaussians of a run or checkpoint as a PLY",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("input", type=Path, metavar="DIR|NPZ", help="run folder or checkpoint")
    parser.add_argument("output", type=Path, metavar="PLY", help="file to make or replace")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Write the file, and say what is in it."""
    path: Path = args.input
    if args.output.suffix != ".ply":
        raise InputError(f"{args.output} is not named like a PLY: give a name that ends in .ply")
    model, owner, what = _of_run(path) if path.is_dir() else _of_checkpoint(path)
    owner.save(args.output, model.gaussians)
    print(f"{len(model.gaussians.means):,} Gaussians of {what} in {args.output}")
    if model.shared:
        print(f"minisplat-ref: a PLY does not hold {', '.join(model.shared)}, which belong to no row", file=sys.stderr)
    return 0


def _of_run(folder: Path) -> "tuple[Model, Extension, str]":
    from minisplat_ref.experiments.checkpoints import newest_model
    from minisplat_ref.experiments.settings import load
    from minisplat_ref.extensions.extension import CORE, owner_of

    settings = load(folder)
    saved = newest_model(folder, settings)
    what = "the run's result" if saved.unfinished is None else f"iteration {saved.unfinished}"
    return saved.model, owner_of(settings.recipe, settings.extension) or CORE, what


def _of_checkpoint(path: Path) -> "tuple[Model, Extension, str]":
    """Read a checkpoint without its run: the population is that of its recipe, which an extension may own."""
    from minisplat_ref.extensions.extension import CORE, owner_of
    from minisplat_ref.io.checkpoint import load_checkpoint
    from minisplat_ref.training.saved_state import read_bundles, read_counters, written_by
    from minisplat_ref.types import Gaussians, Model

    arrays, metadata = load_checkpoint(path)
    step = read_counters(path, metadata).step
    fields = {name.removeprefix("gaussians.") for name in arrays if name.startswith("gaussians.")}
    owner = CORE if fields == set(Gaussians._fields) else owner_of(written_by(metadata)[0]) or CORE
    bundles = read_bundles(path, arrays, owner.representation.population)
    return Model(bundles.gaussians, bundles.shared), owner, f"iteration {step}"
