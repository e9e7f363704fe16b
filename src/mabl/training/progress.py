"""What a person sees while a run goes on: a live panel on a terminal, plain lines elsewhere."""

import math
import time
from collections import deque
from types import TracebackType

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table

from mabl.runs.metrics import Row

LINE_EVERY = 15.0
"""Seconds between lines where there is no terminal."""
SPEED_OVER = 20
"""Cycles over which the speed is measured: compiling and pretraining soon drop out."""
EPISODES = 100
"""Returns and scores are means over at least this many of the newest episodes."""


class Progress:
    """Shows steps, episode return, score, losses, steps per second and time left."""

    def __init__(self, console: Console, total_steps: int, score_name: str):
        self._console, self._total, self._score = console, total_steps, score_name
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None
        self._recent: deque[Row] = deque()
        self._marks: deque[tuple[float, float]] = deque(maxlen=SPEED_OVER + 1)
        self._last_line = time.monotonic()

    def __enter__(self) -> "Progress":
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

    def update(self, row: Row) -> None:
        """Take in one cycle's metrics."""
        self._recent.append(row)
        while self._episodes() - self._recent[0].get("train/episodes", 0) >= EPISODES:
            self._recent.popleft()
        now = time.monotonic()
        self._marks.append((now, row["step"]))
        if self._live:
            self._live.update(self._panel(row), refresh=True)
        elif now - self._last_line > LINE_EVERY or row["step"] >= self._total:
            self._last_line = now
            fields = "  ".join(f"{name} {value}" for name, value in self._fields(row))
            self._console.print(
                f"{row['step']:>9,.0f} steps  {fields}", highlight=False, soft_wrap=True
            )

    def _episodes(self) -> float:
        return sum(row.get("train/episodes", 0) for row in self._recent)

    def _mean(self, name: str) -> float:
        episodes = self._episodes()
        total = sum(row.get(name, 0) * row.get("train/episodes", 0) for row in self._recent)
        return total / episodes if episodes else float("nan")

    def _speed(self) -> float:
        """Steps per second over the newest cycles; NaN after the first, which compiled."""
        (began, first), (now, last) = self._marks[0], self._marks[-1]
        return (last - first) / (now - began) if now > began else math.nan

    def _fields(self, row: Row) -> list[tuple[str, str]]:
        speed = self._speed()
        left = (self._total - row["step"]) / speed if speed else math.nan
        fields = [
            (self._score.replace("_", " "), f"{self._mean(f'train/{self._score}'):.2f}"),
            ("return", f"{self._mean('train/episode_return'):.2f}"),
            ("length", f"{self._mean('train/episode_length'):.0f}"),
        ]
        for label, name in (
            ("model loss", "world_model/loss"),
            ("actor loss", "behaviour/actor_loss"),
            ("critic loss", "behaviour/critic_loss"),
            ("entropy", "behaviour/entropy"),
        ):
            if math.isfinite(row.get(name, math.nan)):
                fields.append((label, f"{row[name]:.3g}"))
        fields.append(("steps/s", "?" if math.isnan(speed) else f"{speed:.0f}"))
        fields.append(("left", duration(left)))
        return fields

    def _panel(self, row: Row) -> Table:
        grid = Table.grid(padding=(0, 2))
        grid.add_row("steps", f"{row['step']:,.0f} of {self._total:,}")
        grid.add_row("", ProgressBar(self._total, min(row["step"], self._total), width=40))
        for name, value in self._fields(row):
            grid.add_row(name, value)
        return grid


def duration(seconds: float) -> str:
    """Seconds as `4:05` or `1:04:05`; `?` if unknown."""
    if not math.isfinite(seconds):
        return "?"
    minutes, rest = divmod(int(max(seconds, 0)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
