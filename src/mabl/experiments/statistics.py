"""Statistics of few runs on several tasks, as Agarwal et al. ("Deep RL at the edge of the
statistical precipice", 2021) ask for them.

Scores come as one array `[..., S]` for each task, of as many seeds as that task has; leading axes
are worked on side by side. Intervals are percentiles of a bootstrap that draws seeds anew within
each task.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import bootstrap, trim_mean

Scores = Sequence[NDArray[np.floating]]
Statistic = Callable[..., NDArray[np.floating]]
"""Of samples `[..., S]`, one for each task, along the keyword `axis`."""

CONFIDENCE = 0.95
RESAMPLES = 2_000


class Estimate(NamedTuple):
    """A statistic and its interval, each `[...]`; NaN where a task has one seed only."""

    value: NDArray[np.floating]
    low: NDArray[np.floating]
    high: NDArray[np.floating]


def mean(*tasks: NDArray[np.floating], axis: int = -1) -> NDArray[np.floating]:
    """Of all runs."""
    return np.concatenate(tasks, axis).mean(axis)


def median(*tasks: NDArray[np.floating], axis: int = -1) -> NDArray[np.floating]:
    """Over tasks, of the means over their runs."""
    return np.median(np.stack([task.mean(axis) for task in tasks]), 0)


def iqm(*tasks: NDArray[np.floating], axis: int = -1) -> NDArray[np.floating]:
    """Interquartile mean: of the middle half of all runs."""
    return trim_mean(np.concatenate(tasks, axis), 0.25, axis)


def optimality_gap(*tasks: NDArray[np.floating], axis: int = -1) -> NDArray[np.floating]:
    """How far runs stay below a score of 1, on average; what is above 1 makes up for nothing."""
    return 1.0 - np.minimum(np.concatenate(tasks, axis), 1.0).mean(axis)


def improvement(*tasks: NDArray[np.floating], axis: int = -1) -> NDArray[np.floating]:
    """Probability that a run of one algorithm beats one of another, mean over tasks; ties: half.

    The first half of the arguments are the one's scores by task, the second half the other's.
    """
    one, other = tasks[: len(tasks) // 2], tasks[len(tasks) // 2 :]

    def on_task(x: NDArray[np.floating], y: NDArray[np.floating]) -> NDArray[np.floating]:
        difference = np.moveaxis(x, axis, -1)[..., :, None] - np.moveaxis(y, axis, -1)[..., None, :]
        return (0.5 + 0.5 * np.sign(difference)).mean((-2, -1))

    return np.mean([on_task(x, y) for x, y in zip(one, other, strict=True)], axis=0)


AGGREGATES: dict[str, Statistic] = {
    "IQM": iqm,
    "median": median,
    "mean": mean,
    "optimality gap": optimality_gap,
}
"""What is told of an algorithm over all tasks."""


def profile(tasks: Scores, thresholds: NDArray[np.floating]) -> Scores:
    """Whether each run is above each threshold, `[thresholds, S]`: their `mean` is the profile."""
    return [(task[None] > thresholds[:, None]).astype(float) for task in tasks]


def estimate(statistic: Statistic, *tasks: NDArray[np.floating], seed: int = 0) -> Estimate:
    """A statistic with its 95% interval. `seed` decides what the bootstrap draws."""
    value = np.asarray(statistic(*tasks))
    if any(task.shape[-1] < 2 for task in tasks):
        return Estimate(value, np.full_like(value, np.nan), np.full_like(value, np.nan))
    interval = bootstrap(
        tasks,
        statistic,
        n_resamples=RESAMPLES,
        vectorized=True,
        axis=-1,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return Estimate(value, np.asarray(interval.low), np.asarray(interval.high))
