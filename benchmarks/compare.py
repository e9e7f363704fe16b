"""Algorithms side by side on one environment: run them, keep what counts, draw it.

    uv run python -m benchmarks.compare run --env smax/3m --seeds 0 1 2 --jobs 4
    uv run python -m benchmarks.compare collect --env smax/3m --raw docs/results/raw
    uv run python -m benchmarks.compare draw --env smax/3m --raw docs/results/raw --out 3m.png
    uv run python -m benchmarks.compare draw --env flatland/5_agents --own-budgets --line random=.1

`run` pins every run to a core of its own and leaves out what is finished; what follows `--` are
flags of `mabl train`. Score and return at a step are those of the training episodes in the window
of steps before it. With `--own-budgets` algorithms are drawn, over a logarithm, to their own ends.
"""

import argparse
import csv
import json
import os
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from operator import attrgetter
from pathlib import Path
from queue import Queue
from typing import NamedTuple

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from mabl.algorithms.registry import ALGORITHMS
from mabl.envs import registry
from mabl.runs.checkpoint import named
from mabl.runs.folder import read_config
from mabl.runs.metrics import read
from mabl.training.programs import build

WINDOW = 4_000
"""Environment steps over which training episodes are averaged in curves."""
LAST = 15_000
"""Environment steps at the end that the table averages over, as the paper's table 1."""
EARLY = 20_000
"""Environment steps at which the table looks at scores early on."""


class Run(NamedTuple):
    """One seed's cycles `[cycles]` in which episodes ended, and what was made of the run."""

    steps: np.ndarray
    episodes: np.ndarray
    scores: np.ndarray
    returns: np.ndarray
    summary: dict


def columns(score: str) -> tuple[str, ...]:
    """Of a raw file."""
    return ("step", "train/episodes", f"train/{score}", "train/episode_return", "time/seconds")


def slug(env: str) -> str:
    """A name that any file system takes."""
    return re.sub(r"[^\w./]+", "-", env)


# --- run --------------------------------------------------------------------------------------


def run(args: argparse.Namespace, flags: list[str]) -> None:
    """Train and evaluate every algorithm with every seed, `jobs` at a time."""
    env, logdir = args.env, args.logdir
    cores: Queue[int] = Queue()
    for core in sorted(os.sched_getaffinity(0))[: args.jobs]:
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
            pinned(core, command, logdir / f"{slug(env).replace('/', '-')}-{algo}-{seed}.log")
            folder = max((logdir / env / algo / f"seed_{seed}").iterdir())
            command = ["mabl", "eval", str(folder), "--episodes", str(args.episodes), "--json"]
            for way in ("sample", "greedy"):
                pinned(core, [*command, f"--{way}"], folder / "eval.tmp")
                (folder / "eval.tmp").rename(folder / f"{way}.json")
            print(f"{env} {algo} seed {seed}: {(folder / 'greedy.json').read_text().strip()}")
        finally:
            cores.put(core)

    with ThreadPoolExecutor(args.jobs) as pool:
        for done in [pool.submit(one, algo, seed) for algo in args.algos for seed in args.seeds]:
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
    return sorted(path.parent for path in (logdir / env / algo).glob(f"seed_{seed}/*/greedy.json"))


# --- collect ----------------------------------------------------------------------------------


def collect(env: str, algos: list[str], seeds: list[int], logdir: Path, raw: Path) -> None:
    """Copy what counts of finished runs to `raw/ENV/ALGO/seed_N.*`."""
    score = registry.make(env).spec.score_name
    for algo in algos:
        for seed in seeds:
            for folder in finished(logdir, env, algo, seed)[-1:]:
                target = raw / slug(env) / algo
                target.mkdir(parents=True, exist_ok=True)
                for name in ("config.yaml", "versions.yaml"):
                    shutil.copy(folder / name, target / f"seed_{seed}-{name}")
                rows = read(folder)
                with (target / f"seed_{seed}.csv").open("w", newline="") as out:
                    writer = csv.writer(out, lineterminator="\n")
                    writer.writerow(columns(score))
                    writer.writerows(
                        [short(row.get(name)) for name in columns(score)] for row in rows
                    )
                played = {
                    way: json.loads((folder / f"{way}.json").read_text())
                    for way in ("greedy", "sample")
                }
                summary = {
                    f"{way}_{short_name}": results[name]
                    for way, results in played.items()
                    for short_name, name in (
                        (score, score),
                        ("return", "episode_return"),
                        ("episodes", "episodes"),
                    )
                } | {
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
        steps, episodes, score, episode_return = (
            np.array(column, float)
            for column in list(zip(*map(dict.values, rows), strict=True))[:4]
        )
        summary = json.loads(path.with_suffix(".json").read_text())
        runs.append(Run(steps, episodes, episodes * score, episodes * episode_return, summary))
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


def draw(args: argparse.Namespace) -> None:
    """Curves as a picture, and a Markdown table on stdout."""
    score = registry.make(args.env).spec.score_name
    groups = {algo: read_raw(args.raw / slug(args.env) / algo) for algo in args.algos}
    groups = {algo: runs for algo, runs in groups.items() if runs}
    ends = {algo: min(run.steps[-1] for run in runs) for algo, runs in groups.items()}
    shared = min(ends.values())
    grids = {
        algo: np.arange(1_000, (end if args.own_budgets else shared) + 1, 1_000)
        for algo, end in ends.items()
    }
    panels = {score: "scores"} if score == "score" else {score: "scores", "return": "returns"}
    figure = Figure(figsize=(11, 4.4) if len(panels) == 2 else (7, 4.4), layout="constrained")
    axes = np.ravel(figure.subplots(1, len(panels)))
    for axis, (name, field) in zip(axes, panels.items(), strict=True):
        for algo, runs in groups.items():
            style = {
                "linestyle": "-" if ALGORITHMS[algo].decentralised else "--",
                "color": f"C{list(ALGORITHMS).index(algo)}",  # one colour in all pictures
            }
            curves = np.stack([curve(run, getattr(run, field), grids[algo]) for run in runs])
            draw_band(axis, grids[algo], algo, curves, style)
        axis.set(xlabel="environment steps", ylabel=f"{name.replace('_', ' ')} in training")
        if args.own_budgets:
            axis.set_xscale("log")
        elif name in (score, "return") and axis.get_ylim()[0] > -1:
            axis.set_ylim(0, None)
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        axis.grid(alpha=0.3)
    for k, line in enumerate(args.line):
        label, value = line.split("=")
        axes[0].axhline(float(value), color="grey", linestyle=(":", "-.")[k % 2], label=label)
    axes[0].legend(frameon=False, ncols=2, title="dashed: centralised execution")
    n_seeds = max(map(len, groups.values()))
    figure.suptitle(f"{args.env}: mean, lowest and highest of {n_seeds} seeds")
    figure.savefig(args.out, dpi=130)
    print_table(groups, grids, score, int(shared), args.threshold)


def print_table(
    groups: dict[str, list[Run]],
    grids: dict[str, np.ndarray],
    score: str,
    shared: int,
    threshold: float,
) -> None:
    """Markdown; what is said `at` a step is of the window before it."""
    name, last = score.replace("_", " "), f"last {LAST // 1000}k steps"
    headings = [
        *("", f"{name} at {EARLY // 1000}k", f"{name} at {shared // 1000}k", f"{name}, {last}"),
        *(f"return, {last}", f"greedy {name}", f"sampled {name}", f"steps to {threshold:g}"),
        *("steps", "minutes", "parameters"),
    ]
    print(f"| {' | '.join(headings)} |\n|{'---|' * len(headings)}")
    for algo, runs in groups.items():
        curves = [curve(run, run.scores, grids[algo]) for run in runs]
        reached = [grids[algo][row >= threshold] for row in curves]
        cells = [
            algo,
            *(
                listed([mean_between(r, r.scores, k - WINDOW, k) for r in runs])
                for k in (EARLY, shared)
            ),
            *(
                listed([mean_between(r, sums(r), r.steps[-1] - LAST, r.steps[-1]) for r in runs])
                for sums in (attrgetter("scores"), attrgetter("returns"))
            ),
            *(
                listed([r.summary.get(f"{way}_{score}", np.nan) for r in runs])
                for way in ("greedy", "sample")
            ),
            ", ".join(f"{steps[0]:,.0f}" if len(steps) else "never" for steps in reached),
            f"{runs[0].steps[-1]:,.0f}",
            f"{np.mean([r.summary['seconds'] for r in runs]) / 60:.1f}",
            f"{runs[0].summary['parameters']:,}",
        ]
        print(f"| {' | '.join(cells)} |")


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
    parser.add_argument("--episodes", type=int, default=256, help="to play after training")
    parser.add_argument("--own-budgets", action="store_true")
    parser.add_argument("--line", action="append", default=[], metavar="NAME=SCORE")
    parser.add_argument("--threshold", type=float, default=0.5, help="of the score")
    given = sys.argv[1:]
    split = given.index("--") if "--" in given else len(given)
    args = parser.parse_args(given[:split])
    if args.command == "run":
        flags = given[split + 1 :]
        run(args, flags)
    elif args.command == "collect":
        collect(args.env, args.algos, args.seeds, args.logdir, args.raw)
    else:
        draw(args)


if __name__ == "__main__":
    main()
