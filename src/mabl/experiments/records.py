"""What run folders say, read for comparison."""

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from mabl import plain_yaml
from mabl.algorithms.config import Config
from mabl.errors import UserError
from mabl.experiments.jobs import EVALUATION, Job, read_job
from mabl.runs.checkpoint import Checkpoints
from mabl.runs.folder import read_config
from mabl.runs.metrics import read, score_name


class Record(NamedTuple):
    """One run."""

    folder: Path
    config: Config
    score: str
    """What its environment calls the score."""
    steps: NDArray[np.floating]
    """Environment steps of the cycles `[C]` in which episodes ended."""
    episodes: NDArray[np.floating]
    """How many, `[C]`."""
    scores: NDArray[np.floating]
    """Their mean score, `[C]`."""
    returns: NDArray[np.floating]
    """Their mean return, `[C]`."""
    last_step: int
    seconds: float
    """That its cycles took."""
    imagined: float
    """Joint steps imagined and learned from."""
    parameters: int | None
    """Numbers that learning changes; None without a checkpoint."""
    evaluation: dict[str, Any] | None
    versions: dict[str, str]

    @property
    def finished(self) -> bool:
        """Whether it did all its steps."""
        return self.last_step >= self.config.total_steps

    @property
    def key(self) -> tuple[str, str, int]:
        """Task, algorithm and seed."""
        return task_name(self.config), self.config.name, self.config.seed


class Missing(NamedTuple):
    """A seed that was to be run, and is not finished."""

    task: str
    algorithm: str
    seed: int
    reason: str


class Found(NamedTuple):
    """What was found under some folders."""

    records: list[Record]
    """Finished runs, one for each task, algorithm and seed: the newest."""
    missing: list[Missing]
    superseded: int
    """Finished runs that have a newer one of the same task, algorithm and seed."""


def task_name(config: Config) -> str:
    """An environment, and the arguments that it is made with."""
    return " ".join((config.env, *config.env_kwargs))


def collect(paths: Sequence[Path]) -> Found:
    """All runs under some folders. Raises UserError if there are none that are finished."""
    folders: list[Path] = []
    for path in paths:
        if not path.is_dir():
            raise UserError(f"there is no folder {path}: give run folders, or folders of them")
        folders += sorted(file.parent for file in path.rglob("config.yaml"))
    finished: dict[tuple[str, str, int], Record] = {}
    missing: dict[tuple[str, str, int], Missing] = {}
    superseded = 0
    for folder in sorted(dict.fromkeys(folders), key=lambda folder: folder.name):
        record = read_record(folder)
        if record is None or not record.finished:
            config = record.config if record else read_config(folder, trust=True)
            done = record.last_step if record else 0
            reason = f"unfinished: {done:,} of {config.total_steps:,} steps"
            key = task_name(config), config.name, config.seed
            missing[key] = Missing(*key, reason)
            continue
        superseded += record.key in finished
        finished[record.key] = record
    for job, reason in jobs_under(paths):
        for seed in job.seeds:
            key = task_name(job.config), job.config.name, seed
            if reason or key not in missing:
                missing[key] = Missing(*key, reason or "not begun")
    if not finished:
        where = ", ".join(map(str, paths))
        raise UserError(f"no finished run under {where}: wait for its end, or train first")
    left = [gap for key, gap in sorted(missing.items()) if key not in finished]
    return Found(list(finished.values()), left, superseded)


def jobs_under(paths: Sequence[Path]) -> Iterator[tuple[Job, str]]:
    """Jobs of suites, and why they failed, if they did."""
    for path in paths:
        for file in sorted(path.glob("jobs/*.yaml")):
            failed = file.with_suffix(".failed")
            yield read_job(file), f"failed: {failed.read_text().strip()}" if failed.exists() else ""


def read_record(folder: Path) -> Record | None:
    """A run; None before its first episode ended."""
    rows = read(folder)
    score = score_name(rows)
    if score is None:
        return None
    ended = [row for row in rows if row.get("train/episodes")]

    def column(name: str) -> NDArray[np.floating]:
        return np.array([row[name] for row in ended], float)

    evaluation = folder / EVALUATION
    versions = folder / "versions.yaml"
    return Record(
        folder=folder,
        config=read_config(folder, trust=True),
        score=score,
        steps=column("step"),
        episodes=column("train/episodes"),
        scores=column(f"train/{score}"),
        returns=column("train/episode_return"),
        last_step=int(rows[-1]["step"]),
        seconds=sum(row.get("time/seconds", 0.0) for row in rows),
        imagined=sum(row.get("train/imagined_steps", 0.0) for row in rows),
        parameters=count_parameters(folder),
        evaluation=json.loads(evaluation.read_text()) if evaluation.exists() else None,
        versions=plain_yaml.load(versions.read_text()) if versions.exists() else {},
    )


def count_parameters(folder: Path) -> int | None:
    """Numbers that learning changes, without optimisers and target networks; None if unknown."""
    checkpoints = folder / "checkpoints"
    steps = Checkpoints(checkpoints).steps if checkpoints.is_dir() else []
    if not steps:
        return None
    try:
        with safe_open(checkpoints / f"step_{steps[0]}" / "state.safetensors", "numpy") as file:
            return sum(
                math.prod(file.get_slice(name).get_shape())
                for name in file.keys()  # noqa: SIM118 (it is no dict)
                if name.startswith("learner.")
                and not any(part in name for part in ("opt.", "target."))
            )
    except (OSError, SafetensorError):
        return None
