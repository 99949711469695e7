"""A row of the tables, compared with the file that it names in a folder of clones.

A clone lies in CLONES/OWNER/NAME, with or without a work tree, and its files are read at the row's commit, whatever is
checked out.
"""

import re
import subprocess
from functools import cache
from pathlib import Path
from typing import NamedTuple

from data_tools.published.rows import Row, Source

AGREES, DIFFERS, KEPT, OURS, PAPER, NO_CLONE = "agrees", "differs", "kept", "ours", "paper", "no clone"
_NUMBER = r"[-+]?(?:\d[\d_]*\.?[\d_]*|\.\d+)(?:[eE][-+]?\d+)?"
_ASSIGNED = r"""\b{}\b["']?(?:,\s*type=\w+,\s*default)?\s*[:=]\s*({})"""


class Verdict(NamedTuple):
    """What a source says of a row."""

    word: str
    found: tuple[float | None, ...] = ()
    """A number for each symbol; None where the symbol was not found."""


def judge(row: Row, clones: Path) -> Verdict:
    """Return whether a row is what its source says.

    ``kept`` are numbers that stand there, while ours are others.
    """
    if not isinstance(row.source, Source):
        return Verdict(PAPER if row.source else OURS)
    text = read(row.source, clones)
    if text is None:
        return Verdict(NO_CLONE)
    if not row.numbers:
        return Verdict(AGREES if all(symbol in text for symbol in row.symbols) else DIFFERS)
    found = tuple(find(symbol, text) for symbol in row.symbols)
    if found != tuple(float(number) for number in row.numbers):
        return Verdict(DIFFERS, found)
    return Verdict(KEPT if row.reason else AGREES, found)


@cache
def read(source: Source, clones: Path) -> str | None:
    """Return the text of a file at its commit, or None where the clone lacks it."""
    folder = clones / source.repository
    if not folder.is_dir():
        return None
    command = ["git", "-C", str(folder), "show", f"{source.commit}:{source.path}"]
    done = subprocess.run(command, capture_output=True)
    return done.stdout.decode(errors="replace") if done.returncode == 0 else None


def find(symbol: str, text: str) -> float | None:
    """Return the number that a symbol finds in a text; see :class:`.rows.Said`."""
    if "(" in symbol:
        match = re.search(symbol, text)
        return None if match is None else float(match[1].replace("_", ""))
    found = re.findall(_ASSIGNED.format(re.escape(symbol), _NUMBER), text)
    return float(found[-1].replace("_", "")) if found else None
