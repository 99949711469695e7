"""The page of a check: the report of the oracle or of a measurement, as ``report.html``."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from minisplat_ref import __version__
from minisplat_ref.app.reports.page import cards, page, section, table
from minisplat_ref.interface.reporting import machine
from minisplat_ref.io.atomic import replacing
from minisplat_ref.oracle.cases import Case, Report, as_table, by_kind, verdict


def write_page(report: Report, path: Path, figures: Sequence[str] = (), *, is_by_kind: bool = False) -> None:
    """Write the page; it is there complete or not at all.

    Parameters
    ----------
    report : Report
    path : Path
        Its folder must exist.
    figures : sequence of str
        Parts of a page before the tables.
    is_by_kind : bool
        Whether cases with other figures have their own table; else there is one, in the order of the cases.

    Raises
    ------
    InputError
        If the folder does not exist.
    """
    text = report_html(report, figures, is_by_kind=is_by_kind)
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def report_html(report: Report, figures: Sequence[str] = (), *, is_by_kind: bool = False) -> str:
    """Return the page as text of one self-contained HTML file."""
    n, n_failed = len(report.cases), report.n_failed
    key_figures = [(f"{n - n_failed} of {n}", "cases passed"), (f"{n_failed}", "failed")]
    groups = by_kind(report.cases) if is_by_kind else [report.cases]
    failed = [[case for case in group if not case.passed] for group in groups]
    sections = [cards(key_figures), *figures]
    if n_failed:
        sections.append(section("What failed", *_tables(failed)))
    sections += [
        section("All cases", *_tables(groups)),
        section("What was run", table(_settings(report.settings))),
    ]
    title, _, rest = report.title.partition(": ")
    sentences = [f"{text[:1].upper()}{text[1:]}." for text in (rest, verdict([report])) if text]
    return page(title, " ".join(sentences), sections)


def _tables(groups: Iterable[Sequence[Case]]) -> list[str]:
    return [table(rows, heading) for heading, rows in map(as_table, filter(None, groups))]


def _settings(settings: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the entries of one line each; lists of records are in the JSON file."""
    simple = [
        (name.replace("_", " ").capitalize(), _spell(value))
        for name, value in settings.items()
        if value is not None and not _is_records(value)
    ]
    about = machine()
    on = [(name.replace("_", " ").capitalize(), f"{value}") for name, value in about.items()]
    return [*simple, *on, ("Program", f"minisplat_ref {__version__}")]


def _is_records(value: Any) -> bool:
    return isinstance(value, list | tuple) and any(isinstance(item, Mapping) for item in value)


def _spell(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {item}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value)) or "none"
    return {True: "yes", False: "no"}.get(value, str(value)) if isinstance(value, bool) else str(value)
