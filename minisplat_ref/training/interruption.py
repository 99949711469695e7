"""Defer Ctrl-C while the state changes, so that half an Adam step is never saved.

SIGTERM, which ``docker stop`` and batch systems send before they kill, counts as Ctrl-C where the program asks for it
(:func:`terminated_like_interrupted`).
"""

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from types import FrameType
from typing import Any, Self

IMPATIENCE = 1.0  # seconds; a second Ctrl-C that comes sooner may be the first one again, relayed by a parent


class Interruptions(AbstractContextManager["Interruptions"]):
    """Raises KeyboardInterrupt at once, but between :meth:`defer` and :meth:`release` only at the release.

    A second Ctrl-C in between raises it at once, and may leave the work of that section half done.
    """

    def __init__(self) -> None:
        self._is_deferring = False
        self._pressed_at: float | None = None
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Self:
        """Install the signal handlers, in the main thread: Python delivers signals to no other."""
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                if number == signal.SIGINT or callable(signal.getsignal(number)):
                    self._previous[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Restore the handlers; raise an interruption that is still deferred, unless another error is in flight."""
        for number, handler in self._previous.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)  # None: not installed from Python
        if kind is None and self._pressed_at is not None:
            raise KeyboardInterrupt

    def defer(self) -> None:
        """Defer interruptions from now on."""
        self._is_deferring = True

    def release(self) -> None:
        """Stop deferring; raise now if an interruption came in the meantime."""
        self._is_deferring = False
        if self._pressed_at is not None:
            raise KeyboardInterrupt

    def _note(self, number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        is_impatient = self._pressed_at is not None and now - self._pressed_at > IMPATIENCE
        self._pressed_at = now if self._pressed_at is None else self._pressed_at
        if not self._is_deferring or is_impatient:
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
