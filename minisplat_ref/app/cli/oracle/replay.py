"""``oracle replay``: computes a view again in which a training found a number that is not finite."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from minisplat_ref.app.cli.oracle import add_output_arguments, publish
from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import Commands, HelpFormatter

if TYPE_CHECKING:
    from minisplat_ref.training.schedule import Recipe

DESCRIPTION = """\
Compute a view again in which a training found a number that is not finite: the
model, the view and the loss of that iteration, from the file that it left
(bad-numbers-N.npz in the run's folder), with every backend, in float64 and in
float32. Named is the first stage whose output is not finite.
"""
EPILOG = """\
example:
  minisplat-ref oracle replay runs/fox/bad-numbers-812.npz

Exit codes: 0 all finite, 1 some are not, 2 bad input."""


def add_parser(checks: Commands) -> None:
    """Add the check."""
    parser = checks.add_parser(
        "replay",
        help="compute again the view in which a training found a NaN",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="bad-numbers-N.npz of a run")
    add_output_arguments(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Replay, print a table."""
    from minisplat_ref.oracle.replay import replay
    from minisplat_ref.training.case import load_case

    saved = load_case(args.file)
    try:
        case = saved.of(_recipe(saved.metadata))
    except (KeyError, TypeError) as error:
        raise InputError(f"{args.file} is not of this version: {error}") from error
    return publish(replay(case, saved.wrong), args)


def _recipe(metadata: Mapping[str, Any]) -> "Recipe":
    """Return the recipe of the run; of a training without a run, the one of the name that it had."""
    from minisplat_ref.app.runs.options import Settings
    from minisplat_ref.app.runs.settings import configure_recipe
    from minisplat_ref.extensions.extension import find_recipe

    settings = metadata["settings"]
    return configure_recipe(Settings(**settings)) if settings else find_recipe(*metadata["recipe"])
