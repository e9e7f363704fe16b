"""Workers do as they are told; what goes wrong in one costs its episode, and is said."""

import os
import signal

import numpy as np
import pytest
from tests.envs.misbehaving import hosted

from mabl.envs.counting_host import HostCountingEnv
from mabl.envs.host import Hosted
from mabl.envs.pool import IDLE, RESET, STEP
from mabl.envs.workers import open_pool
from mabl.errors import UserError

COUNTING = Hosted(HostCountingEnv.spec, HostCountingEnv)
GOOD, BAD = 4, 5
"""Seeds: numbers of a good episode and of one in which something happens."""


on_any = pytest.mark.parametrize("workers", ["processes", "ray"])


@pytest.fixture
def pool_of(request):
    pools = []

    def make(hosted, num_envs, num_workers, timeout=60.0, workers="processes"):
        if workers == "ray":
            request.getfixturevalue("cluster")
        pools.append(open_pool(hosted, num_envs, num_workers, timeout, workers))
        return pools[-1]

    yield make
    for pool in pools:
        pool.close()


def tell(pool, command, seed=GOOD, action=0):
    """One command to all, or one to each."""
    pool.slots.command[:] = command
    pool.slots.seed[:] = seed
    pool.slots.action[:] = action
    pool.send()
    return pool.receive()


@pytest.mark.parametrize("num_workers", [0, 1, 2, 3, None])
@on_any
def test_everyone_does_what_it_is_told(pool_of, num_workers, workers):
    pool = pool_of(COUNTING, 3, num_workers, workers=workers)
    rows = pool.slots.rows
    assert tell(pool, RESET, seed=[4, 1005, 6]) == []
    np.testing.assert_array_equal(rows.state, [[0, 4], [0, 5], [0, 6]])
    assert rows.is_first.all()
    assert tell(pool, [STEP, IDLE, STEP], action=np.arange(6).reshape(3, 2) % 3) == []
    np.testing.assert_array_equal(rows.state, [[1, 4], [0, 5], [1, 6]])
    np.testing.assert_array_equal(rows.prev_action, [[0, 1], [0, 0], [1, 2]])
    assert tell(pool, [RESET, STEP, IDLE], seed=7, action=2) == []
    np.testing.assert_array_equal(rows.state, [[0, 7], [1, 5], [1, 6]])
    np.testing.assert_array_equal(rows.reward, [[0, 0], [102, 102], [101, 102]])


@on_any
def test_workers_do_without_jax(pool_of, workers):
    pool = pool_of(hosted("tells of jax"), 1, 1, workers=workers)
    pool.slots.rows.score[:] = 7
    assert tell(pool, RESET) == []
    assert pool.slots.rows.score == 0


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ("dies", "its worker process died"),
        ("hangs", "no answer within 4 seconds"),
        ("raises", "ValueError: the train left the rails"),
    ],
)
@on_any
def test_what_goes_wrong_costs_an_episode(pool_of, how, reason, workers):
    timeout = 4.0 if how == "hangs" else 60.0
    pool = pool_of(hosted(how, at=1, episodes=(BAD,)), 2, 2, timeout, workers)
    rows = pool.slots.rows
    assert tell(pool, RESET, seed=[BAD, GOOD]) == []
    (lost,) = tell(pool, STEP)
    assert lost.index == 0 and reason in lost.reason
    np.testing.assert_array_equal(rows.state[1], [1, GOOD])  # the other knows nothing of it
    assert tell(pool, [RESET, STEP]) == []
    np.testing.assert_array_equal(rows.state, [[0, GOOD], [2, GOOD]])


def test_a_killed_worker_costs_the_episodes_that_it_held(pool_of):
    pool = pool_of(COUNTING, 3, 2)
    tell(pool, RESET)
    two = next(w for w in pool._workers if len(w.envs) == 2)
    os.kill(two.process.pid, signal.SIGKILL)
    lost = tell(pool, STEP)
    assert [index for index, _ in lost] == list(two.envs)
    assert tell(pool, RESET) == []


def test_an_environment_that_fails_in_every_episode_ends_the_run(pool_of):
    pool = pool_of(hosted("raises", at=1), 1, 0)
    for _ in range(2):
        tell(pool, RESET)
        assert len(tell(pool, STEP)) == 1
    tell(pool, RESET)
    with pytest.raises(UserError, match=r"failed 3 times without finishing(.|\n)*left the rails"):
        tell(pool, STEP)


def test_losses_are_forgiven_when_an_episode_is_finished(pool_of):
    pool = pool_of(hosted("raises", at=1, episodes=(BAD,)), 1, 0)
    for _ in range(4):
        tell(pool, RESET, seed=BAD)
        assert len(tell(pool, STEP)) == 1
        tell(pool, RESET, seed=GOOD)
        for _ in range(5):
            assert tell(pool, STEP) == []
        assert pool.slots.rows.terminated.all()


@pytest.mark.parametrize("num_workers", [0, 1])
@on_any
@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("gives NaN", r"gave obs\[2\] = nan for agent 1.*, in the episode of seed \d+"),
        ("gives another shape", r"gave reward of shape \(3,\), its spec says \(2,\)"),
    ],
)
def test_rows_that_nobody_can_learn_from_end_the_run(pool_of, how, message, num_workers, workers):
    pool = pool_of(hosted(how, at=1), 1, num_workers, workers=workers)
    tell(pool, RESET)
    with pytest.raises(UserError, match=message):
        tell(pool, STEP)


@pytest.mark.parametrize("num_workers", [0, 1])
@on_any
def test_an_environment_that_cannot_be_made_says_why(pool_of, num_workers, workers):
    with pytest.raises(UserError, match=r"could not be made(.|\n)*no game here"):
        tell(pool_of(hosted("cannot be made"), 1, num_workers, workers=workers), RESET)


def test_closing_ends_the_processes(pool_of):
    pool = pool_of(COUNTING, 2, 2)
    tell(pool, RESET)
    processes = [worker.process for worker in pool._workers]
    pool.close()
    assert not any(process.is_alive() for process in processes)
