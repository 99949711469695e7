"""Contests: tasks that are timed alternately and judged together."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from minisplat_ref.bench.interleaving import Task, Times, time_interleaved
from minisplat_ref.oracle.cases import Case, Figure

ROUNDS = 10


class Contest(NamedTuple):
    """Tasks that are compared with each other."""

    tasks: tuple[Task, ...]
    judge: Callable[[Sequence[Times]], list[Case]]
    """Makes the cases from the times, one for each task."""


def in_ms(times: Times) -> dict[str, Figure]:
    """Return both times as figures."""
    return {"ms": 1e3 * times.minimum, "median ms": 1e3 * times.median}


def time_contests(contests: Sequence[Contest], repeats: int) -> list[Case]:
    """Time all tasks in ``ROUNDS`` rounds; return the cases of all contests, in their order."""
    times = time_interleaved([contest.tasks for contest in contests], ROUNDS, repeats)
    return [case for contest, own in zip(contests, times, strict=True) for case in contest.judge(own)]
