"""Write one line of JSON for each finished run of a suite, to be kept with published results.

    uv run python -m benchmarks.suite_rows runs/equal-steps-20k --at 20000 > rows.jsonl

A row has the run's task, algorithm or label, seed, steps and commit; `greedy`, the mean score of
the greedy episodes after the last step, if it was evaluated; `training`, the mean score of the
training episodes of the last `WINDOW` environment steps before each `--at`, and `return`, their
mean return; and `curve`, the mean score of the training episodes of every `POINT` steps.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mabl.experiments.records import Record, collect

WINDOW = 4_000
POINT = 2_000


def mean_between(record: Record, values: NDArray[np.floating], low: int, high: int) -> float | None:
    """Mean over the training episodes that ended after step `low`, up to `high`."""
    inside = (record.steps > low) & (record.steps <= high) & np.isfinite(values)
    episodes = record.episodes[inside]
    if not episodes.sum():
        return None
    return round(float(np.average(values[inside], weights=episodes)), 4)


def row_of(record: Record, at: list[int]) -> dict[str, Any]:
    """Summarise one run as one row."""
    task, algorithm, seed = record.key
    row: dict[str, Any] = {
        "env": task,
        "algo": algorithm,
        "seed": seed,
        "step": record.last_step,
        "commit": record.versions.get("git"),
        "score": record.score,
    }
    if record.evaluation is not None:
        scores = record.evaluation[record.score]
        row |= {"greedy": round(float(np.mean(scores)), 4), "episodes": len(scores)}
    for name, values in (("training", record.scores), ("return", record.returns)):
        row[name] = {str(step): mean_between(record, values, step - WINDOW, step) for step in at}
    ends = range(POINT, record.last_step + 1, POINT)
    means = ((end, mean_between(record, record.scores, end - POINT, end)) for end in ends)
    row["curve"] = [[end, mean] for end, mean in means if mean is not None]
    return row


def main() -> None:
    """Print the rows, ordered by task, algorithm and seed."""
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("folders", nargs="+", type=Path, help="suites, or any folders of runs")
    parser.add_argument("--at", nargs="+", type=int, required=True, help="environment steps")
    options = parser.parse_args()
    for record in sorted(collect(options.folders).records, key=lambda record: record.key):
        print(json.dumps(row_of(record, options.at)))


if __name__ == "__main__":
    main()
