"""The time that ``simplify`` will take, told before it is spent.

Nearly all of it is fine-tuning. Every size takes as many iterations of it, so the first ones show what the others will
take: as many sizes as the search still measures (:func:`.rate_distortion.count_sizes`), and the delivered model.
Smaller models are faster, so the estimate is rather too long.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

from minisplat_ref.interface.progress import say
from minisplat_ref.interface.remaining import Speed, describe_rest


class Sizes(NamedTuple):
    """The sizes that are yet to be measured, with the one that is next."""

    least: int
    most: int | None
    """None where the search is open."""


class SimplificationTime:
    """Counts iterations of fine-tuning, and tells how long the rest takes when the plan has changed.

    Parameters
    ----------
    n_each : int
        Iterations for each size.
    n_last : int
        Iterations of the model that is delivered.
    clock : callable
        Returns seconds.
    """

    def __init__(self, n_each: int, n_last: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._n_each, self._n_last, self._clock = n_each, n_last, clock
        self._speed: Speed | None = None
        self._planned, self._n_done, self._is_told = Sizes(0, 0), 0, True

    def plan(self, sizes: Sizes) -> None:
        """Take note of what is planned now, and tell it as soon as the speed is known, unless nothing is left."""
        self._planned, self._n_done, self._is_told = sizes, 0, sizes.most == 0
        if self._speed is None:
            self._speed = Speed(self._clock)
        self._tell()

    def count_iteration(self) -> None:
        """Count one iteration."""
        if self._speed is not None:
            self._speed.count()
            self._n_done += 1
            self._tell()

    def _tell(self) -> None:
        """Tell the plan once, if the speed is known."""
        if self._is_told or self._speed is None:
            return
        least, most = self._planned
        in_any_case = self._speed.seconds_of(least * self._n_each - self._n_done)
        if in_any_case is None:
            return
        open_end = None if most is None else self._speed.seconds_of(most * self._n_each + self._n_last - self._n_done)
        count = f"{least}" if least == most else f"{least} or more" if most is None else f"{least} to {most}"
        say(f"{count} {'size' if count == '1' else 'sizes'} to measure, {describe_rest(in_any_case, open_end)}")
        self._is_told = True
