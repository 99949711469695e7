"""The mechanisms of a recipe that acted in its runs, and those that never did."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from minisplat_ref.app.runs.events import Mechanism, describe_notes, never_fired

HEADING = ("mechanism", "times", "published", "first step", "last step", "added", "removed")


class Fired(NamedTuple):
    """The actions of a recipe, in all its runs."""

    recipe: str
    iterations: int
    """Of each run."""
    published_iterations: int
    """Of the recipe as published."""
    published: dict[str, int]
    """Number of times that each mechanism acts in the recipe as published."""
    runs: Sequence[Sequence[Mechanism]]
    """Per run, the actions of its mechanisms."""

    @property
    def never(self) -> list[str]:
        """Mechanisms of the published recipe that were off in every run."""
        return never_fired((mechanism for run in self.runs for mechanism in run), self.published)


def rows(fired: Fired) -> list[list[str]]:
    """Return the table under HEADING: a row per mechanism that has acted, the range where runs differ."""
    table = []
    for action in dict.fromkeys(mechanism.action for run in fired.runs for mechanism in run):
        own = [mechanism for run in fired.runs for mechanism in run if mechanism.action == action]
        times = [sum(mechanism.times for mechanism in run if mechanism.action == action) for run in fired.runs]
        table.append(
            [
                action,
                _range(times),
                f"{fired.published.get(action, 0):,}",
                _range(mechanism.first for mechanism in own),
                _range(mechanism.last for mechanism in own),
                _range(mechanism.added for mechanism in own),
                _range(mechanism.removed for mechanism in own),
            ]
        )
    return table


def remarks(fired: Fired) -> list[str]:
    """Return what the table lacks: notes of the mechanisms, and those that never acted."""
    return [f"{name}: {note}" for name, notes in _notes(fired).items() for note in notes]


def remarks_by_mechanism(fired: Fired) -> dict[str, str]:
    """Return the same with one line for each mechanism."""
    return {name: "; ".join(notes) for name, notes in _notes(fired).items()}


def _notes(fired: Fired) -> dict[str, list[str]]:
    notes: dict[str, dict[str, None]] = {}
    for mechanism in (mechanism for run in fired.runs for mechanism in run):
        if mechanism.notes:
            notes.setdefault(mechanism.action, {}).update(dict.fromkeys(describe_notes(mechanism.notes)))
    return {**{name: list(texts) for name, texts in notes.items()}, **_never(fired)}


def _never(fired: Fired) -> dict[str, list[str]]:
    return {"never": [", ".join(fired.never)]} if fired.never else {}


def _range(values: Iterable[int]) -> str:
    """Return the value on which the runs agree, or the least and the largest."""
    values = list(values)
    low, high = min(values), max(values)
    return f"{low:,}" if low == high else f"{low:,} to {high:,}"
