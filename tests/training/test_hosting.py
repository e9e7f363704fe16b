"""Runs whose environments live in worker processes: they survive, and can be gone on with."""

import json
import os
import signal
from dataclasses import replace

import jax
import numpy as np
import pytest
from tests.tiny import tiny

from mabl import resume, train
from mabl.envs.pool import WorkerPool
from mabl.evaluation import evaluate
from mabl.policy import load_run
from mabl.runs.checkpoint import Checkpoints
from mabl.training.programs import programs

ENV = "test/host-counting"


def config_of(algo, tmp_path, **changes):
    return replace(tiny(algo, ENV), logdir=str(tmp_path), num_workers=0, **changes)


def metrics_of(folder):
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def kill_process(worker):
    os.kill(worker.process.pid, signal.SIGKILL)


def kill_actor(worker):
    import ray

    ray.kill(worker.actor)


@pytest.mark.parametrize(
    ("workers", "kill"),
    [("processes", kill_process), ("ray", kill_actor)],
)
def test_killing_a_worker_costs_an_episode_and_not_the_run(
    tmp_path, monkeypatch, request, workers, kill
):
    """Two environments, each with a worker of its own."""
    if workers == "ray":
        request.getfixturevalue("cluster")
    calls, receive = [], WorkerPool.receive

    def receive_or_kill(pool):
        calls.append(len(calls))
        if len(calls) == 130:
            kill(pool._workers[1])
        lost = receive(pool)
        losses.extend(lost)
        return lost

    losses = []
    monkeypatch.setattr(WorkerPool, "receive", receive_or_kill)
    config = replace(config_of("mabl", tmp_path, total_steps=300), workers=workers, num_workers=2)
    with pytest.warns(UserWarning, match="environment 1 is dropped: its worker process died"):
        outcome = train(config)
    assert [lost.index for lost in losses] == [1]
    rows = metrics_of(outcome.folders[0])
    assert rows[-1]["step"] >= 300 and rows[-1]["world_model/loss"] > 0
    replay = replay_of(config, outcome.folders[0])
    assert_whole(replay, cuts=1)


def replay_of(config, folder):
    """The newest checkpoint's, in order."""
    training = programs(config).training
    shape = jax.eval_shape(training.init, jax.random.key(0))
    replay = Checkpoints(folder / "checkpoints").restore("state", shape)[1].replay
    assert (replay.size < replay.rows.reward.shape[1]).all()  # nothing is overwritten yet
    return jax.device_get(replay)


def assert_whole(replay, cuts):
    """Rows count on within episodes; `cuts` of these are truncated before their time."""
    found = 0
    for lane, size in enumerate(replay.size):
        rows = jax.tree.map(lambda x, lane=lane, size=size: x[lane, :size], replay.rows)
        t, number = rows.state.T
        ends = rows.terminated.all(-1) | rows.truncated
        assert np.array_equal(ends[:-1], rows.is_first[1:])
        going = np.flatnonzero(~rows.is_first)
        assert (t[going] == t[going - 1] + 1).all() and (number[going] == number[going - 1]).all()
        found += int((rows.truncated & (t < 7)).sum())
    assert found == cuts


@pytest.mark.parametrize("algo", ["mabl", "mappo"])
def test_a_resumed_run_begins_new_episodes_and_cuts_the_old_ones(algo, tmp_path):
    (folder,) = train(config_of(algo, tmp_path, total_steps=200)).folders
    before = metrics_of(folder)
    unfinished = 0
    if algo == "mabl":
        replay = replay_of(config_of(algo, tmp_path), folder)
        newest = [
            jax.tree.map(lambda x, i=i, n=n: x[i, n - 1], replay.rows)
            for i, n in enumerate(replay.size)
        ]
        unfinished = sum(not (row.terminated.all() or row.truncated) for row in newest)
    resume(folder, 300)
    after = metrics_of(folder)
    assert after[: len(before)] == before and after[-1]["step"] >= 300
    if algo == "mabl":
        assert_whole(replay_of(config_of(algo, tmp_path), folder), cuts=unfinished)


def test_workers_make_no_difference(tmp_path, cluster):
    plain = config_of("mabl", tmp_path, total_steps=250)
    runs = [
        train(plain),
        train(replace(plain, num_workers=2)),
        train(replace(plain, num_workers=2, workers="ray")),
    ]
    one, *others = (
        [
            {k: v for k, v in row.items() if not k.startswith("time/")}
            for row in metrics_of(run.folders[0])
        ]
        for run in runs
    )
    assert others == [one, one]


def test_seeds_share_the_pool_and_equal_runs_of_their_own(tmp_path):
    both = train(config_of("mappo", tmp_path / "both", total_steps=200, num_seeds=2)).folders
    alone = train(config_of("mappo", tmp_path / "alone", total_steps=200, seed=1)).folders
    assert [folder.parent.name for folder in both] == ["seed_0", "seed_1"]
    one, other = metrics_of(both[1]), metrics_of(alone[0])
    for name in ("step", "train/episodes", "train/score"):
        assert [row.get(name) for row in one] == [row.get(name) for row in other]


def test_a_trained_policy_plays_on_with_workers_and_without(tmp_path):
    (folder,) = train(config_of("mabl", tmp_path, total_steps=200)).folders
    loaded = load_run(folder)
    played = [
        evaluate(loaded.env, loaded.executor, jax.random.key(0), 10, num_workers=n) for n in (0, 2)
    ]
    jax.tree.map(np.testing.assert_array_equal, *played)
    assert len(played[0].score) == 10


def test_memories_of_a_run_are_those_of_its_newest_parameters(tmp_path):
    """QMIX's memory draws nothing; its sequences of 8 rows reach back to every reset."""
    config = config_of("qmix", tmp_path, total_steps=230)
    (folder,) = train(config).folders
    training = programs(config).training
    shape = jax.eval_shape(training.init, jax.random.key(0))
    state = Checkpoints(folder / "checkpoints").restore("state", shape)[1]
    executor, compared = training.executor(state.learner), 0
    for lane in range(2):
        size = int(state.replay.size[lane])
        newest = jax.tree.map(lambda x, lane=lane: x[lane], state.collectors.row)
        assert np.array_equal(newest.obs, state.replay.rows.obs[lane, size - 1])
        episode = int(newest.obs[0, 0])  # rows since the reset
        memory = executor.initial(newest)
        for t in range(size - 1 - episode, size - 1):
            row = jax.tree.map(lambda x, lane=lane, t=t: x[lane, t], state.replay.rows)
            assert row.is_first == (t == size - 1 - episode)
            memory, _ = executor.act(memory, row, jax.random.key(0))
        if episode:
            kept = state.collectors.memory[lane]
            assert np.abs(kept).max() > 0
            np.testing.assert_allclose(kept, memory, atol=1e-5)
            compared += 1
    assert compared
