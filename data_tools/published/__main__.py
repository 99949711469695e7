"""``python -m data_tools.published CLONES`` prints each constant of ours, and what its source says at a commit.

CLONES has the repositories that the tables name, each in OWNER/NAME, as git clones them::

    git clone https://github.com/OWNER/NAME CLONES/OWNER/NAME

One that is missing is named, with its rows. Rows that differ, and nothing else, make the exit status 1.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from data_tools.published.check import DIFFERS, NO_CLONE, Verdict, judge
from data_tools.published.constants import CONSTANTS
from data_tools.published.relatives import TABLES
from data_tools.published.rows import Row
from minisplat_ref.interface.arguments import HelpFormatter, Parser
from minisplat_ref.interface.reporting import markdown_table

HEADINGS = ("constant", "ours", "released", "verdict", "source", "where")
SHOWN_MAX = 60  # letters of a value


def named_rows() -> Iterator[tuple[str, Row]]:
    """Yield each row once, with the recipe or module that it is stated for; recipes share those of their parents."""
    seen: set[int] = set()
    for place, table in (*TABLES.items(), ("modules", CONSTANTS)):
        for name, row in table.items():
            if id(row) not in seen:
                seen.add(id(row))
                yield f"{place}: {name}", row


def shown(value: Any) -> str:
    """Return a value in a cell; iterations by the first, the second and the last."""
    if isinstance(value, list) and value and isinstance(value[0], list):
        return "; ".join(_dates(one) for one in value)
    text = str(value)
    return text if len(text) <= SHOWN_MAX else f"{text[:SHOWN_MAX]}..."


def _dates(steps: list[int]) -> str:
    if len(steps) <= 3:
        return ", ".join(map(str, steps))
    return f"{steps[0]}, {steps[1]}, ..., {steps[-1]} ({len(steps)})"


def cells(name: str, row: Row, verdict: Verdict) -> tuple[str, ...]:
    """Return the cells of a row of the printed table."""
    found = ", ".join("not found" if number is None else f"{number:g}" for number in verdict.found)
    where = row.reason or ", ".join(row.symbols)
    return name, shown(row.value), found, verdict.word, str(row.source), where


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status."""
    parser = Parser(prog="python -m data_tools.published", description=__doc__, formatter_class=HelpFormatter)
    parser.add_argument("clones", type=Path, metavar="CLONES", help="folder of clones")
    parser.add_argument("--only", metavar="VERDICT", help="print rows of one verdict, such as differs, kept or ours")
    args: argparse.Namespace = parser.parse_args(arguments)
    rows = [(name, row, judge(row, args.clones)) for name, row in named_rows()]
    chosen = [row for row in rows if args.only in (None, row[2].word)]
    print(markdown_table(HEADINGS, [cells(*row) for row in chosen]))
    counts: dict[str, int] = {}
    for _, _, verdict in rows:
        counts[verdict.word] = counts.get(verdict.word, 0) + 1
    print("\n" + ", ".join(f"{count} {word}" for word, count in sorted(counts.items())))
    missing = {f"{row.source}" for _, row, verdict in rows if verdict.word == NO_CLONE}
    for source in sorted(missing):
        print(f"not read: {source}", file=sys.stderr)
    return 1 if counts.get(DIFFERS) else 0


if __name__ == "__main__":
    sys.exit(main())
