"""The gradients of all relatives in one table.

``python -m data_tools.relative_gradients --out DIR [NAME ...]`` runs ``minisplat-ref oracle gradients --extension NAME
--json DIR/NAME.json`` for every extension, or those that are named, unless its file is there already, and prints the
largest error of each kind of case over all backends. Relatives that have nothing of their own to check are named below
the table.
"""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from minisplat_ref.app.cli import main as run_command
from minisplat_ref.extensions.extension import load_extensions
from minisplat_ref.interface.reporting import describe_machine, markdown_table

KINDS = ("Jacobian", "inner products", "as on reference")
"""What the names of the cases end with."""
HEADING = ("relative", "cases", "passed", *KINDS, "entries of Jacobians")
NOTHING = "nothing was checked"
"""Begins the note of a relative that has nothing to check."""


def to_row(name: str, cases: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the row of a relative, as in :data:`HEADING`.

    Parameters
    ----------
    name : str
    cases : sequence of mapping
        The ``cases`` of the command's file: name, passed, error and, of Jacobians, entries.
    """
    of_kinds = {kind: [case for case in cases if case["name"].endswith(f": {kind}")] for kind in KINDS}
    errors = (max((case["error"] for case in own), default=None) for own in of_kinds.values())
    entries = sum(int(case["entries"]) for case in of_kinds["Jacobian"])
    n_passed = sum(case["passed"] for case in cases)
    shown = ("" if error is None else f"{error:.1e}" for error in errors)
    return [name, str(len(cases)), str(n_passed), *shown, f"{entries:,}"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m data_tools.relative_gradients", description=__doc__.split("\n\n")[0]
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="extensions (default: all of them)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="the files of the checks")
    args = parser.parse_args(arguments)
    args.out.mkdir(parents=True, exist_ok=True)
    rows, without = [], []
    for name in args.names or sorted(extension.name for extension in load_extensions()):
        path = args.out / f"{name}.json"
        if not path.exists():
            run_command(["oracle", "gradients", "--extension", name, "--json", str(path)])
        if not path.exists():
            sys.exit(2)  # the command has said why
        cases = json.loads(path.read_text())["cases"]
        if cases[0]["note"].startswith(NOTHING):
            without.append(name)
        else:
            rows.append(to_row(name, cases))
    print(describe_machine(), "", markdown_table(HEADING, rows), sep="\n")
    if without:
        print("", f"{NOTHING} of {', '.join(without)}", sep="\n")


if __name__ == "__main__":
    main()
