"""What the process of a job does: train, resume, evaluate, whatever is left of it."""

import json
import os
import signal
import threading
from dataclasses import replace
from pathlib import Path

import jax
from rich.console import Console

from mabl.evaluation import evaluate
from mabl.experiments.jobs import EVALUATION, Job, evaluated_at, in_a_row, steps_done
from mabl.policy import load_run
from mabl.runs.checkpoint import Checkpoints, shared_steps
from mabl.runs.files import replace_file
from mabl.runs.lock import writing
from mabl.training.run import resume, train

PATIENCE = 120.0
"""Seconds that a predecessor, told to stop, has for the end of its cycle."""

EVALUATION_SEED = 2**32 - 1
"""Of evaluations: other episodes than any in training."""


def work(job: Job, console: Console) -> signal.Signals | None:
    """Do what is left of a job; returns what asked it to end early, if anything did."""
    runs = job.runs()
    missing = [seed for seed, path in runs.items() if path is None]
    begun = [path for path in runs.values() if path is not None]
    with writing(begun, PATIENCE):
        pass  # whoever was killed with its parent is gone by now
    short = [path for path in begun if steps_done(path) < job.config.total_steps]
    for paths in together(short):
        outcome = resume(paths, job.config.total_steps, trust=True, console=console)
        if outcome.stopped_by:
            return outcome.stopped_by
    for seeds in in_a_row(missing):
        config = replace(job.config, seed=seeds[0], num_seeds=len(seeds))
        outcome = train(config, console)
        if outcome.stopped_by:
            return outcome.stopped_by
    for path in job.runs().values():
        if path is not None and evaluated_at(path) != steps_done(path):
            evaluate_run(path, job.eval_episodes, job.config.num_workers)
            console.print(f"evaluated {path}", highlight=False, soft_wrap=True)
    return None


def together(paths: list[Path]) -> list[list[Path]]:
    """Runs that can go on in one program, if they were made in one; else each alone."""
    checkpoints = [
        Checkpoints(path / "checkpoints") for path in paths if (path / "checkpoints").is_dir()
    ]
    begun = [kept for kept in checkpoints if kept.steps]
    if len(paths) > 1 and (not begun or (len(begun) == len(paths) and shared_steps(begun))):
        return [paths]
    return [[path] for path in paths]


def evaluate_run(path: Path, episodes: int, num_workers: int | None) -> None:
    """Play greedy episodes with a run's newest policy, and keep what each of them earned."""
    loaded = load_run(path, trust=True)
    key = jax.random.key(EVALUATION_SEED)
    results = evaluate(loaded.env, loaded.executor, key, episodes, num_workers)
    numbers = {
        "step": loaded.step,
        "greedy": True,
        "seed": EVALUATION_SEED,
        loaded.env.spec.score_name: results.score.tolist(),
        "episode_return": results.episode_return.tolist(),
        "episode_length": results.length.tolist(),
    }
    replace_file(path / EVALUATION, json.dumps(numbers) + "\n")


def stop_with_parent() -> None:
    """Have this process told to stop once whoever started it is gone: its stdin is closed then."""

    def wait() -> None:
        while os.read(0, 1024):
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, daemon=True).start()
