"""Suites: which algorithms are compared on which tasks, as data files.

description: one line
tasks: [smax/3m, {env: smax/2s3z, config: {total_steps: 60000}}]
algorithms: [mabl, {algo: mabl, label: mabl-fast, config: {training: {model_updates: 5}}}]
seeds: 10
preset: quick
config: {training: {checkpoint_every: 5000}}

Later wins: preset, the suite's config, the task's, the algorithm's.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.resources import files
from math import inf
from pathlib import Path
from typing import Any, Literal

from mabl import plain_yaml
from mabl.algorithms.config import Config, from_dict
from mabl.algorithms.presets import preset
from mabl.algorithms.registry import unread
from mabl.errors import UserError, require_between, require_positive, unknown_name

SHIPPED = files("mabl.experiments") / "suites"
SUITE_SIZE = 1_000_000
"""Characters of a suite's file, at most."""

OWN = ("env", "env_kwargs", "algo", "label", "preset", "seed", "num_seeds", "logdir")
"""Fields of a run's config that a suite, or a sweep, decides otherwise."""

Changes = Mapping[str, Any]


@dataclass(frozen=True)
class Task:
    """An environment, and what of the configuration changes there."""

    env: str
    env_kwargs: tuple[str, ...] = ()
    config: dict = field(default_factory=dict)


@dataclass(frozen=True)
class Contender:
    """An algorithm, and what of the configuration it changes."""

    algo: str
    label: str = ""
    """What it is called, where one algorithm is in a suite twice."""
    config: dict = field(default_factory=dict)

    @property
    def name(self) -> str:
        """For people."""
        return self.label or self.algo


@dataclass(frozen=True)
class Suite:
    """Tasks x algorithms x seeds."""

    name: str
    tasks: tuple[Task, ...]
    algorithms: tuple[Contender, ...]
    description: str = ""
    seeds: int = 3
    """How many."""
    first_seed: int = 0
    preset: Literal["quick", "efficient", "paper"] = "quick"
    config: dict = field(default_factory=dict)
    eval_episodes: int = 320
    """Of the trained policy, greedy: ten times the 32 of a point in evaluations of MARL."""
    seeds_per_job: int | None = None
    """Seeds that one program trains; None: all where the environment is compiled, else one."""
    cpus: float = 1
    """Cores that one job takes."""
    gpus: float = 0
    """GPUs that one job takes, on Ray; a fraction lets jobs share one."""

    def __post_init__(self) -> None:
        require_positive(self, "seeds", "seeds_per_job", "cpus", "eval_episodes")
        require_between(self, 0, inf, "gpus", "first_seed")
        if not re.fullmatch(r"\w[\w.+-]{0,60}", self.name):
            raise UserError(f"suite name is {self.name!r}: give letters, digits, and - _ + .")
        for changes in (self, *self.tasks, *self.algorithms):
            if own := [name for name in changes.config if name in OWN]:
                raise UserError(
                    f"config of suite {self.name} has {own[0]}: it is the suite's to say"
                )
        for what in ("tasks", "algorithms"):
            if not getattr(self, what):
                raise UserError(f"suite {self.name} has no {what}: give at least one")

    def configs(self, logdir: Path) -> Iterator[Config]:
        """Of every task and algorithm, for the first seed. Raises UserError for what cannot be."""
        for task in self.tasks:
            for contender in self.algorithms:
                config = preset(self.preset, task.env, contender.algo)
                for changes in (self.config, task.config, contender.config):
                    config = changed(config, changes)
                yield replace(
                    config,
                    env_kwargs=task.env_kwargs or config.env_kwargs,
                    label=contender.label,
                    seed=self.first_seed,
                    logdir=str(logdir),
                )


def shipped() -> dict[str, Suite]:
    """The suites that come with mabl, by name."""
    paths = sorted(Path(str(SHIPPED)).glob("*.yaml"))
    return {path.stem: read(path) for path in paths}


def load(name: str) -> Suite:
    """A shipped suite by its name, or one's own by its file. Raises UserError if there is none."""
    if name.endswith((".yaml", ".yml")):
        return read(Path(name))
    if name not in shipped():
        raise unknown_name("suite", name, (*shipped(), "a file of your own: suite.yaml"))
    return shipped()[name]


def read(path: Path) -> Suite:
    """A suite's file. Raises UserError for what is no suite."""
    try:
        with path.open(encoding="utf-8") as file:
            data = plain_yaml.load(file.read(SUITE_SIZE))
    except OSError as error:
        raise UserError(f"cannot read {path} ({error.strerror}): give a suite's file") from error
    except ValueError as error:
        raise UserError(f"{path} is not readable YAML ({error})") from error
    if not isinstance(data, dict):
        raise UserError(f"{path} is no suite: give tasks and algorithms (docs/experiments.md)")
    spelt = {"name": path.stem} | data
    for key, short in (("tasks", "env"), ("algorithms", "algo")):
        if isinstance(spelt.get(key), list):
            spelt[key] = [{short: x} if isinstance(x, str) else x for x in spelt[key]]
        else:
            raise UserError(f"{path} has no list of {key}: give one")
    try:
        return from_dict(Suite, spelt)
    except TypeError as error:  # a task without its environment
        raise UserError(f"{path}: {error}") from error
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def narrowed(suite: Suite, tasks: Sequence[str], algorithms: Sequence[str]) -> Suite:
    """A suite with only these of its tasks and algorithms, all where none is named.

    Raises UserError for those that it does not have.
    """
    by_env = {task.env: task for task in suite.tasks}
    by_name = {one.name: one for one in suite.algorithms}
    for kind, wanted, known in (("task", tasks, by_env), ("algorithm", algorithms, by_name)):
        for name in wanted:
            if name not in known:
                raise unknown_name(f"{kind} of suite {suite.name}", name, known)
    return replace(
        suite,
        tasks=tuple(task for task in suite.tasks if not tasks or task.env in tasks),
        algorithms=tuple(
            one for one in suite.algorithms if not algorithms or one.name in algorithms
        ),
    )


def changed(config: Config, changes: Changes) -> Config:
    """A config with fields, and fields of its sections, replaced; sections it lacks are passed by.

    Raises UserError for unknown fields and values of another type.
    """
    data = asdict(config)
    for name, new in changes.items():
        if name in unread(config.algo):
            continue
        both = isinstance(new, Mapping) and isinstance(data.get(name), Mapping)
        data[name] = {**data[name], **new} if both else new
    return from_dict(Config, data)


def slug(parts: Sequence[str]) -> str:
    """A file's name from parts that may have any characters."""
    return "_".join(re.sub(r"[^\w.+-]+", "-", part) for part in parts)
