"""The events of a training: ``events.jsonl`` records which mechanisms of the recipe fired, and when.

A mechanism is an action that the recipe has at some iterations, not at every one: densification, pruning, a reset. In
short or small runs some never act. A run is no evidence about a mechanism that never acted in it, so such mechanisms
are named.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from minisplat_ref.app.runs.progress import append_log, read_log
from minisplat_ref.errors import InputError
from minisplat_ref.training.schedule import DatedEvent, Recipe, SmallerViews, action_name
from minisplat_ref.training.state import FiredEvent

N_NOTES = 3  # of a mechanism that a line names: the first ones and the last

Records = Sequence[Mapping[str, Any]]
"""Of ``events.jsonl``: step, and the fields of a :class:`FiredEvent`."""


class Mechanism(NamedTuple):
    """The effect of one action in a run, all its events together."""

    action: str
    times: int
    """Number of times that it has acted."""
    published: int
    """Number of times that it acts in the recipe as published."""
    first: int
    """Iteration at which it acted first."""
    last: int
    """Iteration at which it acted last."""
    added: int
    """Gaussians by which their number rose, over those times at which it rose."""
    removed: int
    """Gaussians by which it fell, over the others."""
    n_before: int
    """Gaussians before the first time."""
    n_after: int
    """Gaussians after the last."""
    seconds: float
    """Taken by all times together."""
    notes: Mapping[str, int]
    """Notes of the action, and the number of times of each."""


def append(path: Path, step: int, fired: Iterable[FiredEvent]) -> None:
    """Add a record for each event of an iteration."""
    for event in fired:
        append_log(path, {"step": step, **event._asdict()})


def count_published_times(recipe: Recipe) -> dict[str, int]:
    """Return how many times each mechanism of a recipe acts, by the name of its action; smaller views count once."""
    times: Counter[str] = Counter()
    for event in recipe.events:
        n_steps = sum(event.is_due(step) for step in range(1, recipe.iterations + 1))
        if isinstance(event, DatedEvent):
            times[action_name(event)] += n_steps
        elif isinstance(event, SmallerViews) and n_steps > 0:
            times[action_name(event)] += 1
    return dict(times)


def read_mechanisms(path: Path, published: Mapping[str, int]) -> list[Mechanism]:
    """Return the actions of a run's mechanisms; see :func:`mechanisms`.

    Raises
    ------
    InputError
        There is no record of it, or it is damaged.
    """
    if not path.exists():
        raise InputError(f"{path}, which says what fired in the run, is missing: train again")
    try:
        return mechanisms(read_log(path), published)
    except (KeyError, TypeError) as error:
        raise InputError(f"{path} is not the record of what fired in a training: remove the run") from error


def mechanisms(records: Records, published: Mapping[str, int]) -> list[Mechanism]:
    """Return the effect of each action, in the order in which they first acted.

    Parameters
    ----------
    records : sequence of mappings
        Of one run, in their order.
    published : mapping
        See :func:`count_published_times`.
    """
    by_action: dict[str, list[Mapping[str, Any]]] = {}
    for record in records:
        by_action.setdefault(record["action"], []).append(record)
    found = []
    for action, own in by_action.items():
        changes = [record["n_after"] - record["n_before"] for record in own]
        found.append(
            Mechanism(
                action,
                len(own),
                published.get(action, 0),
                first=own[0]["step"],
                last=own[-1]["step"],
                added=sum(max(change, 0) for change in changes),
                removed=sum(max(-change, 0) for change in changes),
                n_before=own[0]["n_before"],
                n_after=own[-1]["n_after"],
                seconds=sum(record["seconds"] for record in own),
                notes=Counter(record["note"] for record in own if record["note"]),
            )
        )
    return found


def never_fired(found: Iterable[Mechanism], published: Iterable[str]) -> list[str]:
    """Return the mechanisms of the published recipe that were off in the whole run."""
    fired = {mechanism.action for mechanism in found}
    return [action for action in published if action not in fired]


def describe(mechanism: Mechanism) -> str:
    """Return a line about the actions of a mechanism; of many notes, the first and the last."""
    m = mechanism
    times, steps = "once", f"at {m.first:,}"
    change = f"{m.n_before:,} -> {m.n_after:,} Gaussians"
    if m.times > 1:
        times, steps = f"{m.times} times", f"from {m.first:,} to {m.last:,}"
        change = f"+{m.added:,} -{m.removed:,} Gaussians"
    notes = describe_notes(m.notes)
    if len(notes) > N_NOTES:
        notes = [*notes[: N_NOTES - 1], "...", notes[-1]]
    return "; ".join([f"{times} (published {m.published}), {steps}", change, *notes])


def describe_notes(notes: Mapping[str, int]) -> list[str]:
    """Return the notes, each with the number of times where it is not one."""
    return [note if n == 1 else f"{note} ({n} times)" for note, n in notes.items()]
