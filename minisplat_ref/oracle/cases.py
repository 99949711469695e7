"""Reports of checks: named cases that passed or failed, each with its figures; as a table and as JSON."""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.interface.reporting import machine, markdown_table
from minisplat_ref.io.atomic import replacing

Figure = float | int | str | None


class Case(NamedTuple):
    """One thing that was checked."""

    name: str
    """Unique in its report."""
    passed: bool
    """Whether the result is correct."""
    figures: dict[str, Figure]
    """Measured values by the heading of their column."""
    note: str = ""
    """The reason of a failure, or another note for the reader; one line."""


class Report(NamedTuple):
    """The cases of one command."""

    title: str
    """The subject of the check, one line."""
    cases: tuple[Case, ...]
    """In the order in which they are read."""
    settings: dict[str, Any]
    """The conditions on which the figures depend."""

    @property
    def n_failed(self) -> int:
        """Number of cases that did not pass."""
        return sum(not case.passed for case in self.cases)


def as_table(cases: Sequence[Case]) -> tuple[list[str], list[list[str]]]:
    """Return heading and rows: name, verdict, figures and, where some case has one, a note."""
    names = list(dict.fromkeys(key for case in cases for key in case.figures))
    has_notes = any(case.note for case in cases)
    rows = []
    for case in cases:
        cells = [_cell(case.figures.get(name)) for name in names]
        rows.append([case.name, "passed" if case.passed else "FAILED", *cells, *([case.note] if has_notes else [])])
    return ["case", "verdict", *names, *(["note"] if has_notes else [])], rows


def as_markdown(report: Report) -> str:
    """Return the cases as an aligned table; see :func:`as_table`."""
    return markdown_table(*as_table(report.cases))


def by_kind(cases: Iterable[Case]) -> list[list[Case]]:
    """Return the cases that have the same figures together, in the order of the first of each kind."""
    kinds: dict[tuple[str, ...], list[Case]] = {}
    for case in cases:
        kinds.setdefault(tuple(case.figures), []).append(case)
    return list(kinds.values())


def save_json(report: Report, path: str | Path) -> None:
    """Write the report, completely or not at all.

    Parameters
    ----------
    report : Report
        A figure that is not finite becomes a string, since JSON has no such numbers.
    path : str or Path
        Its folder must exist.

    Raises
    ------
    InputError
        If the folder does not exist.
    """
    cases = [
        {"name": case.name, "passed": case.passed, **{k: _plain(v) for k, v in case.figures.items()}, "note": case.note}
        for case in report.cases
    ]
    settings = {**report.settings, **machine()}
    with replacing(path) as temporary:
        text = json.dumps({"title": report.title, "settings": settings, "cases": cases}, indent=1, allow_nan=False)
        temporary.write_text(text + "\n", encoding="utf-8")


def verdict(reports: Sequence[Report]) -> str:
    """Return the closing line: the number of cases that passed."""
    n, n_failed = sum(len(report.cases) for report in reports), sum(report.n_failed for report in reports)
    return f"all {n} cases passed" if n_failed == 0 else f"{n_failed} of {n} cases failed"


def _cell(value: Figure) -> str:
    if value is None:
        return ""
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _plain(value: Figure) -> Figure:
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else str(float(value))
    return int(value) if isinstance(value, np.integer) else value
