"""Tables of records: a row for each arm, or each combination of what arms are told apart by, over all seeds.

A record is what was measured with one arm and one seed. A column is its heading and what a cell shows of the records of
a row: :func:`spread`, :func:`mean` or :func:`first`. A measure is the name of an entry, or a function of the record; an
entry may also have the values of all seeds.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from data_tools.claims.kit.figures import group, with_deviation
from minisplat_ref.interface.reporting import markdown_table

Record = Mapping[str, Any]
Measure = str | Callable[[Any], Any]
Cell = Callable[[Sequence[Record]], str]
Columns = Sequence[tuple[str, Cell]]


def values_of(records: Iterable[Record], measure: Measure) -> list[float]:
    """Return what was measured, without what is not there or None."""
    found = [record.get(measure) if isinstance(measure, str) else measure(record) for record in records]
    return [value for each in found if each is not None for value in np.ravel(each).tolist()]


def spread(measure: Measure, digits: int, factor: float = 1.0) -> Cell:
    """Return a cell with mean and deviation, in units of 1 / ``factor``; ``-`` where nothing was measured."""

    def cell(records: Sequence[Record]) -> str:
        values = [factor * value for value in values_of(records, measure)]
        return with_deviation(values, digits) if values else "-"

    return cell


def mean(measure: Measure, digits: int = 0) -> Cell:
    """Return a cell with the mean alone; empty where nothing was measured."""

    def cell(records: Sequence[Record]) -> str:
        values = values_of(records, measure)
        return f"{np.mean(values):,.{digits}f}" if values else ""

    return cell


def first(measure: Measure, form: str = "") -> Cell:
    """Return a cell with what is the same for all records of a row."""
    return lambda records: format(records[0][measure] if isinstance(measure, str) else measure(records[0]), form)


def table(records: Iterable[Record], keys: Mapping[str, str], columns: Columns) -> str:
    """Return a table in Markdown.

    Parameters
    ----------
    records : iterable of dict
    keys : mapping
        Entries that tell rows apart, with their headings; they are the first columns.
    columns : sequence of (heading, cell)
    """
    rows = [
        [*(_name(own[0][key]) for key in keys), *(cell(own) for _, cell in columns)]
        for own in group(records, *keys).values()
    ]
    return markdown_table([*keys.values(), *(heading for heading, _ in columns)], rows)


def _name(value: Any) -> str:
    return f"{value:,}" if isinstance(value, int) else f"{value:g}" if isinstance(value, float) else str(value)
