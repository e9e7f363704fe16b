"""Algorithms side by side on one environment: run them, keep what counts, draw it.

    uv run python -m benchmarks.compare run --env smax/3m --seeds 0 1 2 --jobs 4
    uv run python -m benchmarks.compare collect --env smax/3m --raw docs/results/raw
    uv run python -m benchmarks.compare draw --env smax/3m --raw docs/results/raw --out 3m.png

`run` pins every run to a core of its own and leaves out what is finished. Win rate and return at a
step are those of the training episodes in the window of steps before it.
"""

import argparse
import csv
import json
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue
from typing import NamedTuple

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from mabl.algorithms.registry import ALGORITHMS
from mabl.runs.checkpoint import named
from mabl.runs.folder import read_config
from mabl.runs.metrics import read
from mabl.training.programs import build

WINDOW = 4_000
"""Environment steps over which training episodes are averaged in curves."""
LAST = 15_000
"""Environment steps at the end that the table averages over, as the paper's table 1."""
EARLY = 20_000
"""Environment steps at which the table looks at win rates early on."""
EPISODES = 256
"""Greedy episodes after training."""
COLUMNS = ("step", "train/episodes", "train/win_rate", "train/episode_return", "time/seconds")


class Run(NamedTuple):
    """One seed's cycles `[cycles]` in which episodes ended, and what was made of the run."""

    steps: np.ndarray
    episodes: np.ndarray
    wins: np.ndarray
    returns: np.ndarray
    summary: dict


# --- run --------------------------------------------------------------------------------------


def run(env: str, algos: list[str], seeds: list[int], logdir: Path, jobs: int, flags: list[str]):
    """Train and evaluate every algorithm with every seed, `jobs` at a time."""
    cores: Queue[int] = Queue()
    for core in sorted(os.sched_getaffinity(0))[:jobs]:
        cores.put(core)

    def one(algo: str, seed: int) -> None:
        if any(finished(logdir, env, algo, seed)):
            return
        core = cores.get()
        try:
            command = [
                *("mabl", "train", "--env", env, "--algo", algo, "--seed", str(seed)),
                *("--logdir", str(logdir), *flags),
            ]
            pinned(core, command, logdir / f"{env.replace('/', '-')}-{algo}-{seed}.log")
            folder = max((logdir / env / algo / f"seed_{seed}").iterdir())
            command = ["mabl", "eval", str(folder), "--episodes", str(EPISODES), "--json"]
            pinned(core, command, folder / "eval.tmp")
            (folder / "eval.tmp").rename(folder / "eval.json")
            print(f"{env} {algo} seed {seed}: {(folder / 'eval.json').read_text().strip()}")
        finally:
            cores.put(core)

    with ThreadPoolExecutor(jobs) as pool:
        for done in [pool.submit(one, algo, seed) for algo in algos for seed in seeds]:
            done.result()


def pinned(core: int, command: list[str], log: Path) -> None:
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("w") as out:
        subprocess.run(
            command,
            check=True,
            stdout=out,
            stderr=out if log.suffix == ".log" else None,
            preexec_fn=lambda: os.sched_setaffinity(0, {core}),
        )


def finished(logdir: Path, env: str, algo: str, seed: int) -> list[Path]:
    """Run folders that have been evaluated, newest last."""
    return sorted(path.parent for path in (logdir / env / algo).glob(f"seed_{seed}/*/eval.json"))


# --- collect ----------------------------------------------------------------------------------


def collect(env: str, algos: list[str], seeds: list[int], logdir: Path, raw: Path) -> None:
    """Copy what counts of finished runs to `raw/ENV/ALGO/seed_N.*`."""
    for algo in algos:
        for seed in seeds:
            for folder in finished(logdir, env, algo, seed)[-1:]:
                target = raw / env / algo
                target.mkdir(parents=True, exist_ok=True)
                for name in ("config.yaml", "versions.yaml"):
                    shutil.copy(folder / name, target / f"seed_{seed}-{name}")
                rows = read(folder)
                with (target / f"seed_{seed}.csv").open("w", newline="") as out:
                    writer = csv.writer(out, lineterminator="\n")
                    writer.writerow(COLUMNS)
                    writer.writerows([short(row.get(name)) for name in COLUMNS] for row in rows)
                evaluation = json.loads((folder / "eval.json").read_text())
                summary = {
                    "greedy_win_rate": evaluation["win_rate"],
                    "greedy_return": evaluation["episode_return"],
                    "greedy_episodes": evaluation["episodes"],
                    "seconds": sum(row["time/seconds"] for row in rows),
                    "parameters": count_parameters(folder),
                }
                (target / f"seed_{seed}.json").write_text(json.dumps(summary, indent=1) + "\n")


def short(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def count_parameters(folder: Path) -> int:
    """Numbers that learning changes, without optimisers and target networks."""
    learner = jax.eval_shape(build(read_config(folder)).algorithm.init, jax.random.key(0))
    return sum(
        x.size for name, x in named(learner) if "_opt." not in name and "target." not in name
    )


# --- draw -------------------------------------------------------------------------------------


def read_raw(folder: Path) -> list[Run]:
    """The seeds of an algorithm."""
    runs = []
    for path in sorted(folder.glob("seed_*.csv")):
        with path.open() as file:
            rows = [row for row in csv.DictReader(file) if float(row["train/episodes"] or 0)]
        steps, episodes, win_rate, episode_return = (
            np.array([float(row[name]) for row in rows]) for name in COLUMNS[:4]
        )
        summary = json.loads(path.with_suffix(".json").read_text())
        runs.append(Run(steps, episodes, episodes * win_rate, episodes * episode_return, summary))
    return runs


def mean_between(run: Run, sums: np.ndarray, start: float, end: float) -> float:
    """Mean over the training episodes that ended in (start, end]; NaN without any."""
    inside = (run.steps > start) & (run.steps <= end)
    episodes = run.episodes[inside].sum()
    return sums[inside].sum() / episodes if episodes else np.nan


def curve(run: Run, sums: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Means over the window before each point of the grid."""
    return np.array([mean_between(run, sums, end - WINDOW, end) for end in grid])


def draw_band(axis: Axes, grid: np.ndarray, label: str, means: np.ndarray, style: dict) -> None:
    """The mean over seeds `[S, grid]`, shaded from the lowest to the highest."""
    shown = ~np.isnan(means).any(0)
    (line,) = axis.plot(grid[shown], means[:, shown].mean(0), label=label, **style)
    low, high = means[:, shown].min(0), means[:, shown].max(0)
    axis.fill_between(grid[shown], low, high, color=line.get_color(), alpha=0.15, linewidth=0)


def draw(env: str, algos: list[str], raw: Path, out: Path) -> None:
    """Curves as a picture, and a Markdown table on stdout."""
    groups = {algo: read_raw(raw / env / algo) for algo in algos}
    groups = {algo: runs for algo, runs in groups.items() if runs}
    total = min(run.steps[-1] for runs in groups.values() for run in runs)
    grid = np.arange(1_000, total + 1, 1_000)
    figure = Figure(figsize=(11, 4.4), layout="constrained")
    won, earned = figure.subplots(1, 2)
    print(
        f"| | win rate at {EARLY // 1000}k | win rate, last {LAST // 1000}k steps "
        f"| return, last {LAST // 1000}k steps | greedy win rate | steps to 50% wins | minutes "
        "| parameters |\n|---|---|---|---|---|---|---|---|"
    )
    for algo, runs in groups.items():
        style = {
            "linestyle": "-" if ALGORITHMS[algo].decentralised else "--",
            "color": f"C{list(ALGORITHMS).index(algo)}",  # one colour in all pictures
        }
        rates = np.stack([curve(run, run.wins, grid) for run in runs])
        draw_band(won, grid, algo, rates, style)
        returns = np.stack([curve(run, run.returns, grid) for run in runs])
        draw_band(earned, grid, algo, returns, style)
        reached = [
            next((int(g) for g, r in zip(grid, row, strict=True) if r >= 0.5), None)
            for row in rates
        ]
        last = [
            [
                mean_between(r, sums, r.steps[-1] - LAST, r.steps[-1])
                for r, sums in ((r, getattr(r, name)) for r in runs)
            ]
            for name in ("wins", "returns")
        ]
        early = [mean_between(run, run.wins, EARLY - WINDOW, EARLY) for run in runs]
        print(
            f"| {algo} | {listed(early)} | {listed(last[0])} | {listed(last[1])} "
            f"| {listed([r.summary['greedy_win_rate'] for r in runs])} "
            f"| {', '.join(f'{k:,}' if k else 'never' for k in reached)} "
            f"| {np.mean([r.summary['seconds'] for r in runs]) / 60:.1f} "
            f"| {runs[0].summary['parameters']:,} |"
        )
    won.set(ylabel="win rate in training", ylim=(0, None))
    earned.set(ylabel="episode return in training", ylim=(0, None))
    for axis in (won, earned):
        axis.set(xlabel="environment steps")
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        axis.grid(alpha=0.3)
    won.legend(frameon=False, ncols=2, title="dashed: centralised execution")
    figure.suptitle(f"{env}: mean, lowest and highest of {len(runs)} seeds")
    figure.savefig(out, dpi=130)


def listed(values: list[float]) -> str:
    """Mean and each seed's value."""
    return f"**{np.mean(values):.2f}** ({', '.join(f'{v:.2f}' for v in values)})"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("command", choices=("run", "collect", "draw"))
    parser.add_argument("--env", required=True)
    parser.add_argument("--algos", nargs="+", default=list(ALGORITHMS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--logdir", type=Path, default=Path("runs/compare"))
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--raw", type=Path, default=Path("docs/results/raw"))
    parser.add_argument("--out", type=Path, default=Path("curves.png"))
    given = sys.argv[1:]
    split = given.index("--") if "--" in given else len(given)
    args = parser.parse_args(given[:split])
    if args.command == "run":
        flags = given[split + 1 :]
        run(args.env, args.algos, args.seeds, args.logdir, args.jobs, flags)
    elif args.command == "collect":
        collect(args.env, args.algos, args.seeds, args.logdir, args.raw)
    else:
        draw(args.env, args.algos, args.raw, args.out)


if __name__ == "__main__":
    main()
