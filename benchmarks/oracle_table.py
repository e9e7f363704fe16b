"""Table and plot of points that `benchmarks.oracle` wrote.

    uv run python -m benchmarks.oracle_table oracle.jsonl --at 20000 40000 --png oracle.png

The table has one row for each setting and environment: mean and range over seeds of the greedy and
the sampled score at the evaluations nearest to `--at`. The plot has one panel for each environment:
score in training against environment steps, mean and range over seeds.
"""

import argparse
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

NEAR = 2_000
"""Environment steps by which an evaluation may miss the step that is asked for."""

Points = dict[tuple[str, str], dict[int, list[dict[str, Any]]]]
"""Points of each seed, by environment and setting."""


def read(files: list[Path]) -> Points:
    """Points of all files; a setting that ran twice with one seed counts once, the newest."""
    points: Points = defaultdict(dict)
    for line in (line for file in files for line in file.read_text().splitlines()):
        point = json.loads(line)
        seeds = points[point["env"], point["name"]]
        seen = seeds.setdefault(point["seed"], [])
        if seen and point["step"] <= seen[-1]["step"]:
            seen.clear()
        seen.append(point)
    return points


def score_of(point: dict[str, Any]) -> float:
    """Score of the training episodes of a point."""
    names = ("win_rate", "score", "arrived")
    return next((point[name] for name in names if name in point), point["episode_return"])


def cell(values: list[float]) -> str:
    """Mean, and lowest and highest where there are several."""
    if not values:
        return ""
    mean = f"{np.mean(values):.2f}"
    return mean if len(values) == 1 else f"{mean} ({min(values):.2f} to {max(values):.2f})"


def table(points: Points, at: list[int]) -> str:
    """A Markdown table."""
    columns = [f"{kind} at {step // 1000}k" for step in at for kind in ("greedy", "sampled")]
    lines = [
        f"| environment | setting | seeds | {' | '.join(columns)} | CPU minutes |",
        "|" + "---|" * (len(columns) + 4),
    ]
    for (env, name), seeds in sorted(points.items()):
        cells = [
            cell(
                [
                    point[kind]
                    for seen in seeds.values()
                    for point in seen
                    if kind in point and 0 <= point["step"] - step < NEAR
                ]
            )
            for step in at
            for kind in ("greedy", "sampled")
        ]
        minutes = np.mean([seen[-1]["cpu_seconds"] / 60 for seen in seeds.values()])
        lines.append(
            f"| {env} | {name} | {', '.join(map(str, sorted(seeds)))} | {' | '.join(cells)} "
            f"| {minutes:.1f} |"
        )
    return "\n".join(lines)


def draw(points: Points, file: Path) -> None:
    """One panel for each environment, one line for each setting."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    envs = sorted({env for env, _ in points})
    names = sorted({name for _, name in points})
    colours = {name: plt.get_cmap("tab20")(2 * i % 20 + i // 10) for i, name in enumerate(names)}
    columns = min(3, len(envs))
    rows = -(-len(envs) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(5 * columns, 3.6 * rows), squeeze=False)
    for ax in axes.flat[len(envs) :]:
        ax.set_visible(False)
    for ax, env in zip(axes.flat, envs, strict=False):
        for name in names:
            if (env, name) not in points:
                continue
            seeds = list(points[env, name].values())
            grid = np.array([point["step"] for point in min(seeds, key=len)])
            curves = np.array(
                [
                    np.interp(grid, *zip(*((p["step"], score_of(p)) for p in s), strict=True))
                    for s in seeds
                ]
            )
            ax.plot(grid, curves.mean(0), color=colours[name], label=name)
            ax.fill_between(grid, curves.min(0), curves.max(0), color=colours[name], alpha=0.15)
        ax.set(
            title=env, xlabel="environment steps", ylabel="score in training", ylim=(-0.02, 1.02)
        )
        ax.legend(fontsize=7)
        ax.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(file, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--at", type=int, nargs="+", default=[20_000, 40_000])
    parser.add_argument("--png", type=Path)
    args = parser.parse_args()
    points = read(args.files)
    print(table(points, args.at))
    if args.png:
        draw(points, args.png)


if __name__ == "__main__":
    main()
