"""What a person sees while jobs run: all of them in one table, live on a terminal."""

import math
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from mabl.experiments.following import TAIL, Follower, newest_mean
from mabl.experiments.jobs import Job
from mabl.runs.metrics import Row, score_name
from mabl.training.progress import duration

if TYPE_CHECKING:
    from mabl.experiments.running import Tally

LINE_EVERY = 30.0
"""Seconds between lines where there is no terminal."""


class Board:
    """All jobs, their states, steps and scores."""

    def __init__(self, console: Console, jobs: Sequence[Job], tally: "Tally"):
        self._console, self._jobs, self._tally = console, jobs, tally
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None
        self._said: dict[str, str] = {}
        self._runs: dict[Path, Follower] = {}
        self._began: dict[str, tuple[float, float]] = {}
        self._last_line = time.monotonic()

    def __enter__(self) -> "Board":
        if self._live:
            self._live.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._live:
            self._live.__exit__(kind, error, trace)

    def update(self, running: set[str]) -> None:
        """Show how things stand."""
        states = {job.name: self._state(job, running) for job in self._jobs}
        if self._live:
            self._live.update(self._table(states), refresh=True)
            return
        for job in self._jobs:
            state = states[job.name]
            if state not in (self._said.get(job.name), "waiting"):
                self._said[job.name] = state
                reason = self._tally.failed.get(job.name, "")
                self._line(job, f"{state}{': ' if reason else ''}{reason}")
        if time.monotonic() - self._last_line > LINE_EVERY:
            self._last_line = time.monotonic()
            for job in self._jobs:
                if states[job.name] == "running":
                    self._line(job, self._progress(job)[0])

    def _line(self, job: Job, what: str) -> None:
        self._console.print(f"{job.name}: {what}", highlight=False, soft_wrap=True, markup=False)

    def _state(self, job: Job, running: set[str]) -> str:
        tally = self._tally
        if job.name in tally.failed:
            return "failed"
        for state, jobs in (("done", tally.done), ("kept", tally.kept), ("to go on", tally.broken)):
            if any(other.name == job.name for other in jobs):
                return state
        return "running" if job.name in running else "waiting"

    def _progress(self, job: Job) -> tuple[str, float]:
        """Steps, score and time left of a running job in words; and its steps."""
        runs = [self._rows(path) for seed in job.seeds if (path := newest(job, seed))]
        step = min((rows[-1]["step"] if rows else 0.0 for rows in runs), default=0.0)
        if not step:
            return "starting", 0.0
        scores = [newest_mean(rows, f"train/{score_name(rows)}") for rows in runs]
        scores = [score for score in scores if math.isfinite(score)]
        words = f"{step:,.0f} of {job.config.total_steps:,} steps"
        if scores:
            words += f", score {sum(scores) / len(scores):.2f}"
        began, first = self._began.setdefault(job.name, (time.monotonic(), step))
        seconds, steps = time.monotonic() - began, step - first
        if steps > 0 and step < job.config.total_steps:
            words += f", {duration((job.config.total_steps - step) * seconds / steps)} left"
        return words, step

    def _rows(self, run: Path) -> list[Row]:
        metrics = self._runs.setdefault(run, Follower(run / "metrics.jsonl", TAIL))
        metrics.read()
        return metrics.rows

    def _table(self, states: dict[str, str]) -> Table:
        table = Table(box=None, padding=(0, 1), title=self._tally.says())
        for heading in ("task", "algorithm", "seeds", "state", "", ""):
            table.add_column(heading, no_wrap=True)
        for job in self._jobs:
            state, words, bar = states[job.name], "", ""
            if state == "running":
                words, step = self._progress(job)
                total = job.config.total_steps
                bar = ProgressBar(total, min(step, total), width=20)
            elif state == "failed":
                words = self._tally.failed[job.name]
            first, last = job.seeds[0], job.seeds[-1]
            seeds = f"{first}-{last}" if last > first else f"{first}"
            table.add_row(job.config.env, job.config.name, seeds, state, bar, Text(words))
        return table


def newest(job: Job, seed: int) -> Path | None:
    """The newest run folder of a seed."""
    config = job.config
    parent = Path(config.logdir) / config.env / config.name / f"seed_{seed}"
    return max(parent.glob("*/"), default=None)
