"""``data``: fetches the photographs of the measured pages from where they are published."""

import argparse
from pathlib import Path

from minisplat_ref.interface.arguments import Commands, HelpFormatter

DESCRIPTION = """\
Fetch photographs, with which the tables of docs/measured can be repeated,
from where they are published, or list them, with their licences.

Every file is checked against a hash. After an interruption, the same command
fetches what is missing.
"""
EPILOG = """\
examples:
  minisplat-ref data
  minisplat-ref data banana --out photos/banana"""


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "data",
        help="fetch the photographs of the measured pages",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("name", nargs="?", metavar="NAME", help="what to fetch (default: list what there is)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="new folder for it (default data/NAME)")
    parser.set_defaults(run=run, recommends=True)


def run(args: argparse.Namespace) -> int:
    """Fetch, and print how a scene is made of it; or list."""
    from minisplat_ref.datasets.catalogue import find
    from minisplat_ref.errors import InputError

    if args.name is not None:
        find(args.name)
        return _fetch(args.name, args.out or Path("data", args.name))
    if args.out is not None:
        raise InputError("--out needs the NAME of what to fetch: minisplat-ref data lists what there is")
    _list()
    return 0


def _fetch(name: str, out: Path) -> int:
    from minisplat_ref.app.reports.commands import command
    from minisplat_ref.datasets.catalogue import find, scene_files
    from minisplat_ref.datasets.fetching import fetch

    data_set, files = find(name), scene_files(name)
    n_fetched = fetch(files, out, name)
    there = f", {len(files) - n_fetched} were there" if n_fetched < len(files) else ""
    print(f"{out}: {n_fetched} files fetched{there}; all {len(files)} have the right hash")
    print(f"licence: {data_set.licence}" + (f" ({out / data_set.licence_file})" if data_set.licence_file else ""))
    words = (Path(word.format(out)) if "{}" in word else word for word in data_set.next_command)
    print(f"next: {command(*words)}")
    return 0


def _list() -> None:
    from minisplat_ref.datasets.catalogue import CATALOGUE, scene_files

    indent = " " * 16
    for name, data_set in CATALOGUE.items():
        megabytes = sum(file.n_bytes for file in scene_files(name)) / 1e6
        print(f"{name:<16}{data_set.what}, {megabytes:,.1f} MB")
        print(f"{indent}licence: {data_set.licence}")
        print(f"{indent}{data_set.page}")
