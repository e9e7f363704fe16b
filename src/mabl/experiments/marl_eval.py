"""Runs in the JSON format of marl-eval (Gorsane et al., 2022), for its tools and others'.

{env: {task: {algorithm: {seed_k: {step_i: {step_count, metric: [value]}, absolute_metrics}}}}}
"""

from typing import Any

import numpy as np

from mabl.errors import UserError
from mabl.experiments.comparison import Comparison, Group, Task, known, mean_between

STEPS = 20
"""Points of a run: training episodes since the one before."""


def exported(comparison: Comparison) -> dict[str, Any]:
    """All tasks, with as many seeds of each algorithm as the fewest has.

    A point's value is the mean of the training episodes since the last point in which some ended,
    `absolute_metrics` are the greedy episodes of the trained policy. The format asks for the same
    algorithms everywhere and as many seeds of each: algorithms that lack a task are left out.
    Raises UserError if no algorithm has runs, evaluated, on all tasks.
    """
    groups = {
        name: [task.groups[name] for task in comparison.tasks] for name in comparison.everywhere
    }
    complete = {name: all(map(evaluated, found)) for name, found in groups.items()}
    names = [name for name, whole in complete.items() if whole]
    if not names:
        raise UserError(
            "marl-eval needs every algorithm evaluated on every task: run them with mabl suite run"
        )
    n_seeds = min(len(group.records) for name in names for group in groups[name])
    out: dict[str, Any] = {}
    for task in comparison.tasks:
        family, _, rest = task.name.partition("/")
        runs = {
            name.replace(",", " "): {
                f"seed_{k}": run(task, task.groups[name], k) for k in range(n_seeds)
            }
            for name in names
        }
        out.setdefault(family, {})[rest or family] = runs
    return out


def evaluated(group: Group) -> bool:
    """Whether every seed was."""
    return all(record.evaluation for record in group.records)


def run(task: Task, group: Group, k: int) -> dict[str, Any]:
    """One seed: its points, and its greedy episodes."""
    record, columns = group.records[k], {}
    ends = np.linspace(task.end / STEPS, task.end, STEPS)
    played = record.evaluation or {}
    absolute = {name: list(map(float, played[name])) for name in (task.score, "episode_return")}
    for name, values in ((task.score, record.scores), ("episode_return", record.returns)):
        starts = ends - task.end / STEPS
        means = [mean_between(record, values, *at) for at in zip(starts, ends, strict=True)]
        columns[name] = held(np.array(means))
    for values in (columns, absolute):  # under a name that all tasks have, too
        values["score"] = values[task.score]
    points = {
        f"step_{i}": {"step_count": round(end)}
        | {name: [float(values[i])] for name, values in columns.items()}
        for i, end in enumerate(ends)
    }
    return points | {"absolute_metrics": absolute}


def held(values: np.ndarray) -> np.ndarray:
    """The last known value where there is none; before the first, that one."""
    found = ~np.isnan(values)
    last = np.maximum.accumulate(np.where(found, np.arange(len(values)), 0))
    return known(values[last][None])[0]
