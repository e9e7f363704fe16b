"""Run folders as training leaves them, made up: what a report says of them can be worked out."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from mabl import preset
from mabl.algorithms.config import Config
from mabl.runs import folder

SCORE_NAMES = {"smax": "win_rate", "flatland": "arrived"}


def make_run(
    logdir: Path,
    scores: list[float],
    algo: str = "mabl",
    env: str = "smax/3m",
    seed: int = 0,
    total_steps: int | None = None,
    evaluation: list[float] | None = None,
    **fields: str,
) -> Path:
    """A run of cycles of 1,000 steps, in each of which ten episodes ended with such a mean score.

    It is finished if it has as many cycles as `total_steps` asks for (None: it has).
    """
    config = replace(
        preset("quick", env, algo),
        logdir=str(logdir),
        total_steps=total_steps or 1_000 * len(scores),
        **fields,
    )
    path = folder.create(config, seed)
    name = SCORE_NAMES.get(env.split("/")[0], "score")
    rows = [
        {
            "step": 1_000 * (k + 1),
            "train/episodes": 10.0,
            "train/episode_return": 2 * score,
            "train/episode_length": 20.0,
            f"train/{name}": score,
            "train/imagined_steps": 50.0,
            "time/seconds": 3.0,
        }
        for k, score in enumerate(scores)
    ]
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    if evaluation is not None:
        (path / "checkpoints" / f"step_{rows[-1]['step']}").mkdir(parents=True)
        played = {"step": rows[-1]["step"], name: evaluation, "episode_return": evaluation}
        (path / "evaluation.json").write_text(json.dumps(played))
    return path


def make_comparison(logdir: Path, n_seeds: int = 3) -> None:
    """Two tasks, three algorithms; curves rise, those of MABL soonest."""
    rng = np.random.default_rng(0)
    for env in ("smax/3m", "flatland/5_agents"):
        for speed, algo in ((3, "mabl"), (2, "mamba"), (1, "mappo")):
            for seed in range(n_seeds):
                share = np.linspace(0.02, 1, 40) * speed / 3
                scores = np.clip(share + 0.05 * rng.normal(size=40), 0, 1)
                make_run(logdir, scores.tolist(), algo, env, seed, evaluation=[1.0, share[-1]])


def configured(path: Path) -> Config:
    """Of a run."""
    return folder.read_config(path)
