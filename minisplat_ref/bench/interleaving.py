"""Interleaved timing: tasks that are compared run alternately throughout a measurement.

A shared machine is disturbed for seconds at a time: other work slows a thread down, and makes a second thread gain
less. Tasks timed one after the other would each run under other conditions. So tasks that are compared alternate, and
all run in every round. The minimum is the time of an idle machine, the median the time of this machine as it is used.
"""

import statistics
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

Task = Callable[[], object]


class Times(NamedTuple):
    """Times of one task, in seconds."""

    minimum: float
    median: float


def measure_seconds(task: Task) -> float:
    """Run a task once and return the seconds that it took."""
    start = time.perf_counter()
    task()
    return time.perf_counter() - start


def time_interleaved(groups: Sequence[Sequence[Task]], rounds: int, repeats: int) -> list[list[Times]]:
    """Time tasks; those in a group alternate.

    Parameters
    ----------
    groups : sequence of sequences of callables
    rounds, repeats : int
        Each group runs ``repeats`` times in each round. A run before the first compiles and is not timed.

    Returns
    -------
    list of list of Times
        One for each task.
    """
    seconds: list[list[list[float]]] = [[[] for _ in tasks] for tasks in groups]
    for task in (task for tasks in groups for task in tasks):
        task()
    for _ in range(rounds):
        for tasks, of_group in zip(groups, seconds, strict=True):
            for _ in range(repeats):
                for task, own in zip(tasks, of_group, strict=True):
                    own.append(measure_seconds(task))
    return [[Times(min(own), statistics.median(own)) for own in of_group] for of_group in seconds]
