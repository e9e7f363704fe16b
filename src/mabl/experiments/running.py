"""Running jobs to their ends: what is done is kept, what is broken goes on, what failed is said."""

import re
import signal
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console

from mabl.errors import PREEMPTED
from mabl.experiments.board import Board
from mabl.experiments.jobs import Job
from mabl.experiments.processes import Backend
from mabl.training.interruption import Interruption

POLL_EVERY = 0.5
"""Seconds between looks at what ended."""

LOG_TAIL = 4_000
"""Characters of a log in which the reason of a failure is looked for."""


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


class Running:
    """Jobs on a backend while they run, and what became of them; a context.

    Ctrl-C or SIGTERM has them save and end; Ctrl-C again is real.
    """

    def __init__(self, backend: Backend, console: Console):
        self.tally = Tally()
        self.going: dict[str, Job] = {}
        """Submitted and not ended, by name."""
        self._jobs: list[Job] = []
        self._backend = backend
        self._board = Board(console, self._jobs, self.tally)
        self._stop = Interruption(console, "stopping: jobs save and end", backend.stop)

    def __enter__(self) -> "Running":
        self._stop.__enter__()
        self._board.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self.tally.broken += self.going.values()
        self.tally.stopped_by = self._stop.received
        self._board.update(set())
        self._board.__exit__(*error)
        self._stop.__exit__(*error)
        self._backend.close()

    def add(self, job: Job, retry: bool = False) -> None:
        """Have a job run, unless it is done; or unless it failed before, and this is no `retry`.

        Raises UserError where it cannot.
        """
        self._jobs.append(job)
        if self.stopping:
            self.tally.broken.append(job)
            return
        if retry:
            job.failed.unlink(missing_ok=True)
        if job.is_done():
            self.tally.kept.append(job)
        elif job.failed.exists():
            self.tally.failed[job.name] = job.failed.read_text().strip()
        else:
            job.write()
            self.going[job.name] = job
            self._backend.submit(job)

    @property
    def goes_on(self) -> bool:
        """Whether there is anything to wait for."""
        stopped = self._stop.received and not self._backend.running()
        return bool(self.going) and not stopped

    def has_failed(self, name: str) -> bool:
        """Whether a job ended with an error, and not by a signal."""
        return any(job.name == name and job.failed.exists() for job in self._jobs)

    @property
    def stopping(self) -> bool:
        """Whether nothing more should be begun."""
        return self._stop.received is not None

    def wait(self) -> list[Job]:
        """Look what ended, and show how things stand; those that ended."""
        time.sleep(POLL_EVERY)
        ended = []
        for name, code in self._backend.ended().items():
            ended.append(self.going.pop(name))
            conclude(ended[-1], code, self.tally, self._stop.received)
        self._board.update(self._backend.running())
        return ended


def run_jobs(jobs: Sequence[Job], backend: Backend, console: Console, retry: bool = False) -> Tally:
    """Run what is not done, and show how far it is. Failed jobs are left alone unless `retry`."""
    with Running(backend, console) as running:
        for job in jobs:
            running.add(job, retry)
        while running.goes_on:
            running.wait()
    return running.tally


def conclude(job: Job, code: int, tally: Tally, stopped: Any) -> None:
    """Sort a job that ended by its exit code.

    What a signal killed is shown with what failed, and goes on next time all the same.
    """
    if code == 0 and job.is_done():
        tally.done.append(job)
    elif code == PREEMPTED or stopped:
        tally.broken.append(job)
    elif code < 0:
        killed = signal.Signals(-code).name
        tally.failed[job.name] = f"killed by {killed} (out of memory?); the next run goes on"
    else:
        reason = last_words(job.log) or f"exit code {code}"
        job.failed.write_text(f"{reason}\n")
        tally.failed[job.name] = reason


def last_words(log: Path) -> str:
    """The last line of a log: an error of mabl's, or of Python's."""
    lines = log.read_text(errors="replace")[-LOG_TAIL:].splitlines()
    said = [line.strip() for line in lines if line.strip()]
    return re.sub(r"^mabl: ", "", said[-1])[:300] if said else ""
