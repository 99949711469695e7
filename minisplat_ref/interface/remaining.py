"""The time that is left, told before it is spent: by the work that is planned and the speed that was measured.

An estimate has two ends where the plan is open: what has to be done in any case, and the most that may have to be.
"""

import time
from collections.abc import Callable

SECONDS_MIN = 2.0  # of measured work, before its speed says anything


class Speed:
    """The mean speed of work so far, without the first piece, in which much happens only once.

    Parameters
    ----------
    clock : callable
        Returns seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._n = clock, 0.0
        self._start: float | None = None

    def count(self, n: float = 1.0) -> None:
        """Count work as done."""
        if self._start is None:
            self._start = self._clock()
        else:
            self._n += n

    def seconds_of(self, n: float) -> float | None:
        """Return the seconds that further work takes; None while too little of it has been measured."""
        seconds = 0.0 if self._start is None else self._clock() - self._start
        return seconds / self._n * n if self._n > 0 and seconds >= SECONDS_MIN else None


def describe_rest(least: float, most: float | None) -> str:
    """Return in words how long the rest takes.

    Parameters
    ----------
    least : float
        Seconds that it takes at least.
    most : float or None
        Seconds that it takes at most; None where that is open.
    """
    if most is None:
        return f"at least {format_interval(least)} to go"
    low, high = format_interval(least), format_interval(most)
    return f"about {high} to go" if low == high else f"{low} to {high} to go"


def format_interval(seconds: float) -> str:
    """Return minutes and seconds, with hours where there are some."""
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes:02d}:{rest:02d}"
