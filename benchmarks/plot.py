"""Learning curves of run folders, and of the PPO yardstick, with min-max shading over seeds.

    uv run python -m benchmarks.plot --runs 'MABL=runs/smax/3m/mabl/*/*' \\
        --ppo MAPPO=ppo.json --out 3m.png

Win rate and return at a step are those of the training episodes in the window of steps before it.
"""

import argparse
import json
from glob import glob
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from mabl.runs.metrics import read

WINDOW = 4_000
"""Environment steps over which training episodes are averaged."""


class Curve(NamedTuple):
    """What ended in each cycle of a run: `[cycles]`."""

    steps: np.ndarray
    episodes: np.ndarray
    wins: np.ndarray
    returns: np.ndarray


def run_curve(folder: Path) -> Curve:
    """The cycles of a run."""
    rows = [row for row in read(folder) if row["train/episodes"]]
    steps, episodes, win_rate, episode_return = (
        np.array([row[name] for row in rows])
        for name in ("step", "train/episodes", "train/win_rate", "train/episode_return")
    )
    return Curve(steps, episodes, episodes * win_rate, episodes * episode_return)


def ppo_curve(curve: dict) -> Curve:
    """The batches of a seed of benchmarks/ppo.py."""
    steps, *sums = (np.array(curve[name]) for name in ("steps", "episodes", "wins", "returns"))
    return Curve(np.cumsum(steps), *sums)


def per_episode(curve: Curve, name: str, grid: np.ndarray) -> np.ndarray:
    """`wins` or `returns` over episodes in the window before each point; NaN without episodes."""
    sums, means = getattr(curve, name), []
    for end in grid:
        inside = (curve.steps > end - WINDOW) & (curve.steps <= end)
        total = curve.episodes[inside].sum()
        seen = total and end < curve.steps[-1] + 1_000
        means.append(sums[inside].sum() / total if seen else np.nan)
    return np.array(means)


def draw(axis: Axes, grid: np.ndarray, label: str, means: np.ndarray) -> None:
    """The mean over seeds `[S, grid]`, shaded from the lowest to the highest."""
    shown = ~np.isnan(means).any(0)
    (line,) = axis.plot(grid[shown], means[:, shown].mean(0), label=f"{label} ({len(means)})")
    low, high = means[:, shown].min(0), means[:, shown].max(0)
    axis.fill_between(grid[shown], low, high, color=line.get_color(), alpha=0.2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", nargs="*", default=[], help="LABEL=GLOB of run folders")
    parser.add_argument("--ppo", nargs="*", default=[], help="LABEL=output of benchmarks/ppo.py")
    parser.add_argument("--title", default="")
    parser.add_argument(
        "--report", type=int, nargs="*", default=[12_000, 20_000, 40_000, 60_000, 80_000]
    )
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    groups = {}
    for item in args.runs:
        label, pattern = item.split("=", 1)
        groups[label] = [run_curve(Path(path)) for path in sorted(glob(pattern))]
        if not groups[label]:
            parser.error(f"no run folder matches {pattern}")
    for item in args.ppo:
        label, path = item.split("=", 1)
        curves = json.loads(Path(path).read_text())["curves"]
        groups[label] = [ppo_curve(curve) for curve in curves.values()]

    longest = max(curve.steps[-1] for curves in groups.values() for curve in curves)
    grid = np.arange(1_000, longest + 1, 1_000)
    figure = Figure(figsize=(10, 4), layout="constrained")
    won, earned = figure.subplots(1, 2)
    for label, curves in groups.items():
        rates = np.stack([per_episode(curve, "wins", grid) for curve in curves])
        draw(won, grid, label, rates)
        draw(earned, grid, label, np.stack([per_episode(c, "returns", grid) for c in curves]))
        for steps in args.report:
            at = rates[:, grid == steps].round(2).ravel().tolist()
            if at and not np.isnan(at).any():
                print(f"{label}: win rate at {steps:,} steps {at}")
    won.set(ylabel="win rate in training", ylim=(0, 1))
    earned.set(ylabel="episode return in training", ylim=(0, None))
    for axis in (won, earned):
        axis.set(xlabel="environment steps")
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        axis.grid(alpha=0.3)
    won.legend(frameon=False)
    figure.suptitle(args.title)
    figure.savefig(args.out, dpi=130)


if __name__ == "__main__":
    main()
