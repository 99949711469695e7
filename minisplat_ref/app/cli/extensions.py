"""``extensions``: lists the relatives of 3DGS, and the content of each."""

import argparse
from typing import TYPE_CHECKING

from minisplat_ref.interface.arguments import Commands, HelpFormatter

if TYPE_CHECKING:
    from minisplat_ref.extensions.extension import Extension

DESCRIPTION = """\
List the extensions, or say what one of them brings.

An extension is a folder: of the package, or of a folder that the environment
variable MINISPLAT_EXTENSIONS names. docs/EXTENDING.md shows how to write one.
"""
EPILOG = """\
examples:
  minisplat-ref extensions
  minisplat-ref extensions velocity
  minisplat-ref train SCENE --recipe velocity
  minisplat-ref train SCENE --extension geometry --set depth_smoothness=0.1
"""


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "extensions",
        help="list the relatives of 3DGS that come as extensions",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("name", nargs="?", metavar="NAME", help="say what this one brings (default: list all)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print the list, or one extension."""
    if args.name is not None:
        _describe(args.name)
        return 0
    from minisplat_ref.extensions import summaries

    lines = summaries()
    width = max(map(len, lines), default=0)
    for name, summary in lines.items():
        print(f"{name:<{width}}  {summary}")
    return 0


def _describe(name: str) -> None:
    import inspect
    import sys

    from minisplat_ref.extensions import folders, module_of
    from minisplat_ref.extensions.extension import load_extension

    extension = load_extension(name)
    print(inspect.getdoc(sys.modules[module_of(name)]))
    rows = {
        "folder": str(folders()[name]),
        "recipes": ", ".join(recipe.name for recipe in extension.recipes),
        "trains": extension.representation.name,
        "losses": ", ".join(term.name for term in extension.losses),
        "commands": ", ".join(f"minisplat-ref {name} {command}" for command in _list_commands(extension)),
        "formats": ", ".join(f"{format_.suffix} ({format_.summary})" for format_ in extension.formats),
    }
    print()
    for label, value in rows.items():
        if value:
            print(f"{label:<8}  {value}")


def _list_commands(extension: "Extension") -> list[str]:
    """Return the names of an extension's commands, which are not always those of their modules."""
    commands = argparse.ArgumentParser().add_subparsers()
    for module in extension.commands:
        module.add_parser(commands)
    return list(commands.choices)
