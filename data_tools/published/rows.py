"""Rows of the tables: a value of ours, where it is stated, and the numbers that stand there.

A row is named as ``tests/extensions/test_published.py`` names facts of a recipe: a field, ``rate.NAME``, the name of an
event with its iterations, of a loss term with its weight and its first iteration, or ``NAME.SETTING``.
"""

from typing import Any, NamedTuple


class Source(NamedTuple):
    """A file of released code."""

    repository: str
    """OWNER/NAME on GitHub."""
    commit: str
    """40 hexadecimal digits."""
    path: str

    def __str__(self) -> str:
        """Return repository, short commit and path."""
        return f"{self.repository}@{self.commit[:7]} {self.path}"


class Said(NamedTuple):
    """A value of ours, and what a file says of it."""

    value: Any
    symbols: tuple[str, ...]
    """What finds each number: a name that a number is assigned to, the last time if there are several, or a regular
    expression with one group, the first time. Without numbers, texts that the file has."""
    numbers: tuple[float, ...]


class Row(NamedTuple):
    """A value of ours, and where it is stated."""

    value: Any
    source: Source | str
    """Released code, the place in a paper, or "" for what is ours alone."""
    symbols: tuple[str, ...] = ()
    numbers: tuple[float, ...] = ()
    reason: str = ""
    """Why ours is another value, or the only one."""


Table = dict[str, Row]


def says(value: Any, *symbols: str, numbers: tuple[float, ...] | None = None) -> Said:
    """Return a value that a file states by symbols; the numbers are those of the value unless they are given."""
    if numbers is None:
        numbers = tuple(value) if isinstance(value, tuple) else (value,)
    return Said(value, symbols, numbers)


def has(value: Any, *texts: str) -> Said:
    """Return a value that a file states without a number, by texts that it has."""
    return Said(value, texts, ())


def code(source: Source, **facts: Said) -> Table:
    """Return rows of a file; ``__`` in a name stands for the point between an action and its setting."""
    return {_name(key): Row(said.value, source, said.symbols, said.numbers) for key, said in facts.items()}


def kept(reason: str, source: Source, **facts: Said) -> Table:
    """Return rows of a file whose numbers are not ours, with the reason."""
    return {name: row._replace(reason=reason) for name, row in code(source, **facts).items()}


def paper(place: str, **facts: Any) -> Table:
    """Return rows of a paper, by section, equation, table or figure."""
    return {_name(key): Row(value, place) for key, value in facts.items()}


def ours(reason: str, **facts: Any) -> Table:
    """Return rows that no source has."""
    return {_name(key): Row(value, "", reason=reason) for key, value in facts.items()}


def select(table: Table, *beginnings: str) -> Table:
    """Return the rows of a table whose names begin so."""
    return {name: row for name, row in table.items() if name.startswith(beginnings)}


def without(table: Table, *beginnings: str) -> Table:
    """Return the other rows."""
    return {name: row for name, row in table.items() if not name.startswith(beginnings)}


def _name(key: str) -> str:
    return key.replace("__", ".")


# --- values with dates ---


def steps(first: int, last: int, period: int = 1, *, but: tuple[int, ...] = ()) -> list[int]:
    """Return iterations from the first to the last."""
    return [step for step in range(first, last + 1, period) if step not in but]


def between(start: int, stop: int, *symbols: str) -> Said:
    """Return every iteration after ``start`` and before ``stop``, of which a file states the latter."""
    return Said([steps(start + 1, stop - 1)], symbols, (stop,))


def every(start: int, stop: int, period: int, *symbols: str, but: tuple[int, ...] = ()) -> Said:
    """Return the multiples of a period after ``start`` and before ``stop``; a file states all three, in this order."""
    found = [step for step in range(period, stop, period) if step > start and step not in but]
    return Said([found], symbols, (start, stop, period))


def once(step: int, *symbols: str) -> Said:
    """Return one iteration, which a file states."""
    return Said([[step]], symbols, (step,))


def after(weight: float, start: int, *symbols: str) -> Said:
    """Return a loss term: its weight, and its first iteration, the one after ``start``; a file states both."""
    return Said((weight, start + 1), symbols, (weight, start))
