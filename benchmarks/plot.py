"""Learning curves of run folders, and of the PPO yardstick, with min-max shading over seeds.

    uv run python -m benchmarks.plot --runs 'MABL=runs/smax/3m/mabl/*/*' \\
        --ppo MAPPO=ppo.json --out 3m.png

The win rate at a step is that of the training episodes in the window of steps before it.
"""

import argparse
import json
from glob import glob
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from mabl.runs.metrics import read

WINDOW = 4_000
"""Environment steps over which training episodes are averaged."""


def run_curve(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Steps, episodes and wins of each cycle of a run."""
    rows = [row for row in read(folder) if row["train/episodes"]]
    steps = np.array([row["step"] for row in rows])
    episodes = np.array([row["train/episodes"] for row in rows])
    wins = episodes * np.array([row["train/win_rate"] for row in rows])
    return steps, episodes, wins


def ppo_curve(curve: dict) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same of a seed of benchmarks/ppo.py."""
    return np.cumsum(curve["steps"]), np.array(curve["episodes"]), np.array(curve["wins"])


def win_rate(curve: tuple[np.ndarray, np.ndarray, np.ndarray], grid: np.ndarray) -> np.ndarray:
    """Wins over episodes in the window before each point of the grid; NaN without episodes."""
    steps, episodes, wins = curve
    rates = []
    for end in grid:
        inside = (steps > end - WINDOW) & (steps <= end)
        total = episodes[inside].sum()
        seen = total and end < steps[-1] + 1_000
        rates.append(wins[inside].sum() / total if seen else np.nan)
    return np.array(rates)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", nargs="*", default=[], help="LABEL=GLOB of run folders")
    parser.add_argument("--ppo", nargs="*", default=[], help="LABEL=output of benchmarks/ppo.py")
    parser.add_argument("--title", default="")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    groups = {}
    for item in args.runs:
        label, pattern = item.split("=", 1)
        groups[label] = [run_curve(Path(path)) for path in sorted(glob(pattern))]
    for item in args.ppo:
        label, path = item.split("=", 1)
        curves = json.loads(Path(path).read_text())["curves"]
        groups[label] = [ppo_curve(curve) for curve in curves.values()]

    longest = max(curve[0][-1] for curves in groups.values() for curve in curves)
    grid = np.arange(1_000, longest + 1, 1_000)
    figure = Figure(figsize=(7, 4.2), layout="constrained")
    axis = figure.subplots()
    for label, curves in groups.items():
        rates = np.stack([win_rate(curve, grid) for curve in curves])
        shown = ~np.isnan(rates).any(0)
        (line,) = axis.plot(grid[shown], rates[:, shown].mean(0), label=f"{label} ({len(rates)})")
        axis.fill_between(
            grid[shown],
            rates[:, shown].min(0),
            rates[:, shown].max(0),
            color=line.get_color(),
            alpha=0.2,
        )
        at_20k = [float(rate[19]) for rate in rates if len(rate) > 19]
        print(label, "win rate at 20k steps:", [round(rate, 3) for rate in at_20k])
    axis.set(
        title=args.title, xlabel="environment steps", ylabel="win rate in training", ylim=(0, 1)
    )
    axis.grid(alpha=0.3)
    axis.legend(frameon=False)
    figure.savefig(args.out, dpi=130)


if __name__ == "__main__":
    main()
