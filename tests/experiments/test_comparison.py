"""What a report says of runs, worked out by hand."""

import json

import numpy as np
import pytest
from tests.experiments.runs import configured, make_comparison, make_run

from mabl import UserError
from mabl.experiments.comparison import POINTS, SMOOTHING, Comparison, mean_between
from mabl.experiments.jobs import Job
from mabl.experiments.records import collect, read_record
from mabl.experiments.tables import final_scores, in_steps, tables


def compare(logdir) -> Comparison:
    return Comparison(collect([logdir]))


def test_final_scores_are_of_the_last_15k_steps(tmp_path):
    for seed, last in enumerate((0.5, 0.7)):
        make_run(tmp_path, [0.0] * 45 + [last] * 15, seed=seed)
    (task,) = compare(tmp_path).tasks
    assert (task.end, task.last) == (60_000, 15_000)
    np.testing.assert_allclose(task.groups["mabl"].final, [0.5, 0.7])
    np.testing.assert_allclose(task.groups["mabl"].final_return, [1.0, 1.4])
    cells = dict(zip(*(lambda t: (t.headings, t.cells[0]))(final_scores(task)), strict=True))
    assert cells["win rate, mean ± sd"] == "0.60 ± 0.14"  # of a sample: .2 / sqrt(2)
    assert cells["least to greatest"] == "0.50 to 0.70" and cells["return"] == "1.20 ± 0.28"


def test_of_a_short_run_the_last_quarter_counts(tmp_path):
    make_run(tmp_path, [0.0] * 6 + [0.4, 0.8])
    (task,) = compare(tmp_path).tasks
    assert task.last == 2_000 and task.groups["mabl"].final == pytest.approx([0.6])


def test_a_task_ends_where_its_shortest_run_does(tmp_path):
    make_run(tmp_path, [0.1] * 20)
    make_run(tmp_path, [0.1] * 20 + [0.9] * 20, algo="mappo")
    (task,) = compare(tmp_path).tasks
    assert task.end == 20_000 and task.groups["mappo"].final == pytest.approx([0.1])


def test_every_episode_counts_alike(tmp_path):
    record = read_record(make_run(tmp_path, [0.2, 0.8]))
    record.episodes[:] = [30, 10]
    assert mean_between(record, record.scores, 0, 2_000) == pytest.approx(0.35)
    assert mean_between(record, record.scores, 1_000, 2_000) == pytest.approx(0.8)
    assert np.isnan(mean_between(record, record.scores, 2_000, 3_000))


def test_curves_are_exponential_moving_averages_over_episodes(tmp_path):
    make_run(tmp_path, [0.0, 1.0])
    (task,) = compare(tmp_path).tasks
    (curve,) = task.groups["mabl"].curves
    half = POINTS // 2
    assert np.isnan(curve[: half - 1]).all() and (curve[half - 1 : -1] == 0).all()
    old = SMOOTHING**half  # what the first cycle's episodes weigh by then, the second's being 1
    assert curve[-1] == pytest.approx(1 / (1 + old))


def test_steps_to_the_threshold_are_where_the_smoothed_curve_first_is_there(tmp_path):
    make_run(tmp_path, [0.0] * 10 + [1.0] * 90, seed=0)
    make_run(tmp_path, [0.0] * 100, seed=1)
    (task,) = compare(tmp_path).tasks
    reached = task.steps_to_threshold(task.groups["mabl"])
    weights = SMOOTHING ** np.arange(100)
    needed = next(n for n in range(1, 90) if weights[:n].sum() >= weights[n : n + 10].sum())
    assert reached.tolist() == [1_000 * (10 + needed), np.inf]
    assert in_steps(reached) == "never (1 of 2)" and in_steps(reached[:1]) == f"{10 + needed},000"


def test_scores_without_a_scale_are_normalised_over_what_was_seen(tmp_path):
    for k, algo in enumerate(("mabl", "mappo")):
        make_run(tmp_path, [100.0 * (k + 1)] * 40, algo, "mamujoco/Humanoid")
    comparison = compare(tmp_path)
    assert comparison.normalised("mabl") == [pytest.approx([0.0])]
    assert comparison.normalised("mappo") == [pytest.approx([1.0])]
    assert comparison.tasks[0].threshold == 150


def test_an_algorithm_that_lacks_a_task_is_not_compared_over_all(tmp_path):
    make_comparison(tmp_path)
    make_run(tmp_path, [0.5] * 40, "mabl-sg")
    comparison = compare(tmp_path)
    assert "mabl-sg" in comparison.tasks[1].groups
    assert comparison.everywhere == ["mabl", "mamba", "mappo"]
    assert set(comparison.aggregates["IQM"]) == set(comparison.everywhere)


def test_mabl_is_found_to_be_better_where_it_is(tmp_path):
    make_comparison(tmp_path)
    comparison = compare(tmp_path)
    found = comparison.improvements["mabl", "mappo"]
    assert found.value == 1.0 and found.low == 1.0
    iqms = comparison.aggregates["IQM"]
    assert iqms["mabl"].low > iqms["mamba"].high > iqms["mappo"].high


def test_the_newest_finished_run_of_a_seed_counts(tmp_path):
    make_run(tmp_path, [0.1] * 20)
    make_run(tmp_path, [0.6] * 20)
    make_run(tmp_path, [0.9] * 10, total_steps=20_000)
    comparison = compare(tmp_path)
    assert comparison.superseded == 1 and not comparison.missing
    assert comparison.tasks[0].groups["mabl"].final == pytest.approx([0.6])


def test_unfinished_seeds_are_named_and_do_not_count(tmp_path):
    make_run(tmp_path, [0.6] * 20)
    make_run(tmp_path, [0.9] * 10, seed=1, total_steps=20_000)
    comparison = compare(tmp_path)
    (gap,) = comparison.missing
    assert (gap.algorithm, gap.seed) == ("mabl", 1)
    assert gap.reason == "unfinished: 10,000 of 20,000 steps"
    assert len(comparison.tasks[0].groups["mabl"].records) == 1


def test_settings_of_one_algorithm_are_told_apart_by_their_labels(tmp_path):
    make_run(tmp_path, [0.6] * 20)
    make_run(tmp_path, [0.7] * 20, label="mabl-fast")
    assert compare(tmp_path).algorithms == ["mabl", "mabl-fast"]


def test_costs_are_counted(tmp_path):
    make_run(tmp_path, [0.6] * 20)
    costs = next(table for table in tables(compare(tmp_path)) if table.name == "costs")
    assert costs.cells == [["smax/3m", "mabl", "20,000", "1.0", "-", "1,000"]]


def test_where_nothing_is_finished_one_is_told(tmp_path):
    with pytest.raises(UserError, match="no finished run under"):
        collect([tmp_path])
    with pytest.raises(UserError, match="there is no folder"):
        collect([tmp_path / "none"])


def test_runs_with_older_settings_do_not_count(tmp_path):
    """Not even where the newer ones did not end: that is what is said then."""
    for seed in range(3):
        make_run(tmp_path, [0.1] * 20, seed=seed)
    make_run(tmp_path, [0.9] * 20, precision="float32")
    make_run(tmp_path, [0.9] * 10, seed=1, precision="float32", total_steps=20_000)
    comparison = compare(tmp_path)
    assert comparison.superseded == 3
    assert comparison.tasks[0].groups["mabl"].final == pytest.approx([0.9])
    assert [(gap.seed, gap.reason) for gap in comparison.missing] == [
        (1, "unfinished: 10,000 of 20,000 steps")
    ]


def test_a_seed_whose_last_episode_is_long_ago_counts_with_it(tmp_path):
    make_run(tmp_path, [0.2] * 60)
    path = make_run(tmp_path, [0.4] * 60, seed=1)
    rows = [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
    for row in rows[30:]:
        for name in [name for name in row if name.startswith("train/")]:
            del row[name]
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert compare(tmp_path).tasks[0].groups["mabl"].final == pytest.approx([0.2, 0.4])


def test_an_evaluation_of_an_older_policy_is_not_the_trained_ones(tmp_path):
    path = make_run(tmp_path, [0.2] * 20, evaluation=[1.0])
    assert compare(tmp_path).tasks[0].groups["mabl"].greedy == [1.0]
    (path / "checkpoints" / "step_20001").mkdir()
    assert np.isnan(compare(tmp_path).tasks[0].groups["mabl"].greedy).all()


SPOILT = {
    "config.yaml": "algo: nobody\n",
    "metrics.jsonl": "[]\n[]\n",
    "evaluation.json": '{"step": 20000}',
    "versions.yaml": "3",
}


@pytest.mark.parametrize("name", SPOILT)
def test_a_spoilt_run_is_named_and_the_others_are_compared(name, tmp_path):
    make_run(tmp_path, [0.2] * 20)
    (make_run(tmp_path, [0.9] * 20, seed=1, evaluation=[1.0]) / name).write_text(SPOILT[name])
    comparison = compare(tmp_path)
    assert len(comparison.unread) == 1
    assert comparison.tasks[0].groups["mabl"].final == pytest.approx([0.2])


def test_a_job_of_before_does_not_speak_for_newer_runs(tmp_path):
    """However many seeds it had, and whatever its file is called."""
    old = make_run(tmp_path, [0.1] * 20)
    for path, seeds in ((old, 5), (make_run(tmp_path, [0.9] * 20, precision="float32"), 2)):
        Job(configured(path), tuple(range(seeds)), eval_episodes=4).write()
    comparison = compare(tmp_path)
    assert comparison.superseded == 1
    assert comparison.tasks[0].groups["mabl"].final == pytest.approx([0.9])
    assert [(gap.seed, gap.reason) for gap in comparison.missing] == [(1, "not begun")]


def test_a_run_without_an_episode_up_to_the_common_end_is_missing(tmp_path):
    """It would be nowhere in curves, and no number at the end."""
    make_run(tmp_path, [0.1] * 2)
    path = make_run(tmp_path, [0.9] * 5, "mappo")
    rows = [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
    for row in rows[:3]:
        row["train/episodes"] = 0.0
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    comparison = compare(tmp_path)
    assert comparison.algorithms == comparison.everywhere == ["mabl"]
    (gap,) = comparison.missing
    assert gap[:3] == ("smax/3m", "mappo", 0) and "no episode ended by step 2,000" in gap.reason


def test_what_is_no_job_is_named(tmp_path):
    make_run(tmp_path, [0.2] * 20)
    (tmp_path / "sub" / "jobs").mkdir(parents=True)
    for k, text in enumerate(("3", "{config: {}}", "{seeds: [0]}", "a: [", "{config: {algo: x}}")):
        (tmp_path / "sub" / "jobs" / f"{k}.yaml").write_text(text)
    unread = compare(tmp_path).unread
    assert len(unread) == 5 and all("is not a job of a suite" in one for one in unread)


def test_of_many_algorithms_the_best_is_compared_with_each(tmp_path):
    for k in range(8):
        make_run(tmp_path, [k / 10] * 20, label=f"mabl-{k}")
    assert list(compare(tmp_path).improvements) == [
        ("mabl-7", f"mabl-{k}") for k in range(6, -1, -1)
    ]
