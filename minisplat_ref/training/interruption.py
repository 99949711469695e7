"""Ctrl-C, and when it may come: half an Adam step must not be saved.

SIGTERM, which ``docker stop`` and batch systems send before they kill, counts as Ctrl-C where the program has said so
(:func:`terminated_like_interrupted`).
"""

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from types import FrameType
from typing import Any, Self

IMPATIENCE = 1.0  # seconds; a second Ctrl-C after them is meant, one before may be the same, sent along by a parent


class Interruptions(AbstractContextManager["Interruptions"]):
    """Raises KeyboardInterrupt at once, but between :meth:`hold` and :meth:`release` only at the release.

    Who presses again while it is held back gets it at once: what was held together is then half done.
    """

    def __init__(self) -> None:
        self._is_held = False
        self._pressed_at: float | None = None
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Self:
        """Take the signals over, in the main thread: Python delivers none to others."""
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                if number == signal.SIGINT or callable(signal.getsignal(number)):
                    self._previous[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Give the signals back; raise what was held back and not released, unless another error is on its way."""
        for number, handler in self._previous.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)  # None: not installed from Python
        if kind is None and self._pressed_at is not None:
            raise KeyboardInterrupt

    def hold(self) -> None:
        """Hold interruptions back from now on."""
        self._is_held = True

    def release(self) -> None:
        """Let them through again, beginning with one that came meanwhile."""
        self._is_held = False
        if self._pressed_at is not None:
            raise KeyboardInterrupt

    def _note(self, number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        is_impatient = self._pressed_at is not None and now - self._pressed_at > IMPATIENCE
        self._pressed_at = now if self._pressed_at is None else self._pressed_at
        if not self._is_held or is_impatient:
            raise KeyboardInterrupt


@contextmanager
def terminated_like_interrupted() -> Iterator[None]:
    """Make SIGTERM do what Ctrl-C does, in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)
