"""``python -m data_tools.rule_changes``: change rules, constants and dates as a reader chose, to see if a test fails.

``data_tools.mutation`` draws its changes; what it draws in a module of formulas is mostly noticed at once. The changes
of ``rule_changes.toml`` were chosen by a reader instead, as the mistakes that look right: a threshold doubled, a date
moved, a mean for a median, a condition left out. Each replaces a text that stands once in its file by another. They are
tested by the table of published constants, by the files that import the module, the nearest first, and by what holds
for every extension, for a bounded time, so a survivor may be noticed by a test that was not run. All happens in a copy
of the working tree.

A change whose text is gone from the code is named and left out. Whoever edits such a line edits the change, too, or
deletes it. Where tests fail without a change, nothing can be said, and the program ends.
"""

import os
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from data_tools.sources import Imports, copy_tree
from minisplat_ref.interface.arguments import HelpFormatter, Parser, integer

CHANGES = Path(__file__).with_suffix(".toml")
FILES_MAX = 6  # of tests for a change, those nearest to the module
TABLE = Path("tests/extensions/test_published.py")  # of all recipes; like the next it finds them by their names
RULES = Path("tests/extensions/test_every_extension.py")
HANGS = 300  # seconds beyond those of the tests: then a change has made something endless, which counts as noticed


class Change(NamedTuple):
    """A text of a file, and what replaces it."""

    path: Path
    old: str
    new: str

    def __str__(self) -> str:
        """Return the change as a line."""
        return f"{self.path}: {self.old!r} -> {self.new!r}"


def read_changes(tables: Mapping[str, Sequence[Sequence[str]]], paths: Sequence[Path]) -> list[Change]:
    """Return the changes of a table from files to pairs, of files that are, or lie in, ``paths``; of all if none."""
    return [
        Change(Path(name), old, new)
        for name, pairs in tables.items()
        for old, new in pairs
        if not paths or any(Path(name).is_relative_to(path) for path in paths)
    ]


def is_noticed(change: Change, tests: Sequence[Path], seconds: int) -> bool | None:
    """Return whether a test fails with a change of the current folder, or None where its text does not stand once."""
    source = change.path.read_text() if change.path.is_file() else ""
    if source.count(change.old) != 1:
        return None
    change.path.write_text(source.replace(change.old, change.new))
    try:
        return not do_pass(tests, seconds)
    finally:
        change.path.write_text(source)


def do_pass(tests: Sequence[Path], seconds: int) -> bool:
    """Return whether all tests pass of those that the time reaches."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
    command += ["-p", "data_tools.deadline", "--seconds", str(seconds), *map(str, tests)]
    try:
        return subprocess.run(command, capture_output=True, timeout=seconds + HANGS).returncode == 0
    except subprocess.TimeoutExpired:
        return False


def outcomes(changes: Sequence[Change], seconds: int) -> Iterator[tuple[Change, bool | None]]:
    """Yield each change with what came of it, in a copy of the working tree."""
    home = Path.cwd()
    with TemporaryDirectory() as folder:
        os.chdir(copy_tree(Path(folder)))
        os.environ["PYTHONPATH"] = os.getcwd()
        os.environ["PYTHONDONTWRITEBYTECODE"] = "1"  # a change of the same length in the same second would not be read
        imports = Imports(sorted(Path("minisplat_ref").rglob("*.py")), sorted(Path("tests").rglob("test_*.py")))
        try:
            for path, own in groupby(changes, key=lambda change: change.path):
                tests = [TABLE, *imports.tests_of(path)[:FILES_MAX], RULES]
                if not do_pass(tests, seconds):
                    sys.exit(f"{path}: its tests fail without a change: {' '.join(map(str, tests))}")
                for change in own:
                    yield change, is_noticed(change, tests, seconds)
        finally:
            os.chdir(home)


def main() -> None:
    """Test the changes; print what came of each, then the sums."""
    parser = Parser(
        prog="python -m data_tools.rule_changes",
        description="Change rules, constants and dates as a reader chose, and see whether a test fails.",
        formatter_class=HelpFormatter,
    )
    parser.add_argument("paths", nargs="*", type=Path, metavar="PATH", help="of these files or folders (default: all)")
    parser.add_argument(
        "--changes", type=Path, default=CHANGES, metavar="FILE", help="a TOML (default data_tools/rule_changes.toml)"
    )
    parser.add_argument(
        "--seconds", type=integer(1), default=60, metavar="T", help="of tests for a change (default 60)"
    )
    args = parser.parse_args()
    changes = read_changes(tomllib.loads(args.changes.read_text()), args.paths)
    counts: Counter[str] = Counter()
    for change, noticed in outcomes(changes, args.seconds):
        word = "gone" if noticed is None else "noticed" if noticed else "survived"
        counts[word] += 1
        print(f"{sum(counts.values())}/{len(changes)} {word} {change}", flush=True)
    print(", ".join(f"{n} {word}" for word, n in sorted(counts.items())) or "no changes")


if __name__ == "__main__":
    main()
