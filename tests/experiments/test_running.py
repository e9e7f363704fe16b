"""Suites that run: whatever happens on the way, they end as if nothing had."""

import json
import signal
from dataclasses import replace

import pytest
from tests.experiments.tiny_suite import (
    finish,
    is_free,
    rows_of,
    runs_of,
    said,
    start,
    wait_for,
    write_suite,
)

from mabl import cli
from mabl.experiments import processes
from mabl.experiments.jobs import read_job, steps_done
from mabl.experiments.processes import LocalBackend
from mabl.experiments.running import Tally, conclude
from mabl.experiments.worker import preemptible

STEPS = 1_000


@pytest.fixture(scope="module")
def suite(tmp_path_factory):
    return write_suite(tmp_path_factory.mktemp("suite"), {"mappo": {}}, STEPS)


@pytest.fixture(scope="module")
def undisturbed(suite, tmp_path_factory):
    """Its log folder."""
    logdir = tmp_path_factory.mktemp("runs") / "whole"
    assert finish(suite, logdir) == 0
    return logdir


def test_every_seed_is_trained_and_evaluated(undisturbed):
    for seed in (0, 1):
        (run,) = runs_of(undisturbed, "mappo", seed)
        played = json.loads((run / "evaluation.json").read_text())
        assert played["step"] >= STEPS and played["greedy"] is True
        assert [len(played[name]) for name in ("score", "episode_return")] == [4, 4]
    assert "1 done" in said(undisturbed) and "next: mabl report" in said(undisturbed)


def test_what_is_done_is_kept(undisturbed, suite, mabl):
    before = [
        run.stat().st_mtime_ns for seed in (0, 1) for run in runs_of(undisturbed, "mappo", seed)
    ]
    assert finish(suite, undisturbed) == 0
    assert "1 done before" in said(undisturbed)
    after = [
        run.stat().st_mtime_ns for seed in (0, 1) for run in runs_of(undisturbed, "mappo", seed)
    ]
    assert before == after
    jobs = mabl("suite", "jobs", suite, f"--logdir={undisturbed}", "--total-steps=1000")
    assert jobs == (0, "", "")


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_a_suite_that_is_killed_goes_on_where_it_was(how, suite, undisturbed, tmp_path):
    """Its jobs save and end, and the next run of the suite waits for that."""
    logdir = tmp_path / "cut"
    process = start(suite, logdir)

    def is_going() -> bool:
        runs = runs_of(logdir, "mappo", 0)
        return bool(runs) and any((runs[0] / "checkpoints").glob("step_*"))

    wait_for(is_going)
    process.send_signal(how)
    assert process.wait(100) == (75 if how == signal.SIGTERM else -how)
    if how == signal.SIGTERM:
        assert is_free(runs_of(logdir, "mappo", 0)[0]) and "1 to go on" in said(logdir)
    assert finish(suite, logdir) == 0
    for seed in (0, 1):
        assert rows_of(logdir, "mappo", seed) == rows_of(undisturbed, "mappo", seed)


def test_what_fails_is_shown_and_tried_again_when_asked(tmp_path, capsys):
    """While all else is done."""
    algorithms = {"mappo": {}, "mappo+wrong": {"model_updates": 3}}
    suite = write_suite(tmp_path, algorithms, 100, seeds=1)
    run = ["suite", "run", str(suite), f"--logdir={tmp_path}"]
    reason = "mappo has no model and learns from all it does: give 0"
    assert cli.run(run) == 1
    said = capsys.readouterr().err
    assert "1 done, 1 failed" in said and reason in said
    assert cli.run(run) == 1
    assert "1 done before, 1 failed" in capsys.readouterr().err
    log = tmp_path / "tiny" / "jobs" / "test-coordination_mappo+wrong_seed-0.log"
    tried = log.read_text().count(reason)
    assert cli.run([*run, "--retry"]) == 1
    assert (tried, log.read_text().count(reason)) == (1, 2)
    assert cli.run(["report", str(tmp_path / "tiny")]) == 0
    assert reason in (tmp_path / "tiny" / "report" / "index.html").read_text()


def test_more_steps_and_seeds_go_on_from_what_is_there(suite, undisturbed):
    more = (f"--total-steps={STEPS + 200}", "--num-seeds=3")
    assert finish(suite, undisturbed, *more) == 0
    for seed in (0, 1, 2):
        assert rows_of(undisturbed, "mappo", seed)[-1]["step"] >= STEPS + 200
        (run,) = runs_of(undisturbed, "mappo", seed)
        assert json.loads((run / "evaluation.json").read_text())["step"] >= STEPS + 200


def test_one_job_can_be_run_by_hand(undisturbed, mabl):
    (file,) = (undisturbed / "tiny" / "jobs").glob("*seeds-0-1.yaml")
    assert read_job(file).is_done()
    assert mabl("job", file)[0] == 0


def test_more_episodes_are_played_where_more_are_asked_for(undisturbed, mabl):
    (file,) = (undisturbed / "tiny" / "jobs").glob("*seeds-0-1.yaml")
    job = replace(read_job(file), eval_episodes=6)
    assert not job.is_done()
    job.write()
    assert mabl("job", file)[0] == 0
    assert job.is_done() and replace(job, eval_episodes=4).is_done()


def test_a_job_that_a_signal_kills_is_shown_and_goes_on_next_time(undisturbed):
    (file,) = (undisturbed / "tiny" / "jobs").glob("*seeds-0-1.yaml")
    job, tally = read_job(file), Tally()
    conclude(job, -signal.SIGKILL, tally, None)
    assert "killed by SIGKILL" in tally.failed[job.name] and not job.failed.exists()
    conclude(job, -signal.SIGTERM, tally, signal.SIGTERM)
    assert tally.broken == [job]


def test_a_job_that_is_told_to_end_where_it_has_nothing_to_save_says_so():
    before = signal.getsignal(signal.SIGTERM)  # Ray has one of its own
    with preemptible(), pytest.raises(SystemExit) as ended:
        signal.raise_signal(signal.SIGTERM)
    assert ended.value.code == 75
    assert signal.getsignal(signal.SIGTERM) is before


def test_nothing_is_begun_after_a_stop(undisturbed, monkeypatch):
    """And what was being begun is told."""
    (file,) = (undisturbed / "tiny" / "jobs").glob("*seeds-0-1.yaml")
    backend, job = LocalBackend(1), read_job(file)
    whole = processes.start

    def start(*args):
        process = whole(*args)
        backend.stop()  # a signal, before the process is known
        return process

    monkeypatch.setattr(processes, "start", start)
    backend.submit(job)
    assert backend.running() == {job.name}
    wait_for(lambda: backend.ended() != {})
    backend.submit(job)
    assert not backend.running()
    backend.close()


def test_a_job_whose_last_checkpoint_is_damaged_is_finished_again(undisturbed, mabl):
    (file,) = (undisturbed / "tiny" / "jobs").glob("*seeds-0-1.yaml")
    job = read_job(file)
    run = job.runs()[0]
    before = [row["step"] for row in rows_of(undisturbed, "mappo", 0)]
    newest = run / "checkpoints" / f"step_{steps_done(run)}"
    (newest / "policy.safetensors").write_bytes(b"no")
    (run / "evaluation.json").unlink()
    assert not job.is_done()
    with pytest.warns(match="is damaged"):
        assert mabl("job", file)[0] == 0
    assert job.is_done()  # alone, so that numbers differ by rounding
    assert [row["step"] for row in rows_of(undisturbed, "mappo", 0)] == before
