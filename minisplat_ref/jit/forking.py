"""Processes that were forked after kernels had run in parallel: refused, since GNU OpenMP does not survive a fork.

Its threads do not exist in the child. Numba then ends the child as soon as a parallel kernel begins, and a pool of
``multiprocessing``, whose default was to fork on Linux before Python 3.14, starts the next one, for ever.
"""

import os
import sys

import numba

from minisplat_ref.errors import InputError

_UNSAFE_LAYER = "omp"
_is_forked = False  # after GNU OpenMP had started its threads


def _note_fork() -> None:
    """Remember, in a process that was just forked, whether the parent's threads are missing."""
    global _is_forked
    try:
        _is_forked = _is_forked or numba.threading_layer() == _UNSAFE_LAYER  # type: ignore[attr-defined]
    except ValueError:  # no kernel has run in parallel yet
        pass


if sys.platform.startswith("linux"):
    os.register_at_fork(after_in_child=_note_fork)


def check_fork() -> None:
    """Refuse to run parallel kernels in a process that was forked after such kernels had run.

    Raises
    ------
    InputError
        Says how to start processes instead.
    """
    if _is_forked:
        raise InputError(
            "this process was forked after kernels had run in parallel, and OpenMP's threads do not exist in it: start"
            " processes by multiprocessing.get_context('spawn'), or set NUMBA_THREADING_LAYER=workqueue"
        )
