"""A report's tables: numbers for files, and cells for people."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mabl.experiments.comparison import Comparison, Task
from mabl.experiments.figures import Row, words
from mabl.experiments.statistics import Estimate, estimate, iqm

NONE = "-"


class Table(NamedTuple):
    """Rows for people, and the numbers behind them."""

    name: str
    title: str
    caption: str
    headings: list[str]
    cells: list[list[str]]
    rows: list[Row]


def tables(comparison: Comparison) -> list[Table]:
    """One for each task, the seeds behind them, and one over all tasks."""
    per_task = [final_scores(task) for task in comparison.tasks]
    overall = [over_tasks(comparison)] if comparison.everywhere else []
    return [*overall, *per_task, costs(comparison), seeds(comparison)]


def final_scores(task: Task) -> Table:
    """What each algorithm reached on a task, and how soon."""
    score = words(task.score)
    headings = [
        "algorithm", "seeds", f"{score}, mean ± sd", "IQM [95%]", "median", "least to greatest",
        "return", f"greedy {score}", "area under curve", f"steps to {shown(task.threshold)}",
    ]  # fmt: skip
    rows: list[Row] = []
    cells = []
    for name, group in task.groups.items():
        middle = estimate(iqm, group.final)
        reached = task.steps_to_threshold(group)
        rows.append(
            {
                "algorithm": name,
                "seeds": len(group.records),
                "mean": group.final.mean(),
                "standard_deviation": spread(group.final),
                "iqm": float(middle.value),
                "iqm_low": float(middle.low),
                "iqm_high": float(middle.high),
                "median": float(np.median(group.final)),
                "least": group.final.min(),
                "greatest": group.final.max(),
                "return": group.final_return.mean(),
                "greedy": mean_of_known(group.greedy),
                "area_under_curve": task.area(group).mean(),
                "threshold": task.threshold,
                "median_steps_to_threshold": float(np.median(reached)),
                "seeds_that_reached_it": int(np.isfinite(reached).sum()),
            }
        )
        cells.append(
            [
                name,
                str(len(group.records)),
                with_spread(group.final),
                with_interval(middle),
                shown(np.median(group.final)),
                f"{shown(group.final.min())} to {shown(group.final.max())}",
                with_spread(group.final_return),
                with_spread(group.greedy),
                shown(task.area(group).mean()),
                in_steps(reached),
            ]
        )
    return Table(
        f"final_{task.name}",
        task.name,
        f"Training episodes of the last {task.last:,} of {task.end:,} environment steps, the mean "
        "of each seed; ± is the standard deviation over seeds. Greedy: the trained policy's "
        f"{episodes_of(task)} after training. Steps to a {score}: the median seed's, where its "
        "smoothed curve first gets there.",
        headings,
        cells,
        rows,
    )


def over_tasks(comparison: Comparison) -> Table:
    """The aggregates as numbers."""
    found = comparison.aggregates
    rows: list[Row] = [
        {"algorithm": name}
        | {
            f"{s}{end}": float(v)
            for s in found
            for end, v in zip(ENDS, found[s][name], strict=True)
        }
        for name in comparison.everywhere
    ]
    cells = [
        [name, *(with_interval(found[s][name]) for s in found)] for name in comparison.everywhere
    ]
    return Table(
        "over_all_tasks",
        "Over all tasks",
        "Normalised scores of the last steps: win rates as they are, others from the least to the "
        "greatest that any curve of the task has. In brackets 95% intervals of a stratified "
        "bootstrap over seeds.",
        ["algorithm", *found],
        cells,
        rows,
    )


def costs(comparison: Comparison) -> Table:
    """What runs took."""
    rows: list[Row] = []
    cells = []
    for task in comparison.tasks:
        for name, group in task.groups.items():
            records = group.records
            sizes = [r.parameters for r in records if r.parameters is not None]
            numbers: Row = {
                "task": task.name,
                "algorithm": name,
                "environment_steps": float(np.mean([r.last_step for r in records])),
                "minutes": float(np.mean([r.seconds for r in records])) / 60,
                "parameters": sizes[0] if sizes else float("nan"),
                "imagined_steps": float(np.mean([r.imagined for r in records])),
            }
            rows.append(numbers)
            steps, minutes, size, imagined = list(numbers.values())[2:]
            cells.append(
                [
                    task.name,
                    name,
                    whole(steps),
                    f"{minutes:.1f}",
                    whole(size),
                    whole(imagined) if imagined else NONE,
                ]
            )
    return Table(
        "costs",
        "What it took",
        "Means over seeds. Minutes are of the program that trained a seed; seeds that were trained "
        "in one program share its minutes. Imagined: joint steps in the world model that policies "
        "learned from.",
        ["task", "algorithm", "environment steps", "minutes", "parameters", "imagined steps"],
        cells,
        rows,
    )


def seeds(comparison: Comparison) -> Table:
    """Every seed's numbers: what all else is computed from."""
    rows: list[Row] = []
    for task in comparison.tasks:
        for name, group in task.groups.items():
            for k, record in enumerate(group.records):
                rows.append(
                    {
                        "task": task.name,
                        "algorithm": name,
                        "seed": record.config.seed,
                        "score": group.final[k],
                        "return": group.final_return[k],
                        "greedy": group.greedy[k],
                        "commit": record.versions.get("git", ""),
                        "run": str(record.folder),
                    }
                )
    return Table(
        "seeds",
        "Every seed",
        "Final score and return in training, and the greedy policy's score.",
        ["task", "algorithm", "seed", "score", "return", "greedy"],
        [
            [str(r["task"]), str(r["algorithm"]), str(r["seed"])]
            + [shown(float(r[name])) for name in ("score", "return", "greedy")]
            for r in rows
        ],
        rows,
    )


ENDS = ("", "_low", "_high")
"""Of columns: a value, and its interval."""


def spread(values: NDArray[np.floating]) -> float:
    """The standard deviation over seeds, of a sample; NaN of one."""
    return float(values.std(ddof=1)) if len(values) > 1 else float("nan")


def mean_of_known(values: NDArray[np.floating]) -> float:
    """Over seeds that have a value; NaN without one."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else float("nan")


def with_spread(values: NDArray[np.floating]) -> str:
    """Mean and standard deviation over seeds that have a value."""
    values = values[~np.isnan(values)]
    if not len(values):
        return NONE
    return f"{shown(values.mean())} ± {shown(spread(values))}"


def with_interval(found: Estimate) -> str:
    """A value and its interval."""
    if np.isnan(found.low):
        return shown(found.value)
    return f"{shown(found.value)} [{shown(found.low)}, {shown(found.high)}]"


def in_steps(reached: NDArray[np.floating]) -> str:
    """The median seed's steps, and how many seeds got there."""
    n, middle = int(np.isfinite(reached).sum()), float(np.median(reached))
    if n == 0:
        return "never"
    said = whole(middle) if np.isfinite(middle) else "never"
    return said if n == len(reached) else f"{said} ({n} of {len(reached)})"


def episodes_of(task: Task) -> str:
    """How many greedy episodes were played."""
    counts = {
        len(record.evaluation[task.score])
        for group in task.groups.values()
        for record in group.records
        if record.evaluation
    }
    return f"{' or '.join(map(str, sorted(counts)))} episodes" if counts else "episodes"


def shown(value: Any) -> str:
    """Three significant digits, two decimals at most."""
    number = float(value)
    if np.isnan(number):
        return NONE
    return f"{number:.2f}" if abs(number) < 100 else f"{number:,.0f}"


def whole(value: float | int | str) -> str:
    """A count."""
    return NONE if np.isnan(float(value)) else f"{float(value):,.0f}"
