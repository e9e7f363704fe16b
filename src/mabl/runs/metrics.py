"""Where numbers go: a JSONL file first, TensorBoard beside it."""

import json
import math
import os
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog  # pyright: ignore[reportAttributeAccessIssue]
from tensorboardX.summary import scalar

from mabl.errors import UserError
from mabl.runs.files import flush_to_disk, replace_file

Row = dict[str, float]

NOT_SCORES = (
    "episodes",
    "episode_return",
    "episode_length",
    "skipped_updates",
    "imagined_steps",
    "replayed_rows_per_env_step",
    "policy_gradient_steps_per_env_step",
)
"""Names under `train/` that are not the environment's score."""


class MetricsLog:
    """Appends rows to `metrics.jsonl` and TensorBoard; one line is one write."""

    def __init__(self, folder: Path, resume_at: int | None = None):
        """With `resume_at`, rows past that step are dropped: the run will produce them again."""
        self._path = folder / "metrics.jsonl"
        if resume_at is not None:
            kept = [row for row in read(folder) if row["step"] <= resume_at]
            replace_file(self._path, "".join(map(_line, kept)))
        self._file = self._path.open("a")
        self._tensorboard = TensorBoard(folder / "tensorboard", resume_at)

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Log metrics at an environment step; what is not finite is left out."""
        finite = {name: value for name, value in metrics.items() if math.isfinite(value)}
        self._file.write(_line({"step": step, **finite}))
        self._file.flush()
        self._tensorboard.write(step, finite)

    def flush_to_disk(self) -> None:
        """Have all rows so far outlive a loss of power."""
        flush_to_disk(self._file.fileno())

    def close(self) -> None:
        """Flush and release the files."""
        self._file.close()
        self._tensorboard.close()


class TensorBoard:
    """An event file, written at once: tensorboardX's own writer hangs when its thread fails."""

    def __init__(self, folder: Path, resume_at: int | None = None):
        """With `resume_at`, what other files have past that step is not to be shown."""
        folder.mkdir(exist_ok=True)
        self._writer = EventsWriter(str(folder / "events"), f".{os.getpid()}")
        if resume_at is not None:
            start = SessionLog(status=SessionLog.START)
            self._event(resume_at + 1, session_log=start)

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Scalars of one step."""
        for name, value in metrics.items():
            self._event(step, summary=scalar(name, value))
        self._writer.flush()

    def close(self) -> None:
        """Release the file."""
        self._writer.close()

    def _event(self, step: int, **content: Any) -> None:
        self._writer.write_event(Event(wall_time=time.time(), step=step, **content))


def read(folder: Path) -> list[Row]:
    """All rows of a run. Raises UserError if a line is not a row."""
    path = folder / "metrics.jsonl"
    if not path.exists():
        return []
    rows = []
    lines = path.read_bytes().splitlines()
    for number, line in enumerate(lines, start=1):
        try:
            row = json.loads(line)
            row["step"] = int(row["step"])
            if not all(type(value) in (int, float) for value in row.values()):
                raise TypeError("not a number")
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            if number == len(lines):
                break  # torn by a crash in mid-write: that row's cycle will run again
            raise UserError(f"{path} line {number} is not a row of metrics: remove it") from error
        rows.append(row)
    return rows


def column(rows: Iterable[Row], name: str) -> tuple[list[float], list[float]]:
    """Steps and values of one metric, where it was logged."""
    pairs = [(row["step"], row[name]) for row in rows if name in row]
    return [step for step, _ in pairs], [value for _, value in pairs]


def score_name(rows: Iterable[Row]) -> str | None:
    """What the environment calls its score; None where no episode has ended."""
    named = (name.removeprefix("train/") for row in rows for name in row if "train/" in name)
    return next((name for name in named if name not in NOT_SCORES), None)


def _line(row: Mapping[str, float]) -> str:
    return json.dumps(row) + "\n"
