"""A job: seeds of one algorithm on one task. It can be run any number of times, and is done once.

LOGDIR/jobs/NAME.yaml      what is to be done
            NAME.log       what was said meanwhile
            NAME.failed    why it failed, if it did
LOGDIR/ENV/ALGO/seed_N/TIMESTAMP/evaluation.json   what the trained policy earned
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import yaml

from mabl import plain_yaml
from mabl.algorithms.config import Config, from_dict
from mabl.algorithms.registry import unread
from mabl.envs import registry
from mabl.envs.host import Hosted
from mabl.errors import UserError
from mabl.experiments.suite import Suite, slug
from mabl.runs.checkpoint import Checkpoints
from mabl.runs.files import replace_file
from mabl.runs.folder import read_config
from mabl.training.run import PLACEMENT

EVALUATION = "evaluation.json"

ELSEWHERE = ("total_steps", *PLACEMENT)
"""Fields in which a run may differ from what is wanted, and still be it."""


@dataclass(frozen=True)
class Job:
    """What one process does."""

    config: Config
    """Of all seeds but for the seed."""
    seeds: tuple[int, ...]
    eval_episodes: int
    """Greedy episodes of each trained policy."""
    cpus: float = 1
    gpus: float = 0

    @property
    def name(self) -> str:
        """For files and people."""
        first, last = self.seeds[0], self.seeds[-1]
        seeds = f"seed-{first}" if first == last else f"seeds-{first}-{last}"
        return slug((self.config.env, *self.config.env_kwargs, self.config.name, seeds))

    @property
    def folder(self) -> Path:
        """Where it stands."""
        return Path(self.config.logdir) / "jobs"

    def write(self) -> Path:
        """Put it where its process finds it. Raises UserError where it cannot be written."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            replace_file(self.file, yaml.safe_dump(plain(asdict(self)), sort_keys=False))
        except OSError as error:
            raise UserError(
                f"cannot write to {self.folder} ({error.strerror}): choose another --logdir"
            ) from error
        return self.file

    @property
    def file(self) -> Path:
        """What is to be done."""
        return self.folder / f"{self.name}.yaml"

    @property
    def log(self) -> Path:
        """What its process says."""
        return self.folder / f"{self.name}.log"

    @property
    def failed(self) -> Path:
        """Why it failed, if it did."""
        return self.folder / f"{self.name}.failed"

    def of_seed(self, seed: int) -> Config:
        """The configuration of one run."""
        return replace(self.config, seed=seed, num_seeds=1)

    def runs(self) -> dict[int, Path | None]:
        """The newest run folder of each seed that is what is wanted, if there is one."""
        return {seed: find_run(self.of_seed(seed)) for seed in self.seeds}

    def is_done(self) -> bool:
        """Whether every seed is trained to the end, and evaluated."""
        return all(
            path is not None
            and steps_done(path) >= self.config.total_steps
            and is_evaluated(path, self.eval_episodes)
            for path in self.runs().values()
        )


def read_job(path: Path) -> Job:
    """A job's file, wherever its folder was moved to. Raises UserError if it is none."""
    try:
        job = from_dict(Job, plain_yaml.load(path.read_text(encoding="utf-8")))
        if not job.seeds:
            raise ValueError("it has no seeds")
        unread(job.config.algo)
    except (OSError, ValueError, TypeError, UserError) as error:
        raise UserError(f"{path} is not a job of a suite ({error})") from error
    return replace(job, config=replace(job.config, logdir=str(path.parent.parent)))


def jobs_of(suite: Suite, logdir: Path, total_steps: int | None = None) -> list[Job]:
    """A suite's jobs, tasks in their order; all with `total_steps`, if they are given.

    Raises UserError for what cannot be.
    """
    jobs = []
    for config in suite.configs(logdir):
        config = replace(config, total_steps=total_steps or config.total_steps)
        seeds = range(suite.first_seed, suite.first_seed + suite.seeds)
        size = suite.seeds_per_job or (suite.seeds if one_program(config) else 1)
        for start in range(0, len(seeds), size):
            group = tuple(seeds[start : start + size])
            jobs.append(Job(config, group, suite.eval_episodes, suite.cpus, suite.gpus))
    names = [job.name for job in jobs]
    for name in names:
        if names.count(name) > 1:
            raise UserError(f"suite {suite.name} has {name} twice: give one of them a label")
    return jobs


def one_program(config: Config) -> bool:
    """Whether seeds are trained in one program; where it is not known, one is enough to fail."""
    try:
        return not isinstance(registry.make(config.env, config.env_kwargs), Hosted)
    except UserError:
        return True


def find_run(config: Config) -> Path | None:
    """The newest run folder with that configuration, if there is one."""
    parent = Path(config.logdir) / config.env / config.name / f"seed_{config.seed}"
    wanted = comparable(config)
    for path in sorted(parent.glob("*/config.yaml"), reverse=True):
        try:  # its environment is the one that is asked for, if it is the same
            if comparable(read_config(path.parent, trust=True)) == wanted:
                return path.parent
        except UserError:
            continue
    return None


def comparable(config: Config) -> Config:
    """A configuration without what does not matter to what is learned."""
    defaults, names = Config(), (*ELSEWHERE, *unread(config.algo))
    return replace(config, **{name: getattr(defaults, name) for name in names})


def steps_done(run: Path) -> int:
    """Steps at the newest checkpoint; -1 without one."""
    folder = run / "checkpoints"
    return max(Checkpoints(folder).steps, default=-1) if folder.is_dir() else -1


def is_evaluated(run: Path, episodes: int) -> bool:
    """Whether its newest policy has played so many episodes, or more."""
    path = run / EVALUATION
    try:
        played = json.loads(path.read_text()) if path.exists() else {}
        return played["step"] == steps_done(run) and len(played["episode_return"]) >= episodes
    except (ValueError, KeyError, TypeError):
        return False


def plain(data: Any) -> Any:
    """With lists for tuples."""
    if isinstance(data, dict):
        return {name: plain(value) for name, value in data.items()}
    return [plain(value) for value in data] if isinstance(data, list | tuple) else data


def in_a_row(seeds: Sequence[int]) -> list[list[int]]:
    """Seeds as runs of consecutive ones."""
    groups = groupby(enumerate(sorted(seeds)), key=lambda pair: pair[1] - pair[0])
    return [[seed for _, seed in group] for _, group in groups]
