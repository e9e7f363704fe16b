"""A report's figures, each with the rows it is drawn from."""

import io
from collections.abc import Callable, Iterable
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter
from numpy.typing import NDArray

from mabl.algorithms.registry import ALGORITHMS
from mabl.experiments.comparison import Comparison, Task
from mabl.experiments.statistics import Estimate, estimate, iqm

matplotlib.use("agg")

WIDTH, HEIGHT = 4.4, 3.3
"""Inches of a panel: it is read at this size on a phone."""

# Okabe and Ito's, told apart by people who see colours differently; the yellow is left out, as it
# is too pale on white.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#A6761D", "#000000", "#7570B3")
MARKERS = "os^Dv<>P"

Row = dict[str, float | int | str]


class Picture(NamedTuple):
    """A figure, what it says in words, and its raw data."""

    name: str
    """Of its files."""
    title: str
    caption: str
    figure: Figure
    rows: list[Row]

    def image(self, kind: str) -> bytes:
        """As `svg` or `png`; the same bytes for the same figure."""
        out = io.BytesIO()
        with matplotlib.rc_context({"svg.hashsalt": "mabl"}):
            metadata = {"Date": None} if kind == "svg" else {"Software": None}
            self.figure.savefig(out, format=kind, dpi=160, metadata=metadata)
        return out.getvalue()


def pictures(comparison: Comparison) -> list[Picture]:
    """All of a report: per task, and over tasks."""
    per_task = [
        draw(comparison, task)
        for draw in (paper_curves, interval_curves)
        for task in comparison.tasks
    ]
    over_tasks = [aggregates, efficiency, profiles, improvements]
    if len(comparison.everywhere) < 2:
        over_tasks.remove(improvements)
    return per_task + [draw(comparison) for draw in over_tasks if comparison.everywhere]


def paper_curves(comparison: Comparison, task: Task) -> Picture:
    """Mean over seeds, shaded from the least to the greatest, as in figures 3 to 7."""

    def band(curves: NDArray[np.floating]) -> Estimate:
        return Estimate(curves.mean(0), curves.min(0), curves.max(0))

    return _curves(
        comparison,
        task,
        band,
        "mean",
        "mean",
        "Mean over seeds, shaded from the least to the greatest seed, as in the paper's figures",
    )


def interval_curves(comparison: Comparison, task: Task) -> Picture:
    """IQM over seeds, shaded over its 95% interval."""
    return _curves(
        comparison,
        task,
        lambda curves: estimate(iqm, curves.T),
        "iqm",
        "IQM",
        "Interquartile mean over seeds, shaded over its 95% bootstrap interval",
    )


def _curves(
    comparison: Comparison,
    task: Task,
    band: Callable[[NDArray[np.floating]], Estimate],
    kind: str,
    short: str,
    what: str,
) -> Picture:
    figure, axes = _panel()
    rows: list[Row] = []
    for name, group in task.groups.items():
        shown = ~np.isnan(group.curves).any(0)
        steps, drawn = task.grid[shown], band(group.curves[:, shown])
        _line(axes, comparison, name, steps, drawn)
        rows += [
            {"algorithm": name, "step": round(float(step)), kind: y, "low": low, "high": high}
            | {f"seed_{r.config.seed}": c[k] for r, c in zip(group.records, curves, strict=True)}
            for curves in [group.curves[:, shown]]
            for k, (step, y, low, high) in enumerate(zip(steps, *drawn, strict=True))
        ]
    axes.set(xlabel="environment steps", ylabel=f"{words(task.score)} in training")
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_xlim(0, task.end)
    if task.low == 0:
        axes.set_ylim(bottom=0)
    _legend(axes)
    return Picture(
        f"curve_{kind}_{slug(task.name)}",
        f"{task.name}: {words(task.score)}, {short}",
        f"{what}; exponential moving average over the training episodes.",
        figure,
        rows,
    )


def aggregates(comparison: Comparison) -> Picture:
    """IQM, median, mean and optimality gap over all runs on all tasks."""
    results = comparison.aggregates
    figure = Figure((WIDTH, 2 * (0.7 + 0.3 * len(comparison.everywhere))), layout="constrained")
    panels = figure.subplots(2, 2, sharey=True).ravel()
    rows: list[Row] = []
    for axes, (statistic, by_algorithm) in zip(panels, results.items(), strict=True):
        for k, (name, found) in enumerate(by_algorithm.items()):
            _interval(axes, k, found, _colour(comparison, name))
            rows.append({"statistic": statistic, "algorithm": name, **_numbers(found)})
        axes.set_title(statistic, fontsize=10)
        axes.set_yticks(range(len(by_algorithm)), list(by_algorithm))
        axes.locator_params(axis="x", nbins=4)
        axes.grid(axis="x", alpha=0.3)
    panels[0].invert_yaxis()
    return Picture(
        "aggregates",
        "Over all tasks",
        "Normalised scores of the last steps over all runs on all tasks: a line for the value, a "
        "bar for its 95% interval from a stratified bootstrap. Less is better for the optimality "
        "gap.",
        figure,
        rows,
    )


def efficiency(comparison: Comparison) -> Picture:
    """IQM over all tasks along the budget."""
    figure, axes = _panel()
    rows: list[Row] = []
    for name, found in comparison.efficiency.items():
        share = np.linspace(1 / len(found.value), 1, len(found.value))
        _line(axes, comparison, name, share, found)
        rows += [
            {"algorithm": name, "budget": s, **_numbers(Estimate(*at))}
            for s, *at in zip(share, *found, strict=True)
        ]
    axes.set(xlabel="share of each task's steps", ylabel="IQM of normalised scores")
    axes.xaxis.set_major_formatter(PercentFormatter(1))
    axes.set_xlim(0, 1)
    axes.set_ylim(bottom=0)
    _legend(axes)
    return Picture(
        "sample_efficiency",
        "Sample efficiency",
        "Interquartile mean over all runs on all tasks, along each task's budget, with its 95% "
        "interval.",
        figure,
        rows,
    )


def profiles(comparison: Comparison) -> Picture:
    """Which share of runs is above each score."""
    thresholds = np.linspace(0, 1, 101)
    figure, axes = _panel()
    rows: list[Row] = []
    for name, found in comparison.profiles(thresholds).items():
        _line(axes, comparison, name, thresholds, found)
        rows += [
            {"algorithm": name, "threshold": t, **_numbers(Estimate(*at))}
            for t, *at in zip(thresholds, *found, strict=True)
        ]
    axes.set(xlabel="normalised score τ", ylabel="share of runs above τ", xlim=(0, 1), ylim=(0, 1))
    _legend(axes)
    return Picture(
        "performance_profiles",
        "Performance profiles",
        "Share of all runs on all tasks whose score at the end is above τ, with its 95% interval.",
        figure,
        rows,
    )


def improvements(comparison: Comparison) -> Picture:
    """How likely a run of one algorithm beats a run of another."""
    found = comparison.improvements
    figure = Figure((WIDTH, 0.9 + 0.32 * len(found)), layout="constrained")
    axes = figure.subplots()
    for k, (one, other) in enumerate(found):
        _interval(axes, k, found[one, other], _colour(comparison, one))
    axes.axvline(0.5, color="#555", linestyle=":", linewidth=1)
    axes.set_yticks(range(len(found)), [f"{one} > {other}" for one, other in found])
    axes.set(xlim=(0, 1), xlabel="probability")
    axes.grid(axis="x", alpha=0.3)
    axes.invert_yaxis()
    return Picture(
        "probability_of_improvement",
        "Probability of improvement",
        "How likely a run of the first scores higher at the end than a run of the second on the "
        "same task, mean over tasks, with its 95% interval; ties count half.",
        figure,
        [{"first": a, "second": b, **_numbers(at)} for (a, b), at in found.items()],
    )


def _panel() -> tuple[Figure, Axes]:
    figure = Figure((WIDTH, HEIGHT), layout="constrained")
    axes = figure.subplots()
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _line(axes: Axes, comparison: Comparison, name: str, x: NDArray, y: Estimate) -> None:
    k = comparison.algorithms.index(name)
    first = next(g.records[0] for t in comparison.tasks for n, g in t.groups.items() if n == name)
    decentralised = ALGORITHMS[first.config.algo].decentralised
    colour = _colour(comparison, name)
    every = max(1, len(x) // 6)
    axes.plot(
        x,
        y.value,
        label=name if decentralised else f"{name} (centralised)",
        color=colour,
        linestyle="-" if decentralised else "--",
        linewidth=1.6,
        marker=MARKERS[k % len(MARKERS)],
        markersize=4,
        markevery=(k * every // 4 % every, every),  # lines that coincide show both
    )
    axes.fill_between(x, y.low, y.high, color=colour, alpha=0.15, linewidth=0)


def _interval(axes: Axes, at: int, found: Estimate, colour: str) -> None:
    """A bar for the interval, a line for the value."""
    low, high = (float(np.where(np.isnan(x), found.value, x)) for x in found[1:])
    axes.barh(at, high - low, left=low, height=0.55, color=colour, alpha=0.45)
    axes.plot([found.value] * 2, [at - 0.27, at + 0.27], color="black", linewidth=1.8)


def _legend(axes: Axes) -> None:
    axes.legend(
        loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False, fontsize=8.5,
        handlelength=2.4, columnspacing=1.2,
    )  # fmt: skip


def _colour(comparison: Comparison, name: str) -> str:
    return COLOURS[comparison.algorithms.index(name) % len(COLOURS)]


def _numbers(found: Estimate) -> Row:
    return {"value": float(found.value), "low": float(found.low), "high": float(found.high)}


def words(name: str) -> str:
    """A metric's name, for people."""
    return name.replace("_", " ")


def slug(name: str) -> str:
    """A name for a file."""
    return "".join(c if c.isalnum() or c in "-." else "_" for c in name)


def columns(rows: Iterable[Row]) -> list[str]:
    """All names in rows, in the order in which they come up."""
    return list(dict.fromkeys(name for row in rows for name in row))
