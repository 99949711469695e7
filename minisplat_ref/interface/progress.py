"""The progress of a long step: a bar in a terminal, and where stderr is a log, a line now and then.

Nothing is shown of a step that ends within SILENT_SECONDS, and nothing is left of a bar when its step has ended. A log,
in which each redraw of a bar would stay, gets a line only every LOG_SECONDS. The first one comes as soon as the speed
is known, if the step will take longer than that, so that its time is told before it is spent.
"""

import sys
import time
from collections.abc import Iterable, Iterator, Sized
from typing import Any, Protocol, Self, TypeVar, cast

from minisplat_ref.interface.remaining import Speed, format_interval

Item = TypeVar("Item")

SILENT_SECONDS = 1.0  # in a terminal, before a step shows a bar
LOG_SECONDS = 30.0  # in a log, before the first line and between two


class Bar(Protocol):
    """The methods of a bar that a step calls."""

    def update(self, n: float = 1, /) -> Any:
        """Count ``n`` things as done."""

    def set_description(self, desc: str) -> None:
        """Set the description of the current work."""

    def __enter__(self) -> Self:
        """Return the bar."""

    def __exit__(self, *error: object) -> Any:
        """Remove the bar."""


class Lines:
    """A file for a bar of tqdm where stderr is a log: each state that it shows becomes a line."""

    def write(self, text: str) -> None:
        """Write a line without characters that move a cursor."""
        if shown := text.strip():
            print(f"minisplat-ref: {shown}", file=sys.stderr)

    def flush(self) -> None:
        """Show the lines now."""
        sys.stderr.flush()


class _Log:
    """The same in lines; all that it writes ends with a line break."""

    def __init__(self, description: str, unit: str, total: float | None, is_bytes: bool) -> None:
        self._description, self._unit, self._total, self._is_bytes = description, unit, total, is_bytes
        self._n: float = 0
        self._start = self._last = time.monotonic()
        self._is_silent, self._speed = True, Speed(time.monotonic)

    def update(self, n: float = 1) -> None:
        """Count, and write a line if the last one is old enough, or the rest will be long."""
        self._n += n
        self._speed.count(n)
        now = time.monotonic()
        rest = None if self._total is None else self._speed.seconds_of(self._total - self._n)
        is_long = self._is_silent and rest is not None and rest >= LOG_SECONDS
        if is_long or now - self._last >= LOG_SECONDS:
            self._is_silent = False
            self._last = now
            print(f"minisplat-ref: {self._line(now - self._start)}", file=sys.stderr, flush=True)

    def set_description(self, desc: str) -> None:
        """Set the description of the current work."""
        self._description = desc

    def _line(self, seconds: float) -> str:
        """Return the work done, the time that it took, and the time that the rest takes at that rate."""
        total = "" if self._total is None else f" of {self._number(self._total)}"
        line = f"{self._description}: {self._number(self._n)}{total}{self._unit}, {format_interval(seconds)} gone"
        if self._total is None or not 0 < self._n < self._total:
            return line
        return f"{line}, about {format_interval(seconds * (self._total / self._n - 1))} to go"

    def _number(self, n: float) -> str:
        return f"{n / 1e6:.1f}" if self._is_bytes else f"{n:,.0f}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        pass


def say(text: str) -> None:
    """Write a line for a person, above the bar where a terminal shows one."""
    line = f"minisplat-ref: {text}"
    if not sys.stderr.isatty():
        print(line, file=sys.stderr, flush=True)
        return
    from tqdm import tqdm

    tqdm.write(line, file=sys.stderr)


def progress_bar(description: str, unit: str = "", total: float | None = None, *, delay: float = SILENT_SECONDS) -> Bar:
    """Return the bar of a step that reports its progress itself; a context manager.

    Parameters
    ----------
    description : str
        What is being done.
    unit : str
        What is counted, in the plural; "MB" means that bytes are.
    total : float, optional
        How many there are, where it is known.
    delay : float
        Seconds before a terminal shows it.
    """
    is_bytes = unit == "MB"
    unit = f" {unit}" if unit else ""
    if not sys.stderr.isatty():
        return _Log(description, unit, total, is_bytes)
    from tqdm import tqdm

    shown = "B" if is_bytes else unit or "it"
    bar: Any = tqdm(
        desc=description, total=total, unit=shown, unit_scale=is_bytes, delay=delay, leave=False, dynamic_ncols=True
    )
    return cast(Bar, bar)


def with_progress(
    items: Iterable[Item],
    description: str,
    unit: str = "",
    *,
    total: float | None = None,
    delay: float = SILENT_SECONDS,
) -> Iterator[Item]:
    """Yield items, with the bar of :func:`progress_bar`, which counts those whose work is done.

    Parameters
    ----------
    items : iterable
        What is worked on.
    description, unit, total, delay
        As for :func:`progress_bar`; the length of ``items`` is the default of ``total``.
    """
    if total is None and isinstance(items, Sized):
        total = len(items)
    with progress_bar(description, unit, total, delay=delay) as bar:
        for item in items:
            yield item
            bar.update()
