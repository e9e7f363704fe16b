"""What run folders say, read for comparison."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from mabl import plain_yaml
from mabl.algorithms.config import Config
from mabl.errors import UserError
from mabl.experiments.jobs import EVALUATION, Job, comparable, read_job, steps_done
from mabl.runs.checkpoint import Checkpoints
from mabl.runs.folder import read_config
from mabl.runs.metrics import read, score_name

NO_PARAMETERS = (
    "opt.",
    "target.",
    ".returns.",
    ".scale.",
    ".state_scale.",
    ".ent_coef",
    ".epsilon",
)
"""In names of what a learner has beside the parameters of its networks."""


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
    """Of its networks; None without a checkpoint."""
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
    unread: list[str]
    """What cannot be read, and why."""
    superseded: int
    """Finished runs that are left out: there is a newer one of the same seed, or a newer one of the
    same task and algorithm with other settings."""


def task_name(config: Config) -> str:
    """An environment, and the arguments that it is made with."""
    return " ".join((config.env, *config.env_kwargs))


def collect(paths: Sequence[Path]) -> Found:
    """All runs under some folders. Raises UserError if there are none that are finished.

    The newest run of a task and an algorithm says which settings count, or else the newest job.
    """
    configs: dict[Path, Config] = {}
    finished: dict[tuple[str, str, int], Record] = {}
    reasons: dict[tuple[str, str, int], str] = {}
    unread: list[str] = []
    for folder in run_folders(paths):
        try:
            configs[folder] = read_config(folder, trust=True)
            comparable(configs[folder])
        except UserError as error:
            unread.append(str(error))
            configs.pop(folder, None)
    jobs = jobs_under(paths, unread)
    told = [*(job.config for job, _ in jobs), *configs.values()]
    wanted = {(task_name(config), config.name): settings_of(config) for config in told}
    superseded = 0
    for folder, config in configs.items():
        key = task_name(config), config.name, config.seed
        try:
            record = read_record(folder, config)
        except (UserError, ValueError, KeyError, TypeError, AttributeError, OSError) as error:
            unread.append(f"{folder}: {error}")
            continue
        other = settings_of(config) != wanted[key[:2]]
        if isinstance(record, Record) and record.finished:
            superseded += other or key in finished
            if not other:
                finished[key] = record
        elif not other:
            done = record if isinstance(record, int) else record.last_step
            reasons[key] = (
                "no episode ended"
                if done >= config.total_steps
                else f"unfinished: {done:,} of {config.total_steps:,} steps"
            )
    for job, failure in jobs:
        old = settings_of(job.config) != wanted[task_name(job.config), job.config.name]
        for seed in () if old and not failure else job.seeds:
            key = task_name(job.config), job.config.name, seed
            reasons[key] = failure or reasons.get(key, "not begun")
    if not finished:
        where = ", ".join(map(str, paths))
        odd = f" ({unread[0]})" if unread else ""
        raise UserError(f"no finished run under {where}{odd}: wait for its end, or train first")
    gaps = [Missing(*key, why) for key, why in sorted(reasons.items()) if key not in finished]
    return Found(list(finished.values()), gaps, unread, superseded)


def run_folders(paths: Sequence[Path]) -> list[Path]:
    """Those under some folders, the oldest first. Raises UserError if there is no such folder."""
    folders: list[Path] = []
    for path in paths:
        if not path.is_dir():
            raise UserError(f"there is no folder {path}: give run folders, or folders of them")
        folders += sorted(file.parent for file in path.rglob("config.yaml"))
    return sorted(dict.fromkeys(folders), key=when_begun)


def when_begun(run: Path) -> tuple[str, float]:
    """The second that its folder is named by; within it, by its configuration's file."""
    return run.name[: len("20261231-235959")], (run / "config.yaml").stat().st_mtime


def settings_of(config: Config) -> Config:
    """What two seeds of one algorithm have in common."""
    return replace(comparable(config), seed=0)


def jobs_under(paths: Sequence[Path], unread: list[str]) -> list[tuple[Job, str]]:
    """Jobs of suites, the oldest first, and why they failed, if they did.

    Adds to `unread` what is none.
    """
    jobs = []
    files = {file for path in paths for file in path.rglob("jobs/*.yaml")}
    for file in sorted(files, key=lambda file: (file.stat().st_mtime, file)):
        failed = file.with_suffix(".failed")
        try:
            why = f"failed: {failed.read_text().strip()}" if failed.exists() else ""
            jobs.append((read_job(file), why))
        except (UserError, OSError, ValueError) as error:
            unread.append(str(error))
    return jobs


def read_record(folder: Path, config: Config | None = None) -> Record | int:
    """A run; before its first episode ended, the steps that it has done.

    Raises UserError, ValueError, KeyError, TypeError or AttributeError for what is no run's.
    """
    rows = read(folder)
    score = score_name(rows)
    if score is None:
        return int(rows[-1]["step"]) if rows else 0
    ended = [row for row in rows if row.get("train/episodes") and f"train/{score}" in row]

    def column(name: str) -> NDArray[np.floating]:
        return np.array([row.get(name, np.nan) for row in ended], float)

    versions = folder / "versions.yaml"
    evaluation = folder / EVALUATION
    played = json.loads(evaluation.read_text()) if evaluation.exists() else None
    if played is not None:
        for name in (score, "episode_return"):
            np.array(played[name], float)
        if played["step"] != steps_done(folder):
            played = None
    return Record(
        folder=folder,
        config=config or read_config(folder, trust=True),
        score=score,
        steps=column("step"),
        episodes=column("train/episodes"),
        scores=column(f"train/{score}"),
        returns=column("train/episode_return"),
        last_step=int(rows[-1]["step"]),
        seconds=sum(row.get("time/seconds", 0.0) for row in rows),
        imagined=sum(row.get("train/imagined_steps", 0.0) for row in rows),
        parameters=count_parameters(folder),
        evaluation=played,
        versions=dict(plain_yaml.load(versions.read_text())) if versions.exists() else {},
    )


def count_parameters(folder: Path) -> int | None:
    """Of networks, without their optimisers and targets; None if unknown."""
    checkpoints = folder / "checkpoints"
    steps = Checkpoints(checkpoints).steps if checkpoints.is_dir() else []
    if not steps:
        return None
    try:
        with safe_open(checkpoints / f"step_{steps[0]}" / "state.safetensors", "numpy") as file:
            return sum(
                math.prod(file.get_slice(name).get_shape())
                for name in file.keys()  # noqa: SIM118 (it is no dict)
                if name.startswith("learner.") and not any(part in name for part in NO_PARAMETERS)
            )
    except (OSError, SafetensorError):
        return None
