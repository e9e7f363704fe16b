"""Running jobs to their ends: what is done is kept, what is broken goes on, what failed is said."""

import re
import signal
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

from rich.console import Console

from mabl.experiments.board import Board
from mabl.experiments.jobs import Job
from mabl.experiments.processes import Backend

POLL_EVERY = 0.5
"""Seconds between looks at what ended."""

LOG_TAIL = 4_000
"""Characters of a log in which the reason of a failure is looked for."""

PREEMPTED = 75
"""Exit code of a job that was told to stop."""


@dataclass
class Tally:
    """Jobs by what became of them."""

    done: list[Job] = field(default_factory=list)
    kept: list[Job] = field(default_factory=list)
    """Done before."""
    failed: dict[str, str] = field(default_factory=dict)
    """Reasons by name."""
    broken: list[Job] = field(default_factory=list)
    """Stopped or killed: they go on next time."""
    stopped_by: signal.Signals | None = None

    def says(self) -> str:
        """In a line."""
        counts = {
            "done": len(self.done),
            "done before": len(self.kept),
            "failed": len(self.failed),
            "to go on": len(self.broken),
        }
        return ", ".join(f"{n} {what}" for what, n in counts.items() if n) or "nothing to do"


def run_jobs(jobs: Sequence[Job], backend: Backend, console: Console, retry: bool = False) -> Tally:
    """Run what is not done, and show how far it is. Failed jobs are left alone unless `retry`."""
    tally = Tally()
    waiting: dict[str, Job] = {}
    for job in jobs:
        if retry:
            job.failed.unlink(missing_ok=True)
        if job.is_done():
            tally.kept.append(job)
        elif job.failed.exists():
            tally.failed[job.name] = job.failed.read_text().strip()
        else:
            waiting[job.name] = job
    board = Board(console, jobs, tally)
    try:
        with _Stop(backend, console) as stop, board:
            for job in waiting.values():
                job.write()
                backend.submit(job)
            while waiting and not (stop.received and not backend.running()):
                for name, code in backend.ended().items():
                    conclude(waiting.pop(name), code, tally, stop.received)
                board.update(backend.running())
                time.sleep(POLL_EVERY)
            tally.broken += waiting.values()
            tally.stopped_by = stop.received
            board.update(set())
    finally:
        backend.close()
    return tally


def conclude(job: Job, code: int, tally: Tally, stopped: Any) -> None:
    """Sort a job that ended by its exit code."""
    if code == 0:
        tally.done.append(job)
    elif code == PREEMPTED or code < 0 or stopped:
        tally.broken.append(job)
    else:
        reason = last_words(job.log) or f"exit code {code}"
        job.failed.write_text(f"{reason}\n")
        tally.failed[job.name] = reason


def last_words(log: Path) -> str:
    """The last line of a log: an error of mabl's, or of Python's."""
    lines = log.read_text(errors="replace")[-LOG_TAIL:].splitlines()
    said = [line.strip() for line in lines if line.strip()]
    return re.sub(r"^mabl: ", "", said[-1])[:300] if said else ""


class _Stop:
    """The first Ctrl-C or SIGTERM has jobs save and end; the second is real."""

    received: signal.Signals | None = None

    def __init__(self, backend: Backend, console: Console):
        self._backend, self._console = backend, console
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> "_Stop":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._handle)
        return self

    def _handle(self, number: int, frame: FrameType | None) -> None:
        del frame
        self.received = signal.Signals(number)
        self._console.print("stopping: jobs save and end; once more stops at once")
        self._restore()
        self._backend.stop()

    def _restore(self) -> None:
        while self._previous:
            signal.signal(*self._previous.popitem())

    def __exit__(self, *_: object) -> None:
        self._restore()
