"""Compile kernels ahead of their use, in several processes at once.

A process compiles one function at a time, so that whatever runs first would wait for one kernel after the other. Here
several processes compile, and whatever runs later finds the kernels on disk. The modules that have kernels define the
calls: :mod:`minisplat_ref.rendering.warm_up` for the stages, :mod:`minisplat_ref.extensions.warm_up` for all.
"""

import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import active_children, get_context, parent_process
from typing import NamedTuple

import numpy as np

Dtype = type[np.floating]


class Task(NamedTuple):
    """The calls of one process that compile kernels."""

    name: str
    """For people."""
    call: Callable[[str, Dtype], str]
    """Gets the name and the dtype; returns why it could not be done, in one line, or an empty string. A function of a
    module, since it crosses to another process."""


class Compiled(NamedTuple):
    """One task that has been carried out."""

    name: str
    seconds: float
    """Time that it took; little where all was on disk already."""
    problem: str = ""
    """The result of :attr:`Task.call`."""


def compile_all(
    batches: Sequence[Sequence[Task]], dtype: Dtype, n_processes: int | None = None
) -> Generator[Compiled, None, None]:
    """Carry out tasks in other processes and yield each when it is done; closing the generator ends the processes.

    Each of those processes imports the program's main module: a script must call this under
    ``if __name__ == "__main__"``.

    Parameters
    ----------
    batches : sequence of sequence of Task
        A batch begins when the one before has ended: its tasks find the kernels of the earlier ones on disk.
    dtype : type
        ``numpy.float32``, or ``numpy.float64``.
    n_processes : int, optional
        One per processor by default; each takes some 300 MB.
    """
    n_processes = min(n_processes or os.cpu_count() or 1, max(map(len, batches)))
    # Fresh interpreters, because a fork of a process in which kernels have run cannot run any.
    context = get_context("spawn")
    pool, others = ProcessPoolExecutor(n_processes, context, initializer=_prepare_process), active_children()
    try:
        for batch in batches:
            futures = [pool.submit(_carry_out, task, dtype) for task in batch]
            for future in as_completed(futures):
                yield future.result()
    except BaseException:  # nothing waits for the rest after an error, or after Ctrl-C, which the processes ignore
        for process in active_children():
            if process not in others:
                process.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _carry_out(task: Task, dtype: Dtype) -> Compiled:
    start = time.perf_counter()
    problem = task.call(task.name, dtype)
    return Compiled(task.name, time.perf_counter() - start, problem)


def _prepare_process() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when the parent is killed; it would wait for work for ever."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
