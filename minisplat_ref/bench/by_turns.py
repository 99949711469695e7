"""Times of tasks that take turns, again and again through a whole measurement.

A shared machine is disturbed for seconds at a time: what else it does makes a thread slower, and lets a second one
bring less. Tasks timed one after the other would each meet another machine. So those that are to be compared
alternate, and all have their turns in every round. The least time is that of a free machine, the median what to expect
of this one.
"""

import statistics
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from minisplat_ref.oracle.cases import Case

ROUNDS = 10

Task = Callable[[], object]


class Times(NamedTuple):
    """Of one task, in seconds."""

    least: float
    median: float


class Contest(NamedTuple):
    """Tasks that are compared with each other."""

    tasks: tuple[Task, ...]
    judge: Callable[[Sequence[Times]], list[Case]]
    """Makes the cases of the times, one of each task."""


def seconds_of(task: Task) -> float:
    """Return how long a task takes, once."""
    start = time.perf_counter()
    task()
    return time.perf_counter() - start


def times_by_turns(groups: Sequence[Sequence[Task]], rounds: int, repeats: int) -> list[list[Times]]:
    """Time tasks; those of a group alternate.

    Parameters
    ----------
    groups : sequence of sequences of callables
    rounds, repeats : int
        In each round, each group has ``repeats`` turns. A turn before the first compiles and is not timed.

    Returns
    -------
    list of list of Times
        One of each task.
    """
    seconds: list[list[list[float]]] = [[[] for _ in tasks] for tasks in groups]
    for task in (task for tasks in groups for task in tasks):
        task()
    for _ in range(rounds):
        for tasks, of_group in zip(groups, seconds, strict=True):
            for _ in range(repeats):
                for task, own in zip(tasks, of_group, strict=True):
                    own.append(seconds_of(task))
    return [[Times(min(own), statistics.median(own)) for own in of_group] for of_group in seconds]


def hold(contests: Sequence[Contest], repeats: int) -> list[Case]:
    """Let all tasks take turns for ``ROUNDS`` rounds; return the cases of all contests, in their order."""
    times = times_by_turns([contest.tasks for contest in contests], ROUNDS, repeats)
    return [case for contest, own in zip(contests, times, strict=True) for case in contest.judge(own)]
