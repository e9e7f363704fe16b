"""Metrics of runs while they are written: read again and again, and little each time."""

import json
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import BinaryIO

from mabl.runs.metrics import Row
from mabl.training.curves import smoothed

TAIL = 65_536
"""Bytes at the end of a run's metrics that tell how it is going."""


class Follower:
    """Rows of one run's metrics, as they are appended; a file that was replaced is read anew."""

    def __init__(
        self, path: Path, tail: int | None = None, keep: Callable[[str], bool] = lambda name: True
    ):
        """With `tail`, only the rows in that many bytes at the file's end are read at first.

        `keep` says of which metrics.
        """
        self._path, self._tail, self._keep = path, tail, keep
        self._begin(-1, 0)

    def _begin(self, inode: int, start: int) -> None:
        self.rows: list[Row] = []
        self.damaged = 0
        """Lines that are no rows."""
        self.torn = False
        """Whether the newest line has no end: it is being written, or was when a crash came."""
        self._inode, self._size, self._at = inode, 0, start
        self._in_mid_line = start > 0

    def read(self) -> bool:
        """Take in what is new; returns whether there was anything."""
        try:
            if self._path.is_symlink() or not self._path.is_file():
                raise FileNotFoundError
            with self._path.open("rb") as file:
                return self._take(file)
        except OSError:
            was_there = self._inode != -1
            self._begin(-1, 0)
            return was_there

    def _take(self, file: BinaryIO) -> bool:
        stat = os.fstat(file.fileno())
        if stat.st_ino != self._inode or stat.st_size < self._size:
            self._begin(stat.st_ino, max(0, stat.st_size - self._tail) if self._tail else 0)
        elif stat.st_size == self._size:
            return False
        file.seek(self._at)
        data = file.read()
        *lines, rest = data.split(b"\n")
        self._size = self._at + len(data)
        self._at = self._size - len(rest)
        self.torn = bool(rest)
        if lines and self._in_mid_line:
            self._in_mid_line = False
            del lines[0]
        rows = [row for line in lines if (row := parse(line, self._keep))]
        self.damaged += len(lines) - len(rows)
        self.rows += rows
        return True


def parse(line: bytes, keep: Callable[[str], bool] = lambda name: True) -> Row | None:
    """What is kept of a row of metrics; None if it is none."""
    try:
        row = json.loads(line)
        row["step"] = int(row["step"])
        return {name: value for name, value in row.items() if math.isfinite(value) and keep(name)}
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        return None


def newest_mean(rows: Sequence[Row], name: str) -> float:
    """Mean of a metric of training episodes over the newest of them; NaN without one."""
    _, means = smoothed(list(rows), name)
    return means[-1] if means else math.nan
