"""Ctrl-C and SIGTERM as a wish to stop."""

import signal
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from types import FrameType
from typing import Any

from rich.console import Console

GRACE = 2.0
"""Seconds after a SIGTERM in which others say the same: schedulers tell a process and its group."""


class Interruption:
    """Turns the first Ctrl-C or SIGTERM into a wish to stop; the second is real."""

    received: signal.Signals | None = None
    """What the wish came as."""

    def __init__(self, console: Console, words: str, obey: Callable[[], object] = lambda: None):
        """On a wish, `words` say what happens now, and `obey` is called."""
        self._console, self._words, self._obey = console, words, obey
        self._previous: dict[signal.Signals, Any] = {}
        self._when = 0.0

    def __enter__(self) -> "Interruption":
        if threading.current_thread() is threading.main_thread():  # the only one that may
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._handle)
        return self

    def _handle(self, number: int, frame: FrameType | None) -> None:
        del frame
        if self.received:
            if number == signal.SIGINT or time.monotonic() > self._when + GRACE:
                self._restore()
                signal.raise_signal(number)
            return
        self.received, self._when = signal.Signals(number), time.monotonic()
        again = "Ctrl-C" if number == signal.SIGINT else "SIGTERM"
        with suppress(OSError):  # a terminal that is gone
            self._console.print(f"{self._words}; {again} again stops at once")
        self._obey()

    def _restore(self) -> None:
        while self._previous:
            signal.signal(*self._previous.popitem())

    def __exit__(self, *_: object) -> None:
        self._restore()
