"""What the process of a job does: train, resume, evaluate, whatever is left of it."""

import json
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import jax
from rich.console import Console

from mabl.errors import PREEMPTED, UserError
from mabl.evaluation import evaluate
from mabl.experiments.jobs import EVALUATION, Job, in_a_row, is_evaluated, steps_done
from mabl.policy import load_run
from mabl.runs.checkpoint import Checkpoints, shared_steps
from mabl.runs.files import replace_file
from mabl.runs.lock import writing
from mabl.training.run import resume, train

PATIENCE = 20.0
"""Seconds between words about a run that another process still writes."""

EVALUATION_SEED = 2**32 - 1
"""Of evaluations: other episodes than any in training."""


def work(job: Job, console: Console) -> signal.Signals | None:
    """Do what is left of a job; returns what asked it to end before, if anything did."""
    wait_for_others([path for path in job.runs().values() if path], console)
    runs = job.runs()
    missing = [seed for seed, path in runs.items() if path is None]
    begun = [path for path in runs.values() if path is not None]
    short = [path for path in begun if steps_done(path) < job.config.total_steps]
    for paths in together(short):
        outcome = resume(paths, job.config.total_steps, trust=True, console=console)
        if outcome.told:
            return outcome.told
    for seeds in in_a_row(missing):
        config = replace(job.config, seed=seeds[0], num_seeds=len(seeds))
        outcome = train(config, console)
        if outcome.told:
            return outcome.told
    for path in job.runs().values():
        if path is not None and not is_evaluated(path, job.eval_episodes):
            told = evaluate_run(path, job, console)
            if told:
                return told
    return None


def wait_for_others(begun: list[Path], console: Console) -> None:
    """Until nobody writes these runs: whoever was told to stop, or lost its parent, ends its cycle.

    In pretraining that can take minutes.
    """
    while True:
        try:
            with writing(begun, PATIENCE):
                return
        except UserError as error:
            console.print(f"waiting: {error}", highlight=False, soft_wrap=True, markup=False)


def together(paths: list[Path]) -> list[list[Path]]:
    """Runs that can go on in one program, if they were made in one; else each alone."""
    checkpoints = [
        Checkpoints(path / "checkpoints") for path in paths if (path / "checkpoints").is_dir()
    ]
    begun = [kept for kept in checkpoints if kept.steps]
    if len(paths) > 1 and (not begun or (len(begun) == len(paths) and shared_steps(begun))):
        return [paths]
    return [[path] for path in paths]


def evaluate_run(path: Path, job: Job, console: Console) -> signal.Signals | None:
    """Play greedy episodes with a run's newest policy, and keep what each of them earned.

    Where its last checkpoint is damaged, the run is finished again before.
    """
    loaded, wanted = load_run(path, trust=True), max(job.config.total_steps, steps_done(path))
    if loaded.step < wanted:
        outcome = resume(path, wanted, trust=True, console=console)
        if outcome.told:
            return outcome.told
        loaded = load_run(path, trust=True)
    config, key = job.config, jax.random.key(EVALUATION_SEED)
    results = evaluate(
        *(loaded.env, loaded.executor, key, job.eval_episodes),
        config.num_workers,
        config.worker_timeout,
    )
    numbers = {
        "step": loaded.step,
        "greedy": True,
        "seed": EVALUATION_SEED,
        loaded.env.spec.score_name: results.score.tolist(),
        "episode_return": results.episode_return.tolist(),
        "episode_length": results.length.tolist(),
    }
    replace_file(path / EVALUATION, json.dumps(numbers) + "\n")
    console.print(f"evaluated {path}", highlight=False, soft_wrap=True, markup=False)
    return None


@contextmanager
def preemptible() -> Iterator[None]:
    """SIGTERM ends with its exit code also where there is nothing to save: before, and after."""
    previous = signal.signal(signal.SIGTERM, lambda *_: sys.exit(PREEMPTED))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)


def stop_with_parent() -> None:
    """Have this process told to stop once whoever started it is gone: its stdin is closed then."""

    def wait() -> None:
        while os.read(0, 1024):
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, daemon=True).start()
