"""Where numbers go: a JSONL file first, TensorBoard beside it."""

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path

from tensorboardX import SummaryWriter

from mabl.errors import UserError

Row = dict[str, float]


class MetricsLog:
    """Appends rows to `metrics.jsonl` and TensorBoard; one line is one write."""

    def __init__(self, folder: Path, resume_at: int | None = None):
        """With `resume_at`, rows past that step are dropped: the run will produce them again."""
        self._path = folder / "metrics.jsonl"
        if resume_at is not None:
            kept = [row for row in read(folder) if row["step"] <= resume_at]
            temporary = self._path.with_suffix(".tmp")
            temporary.write_text("".join(map(_line, kept)))
            temporary.replace(self._path)
        self._file = self._path.open("a")
        self._tensorboard = SummaryWriter(
            str(folder / "tensorboard"), purge_step=None if resume_at is None else resume_at + 1
        )

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Log metrics at an environment step; what is not finite is left out."""
        finite = {name: value for name, value in metrics.items() if math.isfinite(value)}
        self._file.write(_line({"step": step, **finite}))
        self._file.flush()
        for name, value in finite.items():
            self._tensorboard.add_scalar(name, value, step)

    def close(self) -> None:
        """Flush and release the files."""
        self._file.close()
        self._tensorboard.close()


def read(folder: Path) -> list[Row]:
    """All rows of a run. Raises UserError if a line is not a row."""
    path = folder / "metrics.jsonl"
    if not path.exists():
        return []
    rows = []
    lines = path.read_text().splitlines()
    for number, line in enumerate(lines, start=1):
        try:
            row = json.loads(line)
            row["step"] = int(row["step"])
        except (ValueError, KeyError, TypeError) as error:
            if number == len(lines):
                break  # torn by a crash in mid-write: that row's cycle will run again
            raise UserError(f"{path} line {number} is not a row of metrics: remove it") from error
        rows.append(row)
    return rows


def column(rows: Iterable[Row], name: str) -> tuple[list[float], list[float]]:
    """Steps and values of one metric, where it was logged."""
    pairs = [(row["step"], row[name]) for row in rows if name in row]
    return [step for step, _ in pairs], [value for _, value in pairs]


def _line(row: Mapping[str, float]) -> str:
    return json.dumps(row) + "\n"
