"""Ctrl-C and SIGTERM as a wish to stop."""

import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from types import FrameType
from typing import Any

from rich.console import Console


class Interruption:
    """Turns the first Ctrl-C or SIGTERM into a wish to stop; Ctrl-C after it is real.

    SIGTERM after it says nothing new: schedulers tell a process, its group, and its parent.
    """

    received: signal.Signals | None = None
    """What the wish came as."""

    def __init__(self, console: Console, words: str, obey: Callable[[], object] = lambda: None):
        """On a wish, `words` say what happens now, and `obey` is called."""
        self._console, self._words, self._obey = console, words, obey
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> "Interruption":
        if threading.current_thread() is threading.main_thread():  # the only one that may
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._handle)
        return self

    def _handle(self, number: int, frame: FrameType | None) -> None:
        del frame
        if self.received:
            if number == signal.SIGINT:
                self._restore()
                signal.raise_signal(number)
            return
        self.received = signal.Signals(number)
        again = "Ctrl-C again" if number == signal.SIGINT else "Ctrl-C or SIGKILL"
        with suppress(OSError):  # a terminal that is gone
            self._console.print(f"{self._words}; {again} stops at once")
        self._obey()

    def _restore(self) -> None:
        while self._previous:
            signal.signal(*self._previous.popitem())

    def __exit__(self, *_: object) -> None:
        self._restore()
