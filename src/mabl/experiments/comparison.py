"""Runs side by side: curves on common grids, scores at the end, and what they say together."""

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mabl.algorithms.registry import ALGORITHMS
from mabl.experiments.records import Found, Missing, Record
from mabl.experiments.statistics import (
    AGGREGATES,
    Estimate,
    estimate,
    improvement,
    iqm,
    mean,
    profile,
)

POINTS = 100
"""Of a learning curve."""

SMOOTHING = 0.9
"""What a point of a curve keeps of the one before: an exponential moving average."""

LAST = 15_000
"""Environment steps at the end that tables average over, as in table 1; a quarter of shorter
budgets."""

UNIT_SCORES = ("win_rate", "arrived")
"""Scores from 0 to 1."""


PAIRED = 6
"""Algorithms, at most, of which every pair is compared."""


class Group(NamedTuple):
    """An algorithm's seeds on a task."""

    records: list[Record]
    curves: NDArray[np.floating]
    """Smoothed scores of training episodes `[S, POINTS]`; NaN before the first episode."""
    final: NDArray[np.floating]
    """Mean score of the training episodes of the last steps `[S]`."""
    final_return: NDArray[np.floating]
    """Their mean return `[S]`."""
    greedy: NDArray[np.floating]
    """Mean score of the trained policy's greedy episodes `[S]`; NaN without."""


class Task:
    """A task, and every algorithm's runs on it up to their common end."""

    def __init__(self, name: str, records: Sequence[Record], algorithms: Sequence[str]):
        self.name = name
        self.score = records[0].score
        self.end = min(record.last_step for record in records)
        self.last = min(LAST, self.end // 4)
        self.grid = np.linspace(self.end / POINTS, self.end, POINTS)
        self.groups = {
            algorithm: self._group([r for r in records if r.config.name == algorithm])
            for algorithm in algorithms
            if any(r.config.name == algorithm for r in records)
        }
        self.low, self.high = self._range()

    def _group(self, records: list[Record]) -> Group:
        records = sorted(records, key=lambda record: record.config.seed)

        def final(name: str) -> NDArray[np.floating]:
            return np.array([newest(r, getattr(r, name), self.last, self.end) for r in records])

        greedy = [np.mean(r.evaluation[self.score]) if r.evaluation else np.nan for r in records]
        curves = np.stack([curve(r, self.grid) for r in records])
        return Group(records, curves, final("scores"), final("returns"), np.array(greedy))

    def _range(self) -> tuple[float, float]:
        """Scores that normalise to 0 and 1: of the task, or the least and the greatest seen."""
        if self.score in UNIT_SCORES:
            return 0.0, 1.0
        seen = np.concatenate([group.curves.ravel() for group in self.groups.values()])
        return float(np.nanmin(seen)), float(np.nanmax(seen))

    def normalised(self, scores: NDArray[np.floating]) -> NDArray[np.floating]:
        """From 0 to 1."""
        return (scores - self.low) / ((self.high - self.low) or 1.0)

    @property
    def threshold(self) -> float:
        """The score to be reached: halfway."""
        return (self.low + self.high) / 2

    def steps_to_threshold(self, group: Group) -> NDArray[np.floating]:
        """Where each seed's curve first reaches it `[S]`; infinite where it does not."""
        reached = group.curves >= self.threshold
        return np.where(reached.any(1), self.grid[reached.argmax(1)], np.inf)

    def area(self, group: Group) -> NDArray[np.floating]:
        """Mean score along the curve `[S]`: the area under it, over the steps."""
        return np.nanmean(group.curves, axis=1)


class Comparison:
    """Everything that a report says."""

    def __init__(self, found: Found):
        self.superseded, self.unread = found.superseded, found.unread
        self.records, without = begun(found.records)
        self.missing: list[Missing] = [*found.missing, *without]
        names = {record.config.name for record in self.records}
        known = [name for name in ALGORITHMS if name in names]
        self.algorithms = [*known, *sorted(names - set(known))]
        by_task: dict[str, list[Record]] = {}
        for record in sorted(self.records, key=lambda record: record.key):
            by_task.setdefault(record.key[0], []).append(record)
        self.tasks = [Task(name, records, self.algorithms) for name, records in by_task.items()]

    @cached_property
    def everywhere(self) -> list[str]:
        """Algorithms with runs on every task: only these are compared over all of them."""
        return [name for name in self.algorithms if all(name in task.groups for task in self.tasks)]

    def normalised(self, algorithm: str) -> list[NDArray[np.floating]]:
        """Final scores by task, each `[S]`."""
        return [task.normalised(task.groups[algorithm].final) for task in self.tasks]

    @cached_property
    def aggregates(self) -> dict[str, dict[str, Estimate]]:
        """Over all tasks, by statistic and algorithm."""
        return {
            name: {a: estimate(statistic, *self.normalised(a)) for a in self.everywhere}
            for name, statistic in AGGREGATES.items()
        }

    @cached_property
    def improvements(self) -> dict[tuple[str, str], Estimate]:
        """Probability that the first beats the second: of each pair, or of many only the best's."""
        names = self.everywhere
        if len(names) > PAIRED:
            iqms = self.aggregates["IQM"]
            names = sorted(names, key=lambda name: -float(iqms[name].value))
        return {
            (one, other): estimate(improvement, *self.normalised(one), *self.normalised(other))
            for k, one in enumerate(names if len(names) <= PAIRED else names[:1])
            for other in names[k + 1 :]
        }

    def profiles(self, thresholds: NDArray[np.floating]) -> dict[str, Estimate]:
        """Share of runs above each threshold, by algorithm."""
        return {
            name: estimate(mean, *profile(self.normalised(name), thresholds))
            for name in self.everywhere
        }

    @cached_property
    def efficiency(self) -> dict[str, Estimate]:
        """IQM over all tasks after each hundredth of the budget, by algorithm."""
        return {
            name: estimate(
                iqm,
                *(task.normalised(known(task.groups[name].curves)).T for task in self.tasks),
            )
            for name in self.everywhere
        }


def begun(records: Sequence[Record]) -> tuple[list[Record], list[Missing]]:
    """Runs with an episode that ended before the shortest run of their task did, and the others."""
    ends: dict[str, int] = {}
    for record in records:
        task = record.key[0]
        ends[task] = min(ends.get(task, record.last_step), record.last_step)
    found, without = [], []
    for record in records:
        end = ends[record.key[0]]
        if (record.steps <= end).any():
            found.append(record)
        else:
            why = f"no episode ended by step {end:,}, where the shortest run of the task ends"
            without.append(Missing(*record.key, why))
    return found, without


def mean_between(record: Record, values: NDArray[np.floating], start: float, end: float) -> float:
    """Mean over the training episodes that ended in (start, end]; NaN without any."""
    inside = (record.steps > start) & (record.steps <= end)
    episodes = record.episodes[inside]
    return float((episodes * values[inside]).sum() / episodes.sum()) if episodes.sum() else np.nan


def newest(record: Record, values: NDArray[np.floating], last: float, end: float) -> float:
    """Mean over the training episodes of the last steps; of the last cycle before in which any
    ended, where none ended in them."""
    cycles = np.flatnonzero((record.steps <= end) & ~np.isnan(values))
    found = mean_between(record, values, end - last, end)
    return float(values[cycles[-1]]) if np.isnan(found) and len(cycles) else found


def curve(record: Record, grid: NDArray[np.floating]) -> NDArray[np.floating]:
    """Scores of training episodes, smoothed over the grid; every episode counts alike."""
    points = np.searchsorted(grid, record.steps)
    inside = points < len(grid)
    episodes, scores = np.zeros(len(grid)), np.zeros(len(grid))
    np.add.at(episodes, points[inside], record.episodes[inside])
    np.add.at(scores, points[inside], (record.episodes * record.scores)[inside])
    smoothed, weight, total = np.full(len(grid), np.nan), 0.0, 0.0
    for k in range(len(grid)):
        weight = SMOOTHING * weight + episodes[k]
        total = SMOOTHING * total + scores[k]
        if weight:
            smoothed[k] = total / weight
    return smoothed


def known(curves: NDArray[np.floating]) -> NDArray[np.floating]:
    """Curves with their first score for what is before it."""
    first = np.take_along_axis(curves, (~np.isnan(curves)).argmax(1)[:, None], 1)
    return np.where(np.isnan(curves), first, curves)
