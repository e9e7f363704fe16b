"""Rows of finished runs: means over episodes, in the windows that are asked for."""

from pathlib import Path

import numpy as np
from benchmarks.suite_rows import row_of

from mabl.algorithms.presets import preset
from mabl.experiments.records import Record


def record(**changes) -> Record:
    """Cycles that ended 1, 3, 0 and 2 episodes by steps 1,500, 2,500, 5,000 and 6,400."""
    return Record(
        folder=Path("run"),
        config=preset("quick", "smax/3m", "mabl"),
        score="win_rate",
        steps=np.array([1_500.0, 2_500, 5_000, 6_400]),
        episodes=np.array([1.0, 3, 0, 2]),
        scores=np.array([0.0, 1.0, np.nan, 0.5]),
        returns=np.array([0.5, 1.5, np.nan, 1.0]),
        last_step=6_400,
        seconds=1.0,
        imagined=0.0,
        parameters=None,
        evaluation={"step": 6_400, "win_rate": [1.0, 0.0, 0.0, 0.0]},
        versions={"git": "abc"},
    )._replace(**changes)


def test_a_row_has_means_over_episodes_of_each_window():
    row = row_of(record(), [4_000, 6_400])
    assert (row["env"], row["algo"], row["seed"], row["step"]) == ("smax/3m", "mabl", 0, 6_400)
    assert (row["commit"], row["greedy"], row["episodes"]) == ("abc", 0.25, 4)
    assert row["training"] == {"4000": 0.75, "6400": 0.8}  # (0 + 3) / 4, (3 + 1) / 5
    assert row["return"] == {"4000": 1.25, "6400": 1.3}
    assert row["curve"] == [[2_000, 0.0], [4_000, 1.0]]


def test_a_run_that_was_not_evaluated_has_no_greedy_score_and_a_window_without_episodes_no_mean():
    row = row_of(record(evaluation=None), [1_000])
    assert "greedy" not in row and row["training"] == {"1000": None}
