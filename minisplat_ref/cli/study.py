"""``study``: measures what a choice in a method does."""

import argparse
from typing import TYPE_CHECKING

from minisplat_ref.arguments import Commands, HelpFormatter, Parser
from minisplat_ref.errors import InputError

if TYPE_CHECKING:
    from minisplat_ref.studies.study import Study

DESCRIPTION = """\
Measure what a choice in a method does to a scene: it is trained with and
without, and a table and a figure say what that has changed.

Without a NAME: list the studies.
"""
EPILOG = """\
examples:
  minisplat-ref study
  minisplat-ref study ablation --help
  minisplat-ref study ablation room --iterations 1500 --out studies/ablation"""


def add_parser(commands: Commands) -> None:
    """Add the command. A study's own arguments are parsed when it is known which one it is: see :func:`run`."""
    parser = commands.add_parser(
        "study",
        help="measure what a choice in a method does",
        usage="minisplat-ref study [-h] [NAME ...]",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("name", nargs="?", metavar="NAME", help="of a study")
    parser.add_argument(
        "arguments", nargs=argparse.REMAINDER, metavar="...", help="its arguments: see minisplat-ref study NAME --help"
    )
    parser.set_defaults(run=run, needs=("matplotlib",))


def run(args: argparse.Namespace) -> int:
    """Run a study, or list all."""
    from minisplat_ref.studies import all_studies

    studies = all_studies()
    if args.name is not None and "/" in args.name:
        studies |= _extension_studies(args.name)
    if args.name is None:
        width = max(map(len, studies))
        for name, study in studies.items():
            print(f"{name:<{width}}  {study.summary}")
        print("\nminisplat-ref study NAME --help explains one. Those of an extension are called EXTENSION/NAME:")
        print("minisplat-ref extensions EXTENSION lists them.")
        return 0
    if args.name not in studies:
        raise InputError(f"there is no study {args.name!r}: choose from {', '.join(studies)}")
    study = studies[args.name]
    parser = Parser(prog=f"minisplat-ref study {args.name}", description=study.summary, formatter_class=HelpFormatter)
    study.add_arguments(parser)
    parser.epilog = _example(parser)
    return study.run(parser.parse_args(args.arguments)) or 0


EXAMPLES = {"SCENE": "room", "FILE": "runs/mine.ply", "DIR": "study"}
"""What the example of a study shows for a required argument, by its placeholder."""


def _example(parser: argparse.ArgumentParser) -> str:
    """Return a line that calls a study with all that it requires."""
    words = [parser.prog]
    for action in parser._actions:
        if action.required:
            words += [*action.option_strings[-1:], EXAMPLES.get(str(action.metavar), str(action.metavar))]
    return f"example:\n  {' '.join(words)}"


def _extension_studies(name: str) -> "dict[str, Study]":
    """Return the studies of the extension that ``EXTENSION/NAME`` begins with, by their whole names."""
    from minisplat_ref.extensions.extension import load_extension

    extension = load_extension(name.partition("/")[0])
    return {f"{extension.name}/{study.name}": study for study in extension.studies}
