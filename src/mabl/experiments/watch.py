"""How runs stand while they go on, read from their folders again and again, and little each time.

The page that shows it is `watch_page`, which needs the extra `watch`.
"""

import math
import os
import socket
import time
from collections.abc import Iterable, Sequence
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from mabl.algorithms.config import Config
from mabl.errors import UserError
from mabl.experiments.following import TAIL, Follower, newest_mean
from mabl.experiments.jobs import read_job
from mabl.experiments.records import task_name
from mabl.runs.folder import read_config
from mabl.runs.metrics import Row, column, score_name
from mabl.training.curves import PANELS, smoothed
from mabl.training.progress import SPEED_OVER

HOST = "127.0.0.1"
"""No other machine is answered."""

RECENT = 120.0
"""A run that wrote within so many seconds is running, whoever runs it."""

POINTS = 500
"""Points of a line, at most."""

KEPT = {"step", "time/seconds", *(name for names in PANELS.values() for name in names)}
"""Metrics that are shown, beside all of `train/`."""


def shown(name: str) -> bool:
    """Whether a metric is."""
    return name in KEPT or name.startswith("train/")


INNER = {"checkpoints", "tensorboard", "videos"}
"""Folders of a run; there are no runs in them."""


class Standing(NamedTuple):
    """How a run stands."""

    folder: Path
    """Of a seed that failed before it began: the one where its runs would be."""
    state: str
    """`running`, `finished`, `stopped`, `failed` or `damaged`."""
    config: Config | None
    """None where it cannot be read."""
    note: str = ""
    """What is wrong with it."""
    step: int = 0
    score: float = math.nan
    """Mean over its newest training episodes; NaN before the first."""
    episode_return: float = math.nan
    """Likewise."""
    speed: float = math.nan
    """Steps per second of its newest cycles; NaN if unknown."""

    @property
    def task(self) -> str:
        """Its environment, and the arguments that it is made with."""
        return task_name(self.config) if self.config else "?"

    @property
    def seconds_left(self) -> float:
        """NaN unless it is running."""
        if self.state != "running" or not self.config or not self.speed > 0:
            return math.nan
        return (self.config.total_steps - self.step) / self.speed


class Line(NamedTuple):
    """One metric of one run."""

    metric: str
    points: list[tuple[float, float]]
    """Environment steps and values, `POINTS` at most."""


class Watch:
    """All runs below a folder. It is for one thread at a time."""

    def __init__(self, logdir: Path):
        self._logdir = logdir
        self._tails: dict[Path, Follower] = {}
        self._drawn: dict[Path, tuple[Follower, dict[str, list[Line]]]] = {}

    def standings(self) -> list[Standing]:
        """Of all runs, the newest first; before them, of seeds that failed before they began."""
        folders, jobs = find(self._logdir)
        failed, locked = failures(jobs), locked_inodes()
        newest = {folder.parent: folder for folder in folders}
        standings = []
        for folder in folders:
            _, reason = failed.get(folder.parent, (None, ""))
            reason = reason if folder == newest[folder.parent] else ""
            try:
                standings.append(self._standing(folder, reason, locked))
            except OSError:  # it was removed meanwhile
                continue
        for folder in failed.keys() - newest.keys():
            standings.append(Standing(folder, "failed", *failed[folder]))
        standings.sort(key=lambda run: run.folder)
        return sorted(standings, key=lambda run: run.folder.name, reverse=True)

    def _standing(self, folder: Path, reason: str, locked: set[int]) -> Standing:
        stat = (folder / "config.yaml").stat()
        config = read_again(folder, (stat.st_ino, stat.st_mtime_ns, stat.st_size))
        if isinstance(config, str):
            return Standing(folder, "damaged", None, config)
        metrics = self._tails.setdefault(folder, Follower(folder / "metrics.jsonl", TAIL, shown))
        metrics.read()
        rows = metrics.rows
        written = max(
            path.stat().st_mtime
            for path in (folder / "config.yaml", folder / "metrics.jsonl")
            if path.exists()
        )
        step = int(rows[-1]["step"]) if rows else 0
        lock = folder / ".lock"
        if lock.exists() and lock.stat().st_ino in locked:
            state = "running"
        elif step >= config.total_steps:
            state = "finished"
        elif reason:
            state = "failed"
        else:
            state = "running" if time.time() - written < RECENT else "stopped"
        notes = [reason] if state == "failed" else []
        if metrics.damaged:
            notes.append(f"lines of metrics.jsonl that are no rows: {metrics.damaged}")
        if metrics.torn and state != "running":
            notes.append("the newest line of metrics.jsonl is torn")
        return Standing(
            folder,
            state,
            config,
            "; ".join(notes),
            step,
            newest_mean(rows, f"train/{score_name(rows)}"),
            newest_mean(rows, "train/episode_return"),
            steps_per_second(rows),
        )

    def curves(self, folders: Iterable[Path]) -> dict[Path, dict[str, list[Line]]]:
        """Lines of some runs, by panel. Other runs' are forgotten."""
        drawn = {}
        for folder in folders:
            metrics, lines = self._drawn.get(folder) or (
                Follower(folder / "metrics.jsonl", keep=shown),
                {},
            )
            drawn[folder] = metrics, panels(metrics.rows) if metrics.read() else lines
        self._drawn = drawn
        return {folder: lines for folder, (_, lines) in drawn.items()}


@lru_cache(10_000)
def read_again(folder: Path, stamp: tuple[int, ...]) -> Config | str:
    """A run's configuration, or why it cannot be read; anew when `stamp` says that it changed."""
    try:  # nothing is made of it that it could name
        return read_config(folder, trust=True)
    except UserError as error:
        return str(error)


def find(logdir: Path) -> tuple[list[Path], list[Path]]:
    """Run folders, and folders of suites' jobs, in order; links are not followed."""
    runs, jobs = [], []
    for parent, folders, files in os.walk(logdir):
        if "config.yaml" in files:
            runs.append(Path(parent))
            folders[:] = set(folders) - INNER
        if "jobs" in folders:
            jobs.append(Path(parent, "jobs"))
    return sorted(runs), sorted(jobs)


def failures(jobs: Sequence[Path]) -> dict[Path, tuple[Config, str]]:
    """Folders of seeds whose job failed: what it was to do, and why it failed."""
    failed = {}
    for file in (file for folder in jobs for file in folder.glob("*.failed")):
        try:
            job = read_job(file.with_suffix(".yaml"))
            reason = "" if file.is_symlink() else file.read_text(encoding="utf-8").strip()
        except (UserError, OSError):  # it was removed meanwhile, or is damaged
            continue
        for seed in job.seeds:
            config = job.of_seed(seed)
            parent = Path(config.logdir) / config.env / config.name / f"seed_{seed}"
            failed[parent] = config, reason or "it does not say why"
    return failed


def locked_inodes() -> set[int]:
    """Files on which a process of this machine holds a lock, where the system lists them (Linux).

    To try a lock would be to hold it, and a run that begins just then would find it held.
    """
    try:
        lines = Path("/proc/locks").read_text().splitlines()
    except OSError:
        return set()
    return {int(line.split()[5].rpartition(":")[2]) for line in lines if " FLOCK " in line}


def steps_per_second(rows: Sequence[Row]) -> float:
    """Over the newest cycles: compiling and pretraining soon drop out. NaN after the first."""
    recent = rows[-SPEED_OVER - 1 :]
    seconds = sum(row.get("time/seconds", 0.0) for row in recent[1:])
    return (recent[-1]["step"] - recent[0]["step"]) / seconds if seconds > 0 else math.nan


def panels(rows: list[Row]) -> dict[str, list[Line]]:
    """The lines of one run in each panel, as `curves.png` has them."""
    lines = {}
    for panel, names in PANELS.items():
        if "train/score" in names:  # environments call it what they like
            names = (f"train/{score_name(rows)}",)
        lines[panel] = [
            Line(name.partition("/")[2], points)
            for name in names
            if (points := thin(*(smoothed if name.startswith("train/") else column)(rows, name)))
        ]
    return lines


def thin(steps: Sequence[float], values: Sequence[float]) -> list[tuple[float, float]]:
    """Every nth point and the newest, `POINTS` at most."""
    points = list(zip(steps, values, strict=True))
    stride = math.ceil(len(points) / (POINTS - 1)) or 1
    return points[::stride] + (points[-1:] if (len(points) - 1) % stride else [])


def serve(logdir: Path, port: int = 8642, show: bool = True) -> None:
    """Show the runs below a folder on a page of this machine until Ctrl-C.

    With `show`, a browser opens it. Raises UserError without the folder, the port or the extra.
    """
    if not logdir.is_dir():
        raise UserError(f"there is no folder {logdir}: give one that holds runs, or will")
    if not 0 < port < 65_536:
        raise UserError(f"--port is {port}: give a number from 1 to 65535")
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise UserError(
                f"port {port} cannot be had ({error.strerror}): give another --port"
            ) from error
    if not find_spec("nicegui"):
        raise UserError("mabl watch needs an extra: pip install 'mabl[watch]'")
    from mabl.experiments import watch_page

    watch_page.run(logdir.resolve(), port, show)
