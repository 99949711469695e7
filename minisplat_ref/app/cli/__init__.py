"""The command line ``minisplat-ref``: reads arguments, shows progress, writes files; everything else lives below it.

One module per command, each with ``add_parser`` (arguments and help) and ``run`` (the work; returns the exit code). A
new command is such a module, named in ``GROUPS``. These modules import only the standard library at their top, and
what they need inside ``run``, so that ``--help`` does not wait for Numba.

Exit codes: 0 done, 1 a check of the oracle failed, 2 the input or the arguments are wrong (one line on stderr says
which and what to do), 130 interrupted. A programming error keeps its traceback.
"""

import argparse
import sys
import textwrap
from collections.abc import Sequence
from typing import Any

from minisplat_ref import __version__
from minisplat_ref.app.cli.guard import check_packages, run_guarded
from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import HelpFormatter, Parser

from . import (
    bench,
    cache,
    compare,
    convert,
    data,
    demo,
    downscale,
    evaluate,
    extensions,
    info,
    mesh,
    oracle,
    photos,
    render,
    sfm,
    simplify,
    synthetic,
    train,
    undistort,
    view,
)

GROUPS = {
    "start here": (demo, photos),
    "preparing scenes": (data, sfm, undistort, downscale, synthetic),
    "training and its results": (train, view, render, evaluate, simplify, mesh, convert, compare, info),
    "checks and measurements": (oracle, bench),
    "the program itself": (extensions, cache),
}
"""The commands under the headings of ``--help``."""

DESCRIPTION = """\
3D Gaussian Splatting on the CPU: train a scene from photographs, look at it,
measure it, and check every formula against a reference that can be read.

First time here:   minisplat-ref demo
Your own photos:   minisplat-ref photos PHOTOS --out mine
"""
SMALLER = ("downscale", "size", "width", "height", "views", "supersampling", "frames")  # options of less memory
EPILOG = "Exit codes: 0 done, 1 a check failed, 2 bad input, 130 interrupted."


class PrintCompletion(argparse.Action):
    """Prints a script for a shell, by shtab, and ends."""

    def __call__(self, parser: argparse.ArgumentParser, *values: Any, **options: Any) -> None:
        """Print the script for the shell that was named."""
        try:
            import shtab
        except ImportError:
            raise InputError("completion needs shtab: pip install 'minisplat_ref[completion]'") from None
        listed = argparse._SubParsersAction._ChoicesPseudoAction
        for commands in (action for action in parser._actions if isinstance(action, argparse._SubParsersAction)):
            # Back from the headings of the help: shtab completes what is listed here, and shown.
            commands.help = ""
            commands._choices_actions.extend(
                action
                for group in parser._action_groups
                for action in group._group_actions
                if isinstance(action, listed)
            )
        print(shtab.complete(parser, values[1]))
        parser.exit(0)


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands; ``args.run`` is the function of the chosen one, None where there is none."""
    parser = Parser(
        prog="minisplat-ref",
        usage="minisplat-ref COMMAND ...",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
        add_help=False,
    )
    parser.set_defaults(run=None)
    commands = parser.add_subparsers(prog="minisplat-ref", metavar="COMMAND", help=argparse.SUPPRESS)
    for title, modules in GROUPS.items():
        group = parser.add_argument_group(title)
        for command in modules:
            command.add_parser(commands)
        # argparse lists all commands under one heading; here each is listed under its own.
        group._group_actions.extend(commands._choices_actions)
        commands._choices_actions.clear()
    options = parser.add_argument_group("options")
    options.add_argument("-h", "--help", action="help", help="show this message; COMMAND --help explains a command")
    options.add_argument(
        "--completion",
        action=PrintCompletion,
        metavar="SHELL",
        choices=("bash", "zsh", "tcsh"),
        help="print what bash, zsh or tcsh is to source",
    )
    options.add_argument("--version", action="version", version=f"minisplat-ref {__version__}", help="show the version")
    return parser


def _find_parser(argv: Sequence[str]) -> argparse.ArgumentParser:
    """Return the parser of all commands; where the first word is an extension's name, of that extension's commands."""
    parser = build_parser()
    name = argv[0] if argv else ""
    if name.startswith("-") or name in _command_names(parser):
        return parser
    from minisplat_ref.extensions import folders, summaries

    if name not in folders():
        return parser
    from minisplat_ref.extensions.extension import load_extension

    extension = load_extension(name)
    if not extension.commands:
        raise InputError(f"extension {name} has no commands: see minisplat-ref extensions {name}")
    parser = Parser(prog="minisplat-ref", formatter_class=HelpFormatter)
    parser.set_defaults(run=None)
    own = parser.add_subparsers(metavar="EXTENSION").add_parser(
        name,
        description=textwrap.fill(summaries()[name], 80),
        formatter_class=HelpFormatter,
    )
    commands = own.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in extension.commands:
        command.add_parser(commands)
    own.epilog = f"example:\n  minisplat-ref {name} {next(iter(commands.choices))} --help"
    return parser


def _command_names(parser: argparse.ArgumentParser) -> set[str]:
    """Return what can be typed as the first word."""
    return {name for action in parser._actions if isinstance(action.choices, dict) for name in action.choices}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments without the program's name; those of the process by default.

    Returns
    -------
    int
        Exit code: 0, 2 for bad input, 130 when interrupted.
    """
    words = sys.argv[1:] if argv is None else argv
    return run_guarded(lambda: _run(words))


def _run(argv: Sequence[str]) -> int:
    """Run one command and return its exit code."""
    parser = _find_parser(argv)
    args = parser.parse_args(argv)
    args.words = tuple(argv)
    if args.run is None:
        parser.print_help()
        return 0
    check_packages(getattr(args, "needs", ()))
    try:
        code: int = args.run(args)
    except MemoryError:
        raise InputError(f"memory is full: {_smaller(args)}") from None
    if code == 0 and getattr(args, "recommends", False):
        _print_how_to_call()
    return code


def _smaller(args: argparse.Namespace) -> str:
    """Return what makes a command need less memory: those of its options that do."""
    options = [f"--{name}" for name in SMALLER if hasattr(args, name)]
    return f"give less at a time ({', '.join(options)})" if options else "close other programs, or give smaller input"


def _print_how_to_call() -> None:
    """Print what a shell needs before it finds the commands that were recommended."""
    from minisplat_ref.app.reports.commands import how_to_call

    for line in how_to_call():
        print(line)
