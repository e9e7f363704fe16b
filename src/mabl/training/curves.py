"""`curves.png`: the run at a glance."""

from collections import deque
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

from mabl.runs.metrics import Row, column

matplotlib.use("agg")

EPISODES = 100
"""Episodes that a point of the training curves averages over."""

PANELS = {
    "score of training and imagined episodes": (
        "train/win_rate",
        "train/score",
        "behaviour/imagined_win_rate",
    ),
    "return: real, imagined, and the critic's at resets": (
        "train/episode_return",
        "behaviour/imagined_episode_return",
        "behaviour/value_at_reset",
    ),
    "entropy of the policy (nats)": ("behaviour/entropy",),
    "KL (nats)": ("world_model/kl_agent", "world_model/kl_global"),
    "reward variance unexplained": (
        "world_model/reward_unexplained_posterior",
        "world_model/reward_unexplained_prior",
    ),
    "open-loop observation error (1 = mean)": (
        "world_model/open_loop_obs_1",
        "world_model/open_loop_obs_5",
        "world_model/open_loop_obs_15",
    ),
}


def draw(rows: list[Row], title: str, path: Path) -> None:
    """Plot a run's metrics; the file is replaced whole, so that a viewer never sees half of it."""
    figure = Figure(figsize=(12, 6.5), layout="constrained")
    figure.suptitle(title)
    axes = figure.subplots(2, 3).ravel()
    for axis, (panel, names) in zip(axes, PANELS.items(), strict=True):
        for name in names:
            steps, values = (
                smoothed(rows, name) if name.startswith("train/") else column(rows, name)
            )
            if steps:
                axis.plot(steps, values, label=name.split("/")[1], linewidth=1.5)
        axis.set_title(panel, fontsize=10)
        axis.set_xlabel("environment steps", fontsize=9)
        axis.locator_params(axis="x", nbins=5)
        axis.grid(alpha=0.3)
        if axis.lines:
            axis.legend(fontsize=8, frameon=False)
    temporary = path.with_name(f".{path.name}")
    figure.savefig(temporary, dpi=100, format="png")
    temporary.replace(path)


def smoothed(rows: list[Row], name: str) -> tuple[list[float], list[float]]:
    """A metric of training episodes as its mean over the newest `EPISODES` and more."""
    steps, values = [], []
    window: deque[Row] = deque()
    episodes = total = 0.0
    for row in rows:
        if name not in row or not row.get("train/episodes", 0) > 0:
            continue
        window.append(row)
        episodes += row["train/episodes"]
        total += row[name] * row["train/episodes"]
        while episodes - window[0]["train/episodes"] >= EPISODES:
            oldest = window.popleft()
            episodes -= oldest["train/episodes"]
            total -= oldest[name] * oldest["train/episodes"]
        steps.append(row["step"])
        values.append(total / episodes)
    return steps, values
