"""Searching for settings with Optuna: every trial is a job. Needs the extra `sweep`.

LOGDIR/study.db      the study, in SQLite: it goes on where it was left
       trials.csv    every trial's settings and score
"""

import csv
import logging
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console

from mabl import plain_yaml
from mabl.algorithms.config import Config
from mabl.algorithms.presets import preset
from mabl.errors import UserError
from mabl.experiments.comparison import LAST, newest
from mabl.experiments.jobs import Job
from mabl.experiments.processes import Backend
from mabl.experiments.records import Record, read_record
from mabl.experiments.running import Running
from mabl.experiments.suite import OWN, changed

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution
    from optuna.study import Study


def _optuna() -> Any:
    try:
        import optuna
    except ImportError as error:
        raise UserError("mabl sweep needs an extra: pip install 'mabl[sweep]'") from error
    logging.getLogger("optuna").setLevel(logging.WARNING)
    logging.getLogger("alembic").setLevel(logging.WARNING)
    return optuna


@dataclass(frozen=True)
class Search:
    """What is searched for, and how much of it."""

    config: Config
    """What all trials have in common."""
    space: tuple[str, ...]
    """Fields and their values: see `parse_space`."""
    trials: int
    seeds: int = 1
    """Seeds of a trial: its score is their mean."""
    eval_episodes: int = 32
    cpus: float = 1
    gpus: float = 0
    storage: str | None = None
    """A database that Optuna knows; None: SQLite in the log folder."""

    @property
    def logdir(self) -> Path:
        """Where everything goes."""
        return Path(self.config.logdir)

    def job(self, number: int, chosen: dict[str, Any]) -> Job:
        """The job of a trial."""
        config = replace(settings(self.config, chosen), label=f"trial-{number}")
        seeds = tuple(range(config.seed, config.seed + self.seeds))
        return Job(config, seeds, self.eval_episodes, self.cpus, self.gpus)


def run_search(search: Search, backend: Backend, console: Console) -> "tuple[Study, Running]":
    """Run trials until there are as many as asked for; those of a search that was killed first.

    Raises UserError for a space that cannot be searched, or is another than the study's.
    """
    optuna = _optuna()
    space = parse_space(search.space)
    probe(search, space)
    study = open_study(search)
    check_same(study, search, space)
    states = optuna.trial.TrialState
    numbers: dict[str, int] = {}
    """Of trials whose jobs are not told yet, by name."""

    def add(number: int, chosen: dict[str, Any]) -> None:
        job = search.job(number, chosen)
        numbers[job.name] = number
        running.add(job)

    with Running(backend, console) as running:
        for trial in study.get_trials(states=[states.RUNNING]):
            if set(trial.params) == set(space):
                add(trial.number, trial.params)
            else:  # it was being proposed when the search was killed
                study.tell(trial.number, state=states.FAIL)
        while True:
            tell(study, running, numbers)
            write_trials(study, search.logdir / "trials.csv")
            ended = len(study.get_trials(states=[states.COMPLETE, states.FAIL]))
            while (
                not running.stopping
                and len(running.going) < backend.slots
                and ended + len(numbers) < search.trials
            ):
                trial = study.ask(space)
                add(trial.number, trial.params)
            if not running.goes_on:
                break
            running.wait()
        tell(study, running, numbers)
    write_trials(study, search.logdir / "trials.csv")
    return study, running


def open_study(search: Search) -> "Study":
    """The study, made if it is not there. Raises UserError where it cannot be had."""
    optuna = _optuna()
    try:
        search.logdir.mkdir(parents=True, exist_ok=True)
        study = optuna.create_study(
            study_name=search.logdir.name,
            storage=search.storage or f"sqlite:///{search.logdir / 'study.db'}",
            direction="maximize",
            load_if_exists=True,
        )
        # Each time with other random numbers: those of before would propose the same again.
        seed = search.config.seed + len(study.get_trials(deepcopy=False))
        study.sampler = optuna.samplers.TPESampler(seed=seed)
        return study
    except Exception as error:  # whatever the database's driver has to say
        where = search.storage or search.logdir / "study.db"
        reason = f"{error}".strip().partition("\n")[0][:200]
        raise UserError(
            f"no study at {where} ({reason}): give another --storage or --name"
        ) from error


def tell(study: "Study", running: Running, numbers: dict[str, int]) -> None:
    """Have the study know what became of jobs, once; those that are to go on stay as they are."""
    states = _optuna().trial.TrialState
    for job in (*running.tally.done, *running.tally.kept):
        if job.name in numbers:
            study.tell(numbers.pop(job.name), score_of(job))
    for name in running.tally.failed:  # what a signal killed goes on next time
        if name in numbers and running.has_failed(name):
            study.tell(numbers.pop(name), state=states.FAIL)


def score_of(job: Job) -> float:
    """Mean score of the training episodes of the last 15,000 steps, or of the last quarter."""
    end = job.config.total_steps
    scores = []
    for path in job.runs().values():
        record = read_record(path) if path else None
        if isinstance(record, Record):
            scores.append(newest(record, record.scores, min(LAST, end // 4), record.last_step))
    return float(np.mean(scores))


def settings(config: Config, chosen: dict[str, Any]) -> Config:
    """A config with fields such as `world_model.learning_rate` changed."""
    for name, value in chosen.items():
        section, _, field = name.rpartition(".")
        config = changed(config, {section: {field: value}} if section else {field: value})
    return config


def flags_of(config: Config, chosen: dict[str, Any]) -> str:
    """Flags of `mabl train` that make a config with these settings."""
    usual = asdict(preset(config.preset, config.env, config.algo))
    flags = {"env": config.env, "algo": config.algo, "preset": config.preset}
    for name, value in asdict(settings(config, chosen)).items():
        parts = value.items() if isinstance(value, dict) else [("", value)]
        for field, new in parts:
            old = usual[name][field] if field else usual[name]
            if new != old and name != "logdir":
                flags[f"{name}.{field}" if field else name] = new
    words = []
    for name, value in flags.items():
        section, dot, field = name.replace("_", "-").rpartition(".")
        if isinstance(value, bool):
            words.append(f"--{section}{dot}{'' if value else 'no-'}{field}")
            continue
        given = value if isinstance(value, tuple | list) else [value]
        words += [f"--{section}{dot}{field}", *map(str, given)]
    return shlex.join(words)


def probe(search: Search, space: "dict[str, BaseDistribution]") -> None:
    """Raise UserError for fields that the config does not have, or values they cannot take."""
    for name, values in space.items():
        ends = getattr(values, "choices", None) or (values.low, values.high)  # pyright: ignore[reportAttributeAccessIssue]
        for value in ends:
            before, after = search.config, settings(search.config, {name: value})
            if after == before and after == settings(search.config, {name: ends[-1]}):
                raise UserError(f"--space {name}: {search.config.algo} does not read it")


def parse_space(space: Sequence[str]) -> "dict[str, BaseDistribution]":
    """`field=1e-4..1e-2:log`, `field=4..20` (whole numbers), `field=64,128,256`, by field.

    Raises UserError for anything else.
    """
    found = {}
    for text in space:
        name, equals, values = text.partition("=")
        if not (name and equals and values):
            raise UserError(
                f"--space {text!r}: give FIELD=LOW..HIGH, FIELD=LOW..HIGH:log or FIELD=A,B,C"
            )
        if name in OWN:
            raise UserError(f"--space {name} cannot be searched: give it as a flag")
        if name in found:
            raise UserError(f"--space {name} is there twice: give it once")
        found[name] = _distribution(text, values)
    if not found:
        raise UserError("--space is empty: give what to search, e.g. mappo.ent_coef=1e-3..0.1:log")
    return found


def _distribution(text: str, values: str) -> "BaseDistribution":
    distributions = _optuna().distributions
    try:
        if ".." not in values:
            return distributions.CategoricalDistribution(
                [plain_yaml.load(value) for value in values.split(",")]
            )
        interval, _, scale = values.partition(":")
        low, high = (_number(end) for end in interval.split("..", 1))
        if scale not in ("", "log"):
            raise ValueError(f"{scale} is no scale")
        kind = (
            distributions.IntDistribution
            if isinstance(low, int) and isinstance(high, int)
            else distributions.FloatDistribution
        )
        return kind(low, high, log=scale == "log")
    except ValueError as error:
        raise UserError(
            f"--space {text!r} ({error}): give FIELD=LOW..HIGH, FIELD=LOW..HIGH:log or FIELD=A,B,C"
        ) from error


def _number(text: str) -> int | float:
    try:
        return int(text)
    except ValueError:
        return float(text)


def check_same(study: "Study", search: Search, space: "dict[str, BaseDistribution]") -> None:
    """Raise UserError if a study that goes on was of other settings."""
    told = [*sorted(map(str, space.items())), repr(search.config)]
    told += [f"{search.seeds} seeds, {search.eval_episodes} episodes"]
    if study.user_attrs.get("search", told) != told:
        raise UserError(
            f"{search.logdir} is a sweep of another space or config: give another --name"
        )
    study.set_user_attr("search", told)


def write_trials(study: "Study", path: Path) -> None:
    """Every trial's number, state, score and settings."""
    trials = study.get_trials(deepcopy=False)
    names = sorted({name for trial in trials for name in trial.params})
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["trial", "state", "score", *names])
        for trial in trials:
            score = "" if trial.value is None else f"{trial.value:.6g}"
            chosen = [trial.params.get(name, "") for name in names]
            writer.writerow([trial.number, trial.state.name.lower(), score, *chosen])
