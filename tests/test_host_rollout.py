"""The counting environment in Python, traced through worker pools with actions known beforehand."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from tests.envs.misbehaving import hosted
from tests.test_rollout import Scripted, check_alignment, joined
from tests.tiny import tiny

from mabl import replay as replays
from mabl.envs import registry
from mabl.envs.counting_host import HostCountingEnv
from mabl.envs.host import Hosted
from mabl.envs.workers import open_pool
from mabl.evaluation import evaluate
from mabl.execution import RandomExecutor
from mabl.host_rollout import HostRollouts, act_where, start_hosted
from mabl.rows import is_last
from mabl.training.programs import programs

COUNTING = Hosted(HostCountingEnv.spec, HostCountingEnv)


@eqx.filter_jit
def begin(n_envs):
    keys = jax.random.split(jax.random.key(0), n_envs)
    return jax.vmap(partial(start_hosted, COUNTING.spec, Scripted()))(keys)


@eqx.filter_jit
@partial(jax.vmap, in_axes=(0, 0, None, 0, 0))
def scripted(*arguments):
    return act_where(Scripted(), *arguments)


def act(memory, row, count, go):
    return scripted(memory, row, jax.random.key(0), count, go)


class Traced:
    """Rollouts in a pool, one after the other, and what each environment did in them."""

    def __init__(self, env, n_envs, n_rows, one_episode=False, num_workers=0):
        self.pool = open_pool(env, n_envs, num_workers, 60.0)
        self.rollouts = HostRollouts(self.pool, env.spec, n_rows, one_episode)
        self.collectors = begin(n_envs)
        self.landed = []

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.pool.close()

    def collect(self):
        landed = self.rollouts.collect(act, self.collectors)
        self.collectors = landed.after
        self.landed.append(landed)
        return landed

    def lane(self, index, since=0):
        """All that one environment gave, as `check_alignment` wants it."""
        pick = lambda x: x[index]  # noqa: E731
        return joined([jax.tree.map(pick, x.rollout) for x in self.landed[since:]])


@pytest.mark.parametrize("num_workers", [0, 2])
def test_rows_count_on_over_episodes_and_calls(num_workers):
    with Traced(COUNTING, 3, 5, num_workers=num_workers) as traced:
        for _ in range(8):
            assert_array_equal(traced.collect().rollout.count, [5] * 3)
    lengths = [check_alignment(*traced.lane(i)) for i in range(3)]
    assert set().union(*lengths) == {5, 7}
    assert lengths[0] != lengths[1]  # episodes differ between environments


def test_one_episode_is_a_reset_its_steps_and_nothing_more():
    with Traced(COUNTING, 2, 8, one_episode=True) as traced:
        for _ in range(6):
            traced.collect()
            for i in range(2):
                (length,) = check_alignment(*traced.lane(i, since=-1))
                assert traced.landed[-1].rollout.count[i] == length + 1
    counts = {int(count) for landed in traced.landed for count in landed.rollout.count}
    assert counts == {6, 8}


def test_the_executor_sees_every_row_exactly_once_in_order():
    with Traced(COUNTING, 2, 6) as traced:
        for _ in range(10):
            traced.collect()
    for i in range(2):
        rows, _ = traced.lane(i)
        memory = jax.tree.map(lambda x, i=i: np.asarray(x[i]), traced.collectors.memory)
        assert memory.count == 60
        assert_array_equal(memory.seen[0], [0, 1])  # the row before the first, never emitted
        assert_array_equal(memory.seen[1:60, 0], rows.state[:-1, 0])
        assert_array_equal(memory.seen[1:60, 1], rows.is_first[:-1])


def test_one_that_has_its_episode_waits_unchanged_for_the_others():
    with Traced(COUNTING, 4, 8, one_episode=True) as traced:
        for _ in range(3):
            landed = traced.collect()
    assert len(set(landed.rollout.count.tolist())) == 2
    seen = [sum(int(x.rollout.count[i]) for x in traced.landed) for i in range(4)]
    assert_array_equal(traced.collectors.memory.count, seen)


def test_the_same_seeds_come_again_in_another_pool_and_others_in_other_environments():
    episodes = []
    for num_workers in (0, 2):
        with Traced(COUNTING, 2, 40, num_workers=num_workers) as traced:
            traced.collect()
        rows = traced.landed[0].rollout.rows
        episodes.append(rows.state[rows.is_first][:, 1])
    assert_array_equal(*episodes)
    assert len(set(episodes[0])) == len(episodes[0])


@pytest.mark.parametrize("n_rows", [20, 3])  # the loss comes amid a rollout, or at its beginning
def test_a_lost_episode_is_truncated_at_its_last_row_and_not_counted(n_rows):
    bad = [number for number in range(1000) if number % 10 in (1, 3)]
    env = hosted("raises", at=3, episodes=tuple(bad))
    told = pytest.warns(UserWarning, match="environment 0 is dropped: ValueError: the train left")
    with Traced(env, 1, n_rows) as traced, told:
        for _ in range(240 // n_rows):
            traced.collect()
    rows, episodes = traced.lane(0)
    assert len(rows.is_first) == 240
    t, number = rows.state.T
    (ends,) = np.nonzero(np.append(rows.is_first[1:], False))
    cut = ends[np.isin(number[ends], bad)]
    assert len(cut) > 3
    assert_array_equal(t[cut], 2)
    assert not episodes.ended[cut].any() and not np.isfinite(rows.score[cut]).any()
    finished = ends[~np.isin(number[ends], bad)]
    assert_array_equal(t[finished], np.where(number[finished] % 2 == 0, 5, 7))
    assert_array_equal(episodes.length[finished], t[finished])
    # Where the cut row was handed over before, the collector that goes on from it says so.
    told = {
        (int(x.before.row.state[0, 0]), int(x.before.row.state[0, 1]))
        for x in traced.landed[1:]
        if x.before.row.truncated[0]
    }
    for k in cut:
        assert rows.truncated[k] or (2, number[k]) in told
    assert bool(told) == (n_rows == 3)


def test_in_a_new_pool_unfinished_episodes_are_cut_and_others_begun():
    with Traced(COUNTING, 1, 4) as traced:
        first = traced.collect()
    assert not first.rollout.rows.truncated.any()
    with Traced(COUNTING, 1, 4) as later:
        later.collectors = first.after
        second = later.collect()
    assert second.before.row.truncated[0] and second.before.row.state[0, 0] == 3
    assert second.rollout.rows.is_first[0, 0]
    assert second.rollout.rows.state[0, 0, 1] != first.rollout.rows.state[0, 0, 1]


def test_training_stores_the_rows_in_order_and_cuts_the_newest_in_the_replay():
    config = tiny("mabl", "test/host-counting")
    run = programs(config)
    states = run.init(jax.random.key(0)[None])
    for _ in range(2):  # the second pool knows nothing of the first one's episodes
        with run.open_cycle(config) as cycle:
            for _ in range(2):
                states, _ = cycle(states, 0, 0)
    replay = jax.device_get(jax.tree.map(lambda x: x[0], states.replay))
    assert_array_equal(replay.size, [80, 80])
    assert states.env_steps[0] == (~replay.rows.is_first[:, :80]).sum()
    for lane in range(2):
        rows = jax.tree.map(lambda x, lane=lane: x[lane, :80], replay.rows)
        t, number = rows.state.T
        began = np.append(rows.is_first[1:], True)
        ended = rows.terminated.all(-1) | rows.truncated
        assert_array_equal(ended[:-1], began[:-1])
        assert rows.is_first[0] and rows.is_first[40]
        for k in np.flatnonzero(~rows.is_first):
            assert (t[k], number[k]) == (t[k - 1] + 1, number[k - 1])
        scale = config.training.reward_scale
        expected = scale * (100 * t[:, None] + rows.prev_action)
        assert_array_equal(rows.reward, np.where(rows.is_first[:, None], 0, expected))


def test_truncating_the_newest_row_of_an_empty_replay_changes_nothing():
    row = jax.tree.map(lambda x: x[0], begin(1).row)
    lane = replays.empty(row, 4)
    lane = replays.cut(lane, jnp.bool_(True))
    assert not lane.rows.truncated.any()
    rows = jax.tree.map(lambda x: x[None].repeat(6, 0), row._replace(truncated=jnp.bool_(False)))
    lane = replays.cut(replays.add(lane, rows, jnp.int32(6)), jnp.bool_(True))
    assert_array_equal(lane.rows.truncated, [False, True, False, False])


@pytest.mark.parametrize("episodes", [3, 20])
def test_evaluation_plays_whole_episodes(episodes):
    env = registry.make("test/host-counting")
    executor = RandomExecutor(env.spec.action_space)
    heard = []
    played = evaluate(env, executor, jax.random.key(0), episodes, num_workers=0, say=heard.append)
    assert heard[0] == 0 and sorted(set(heard)) == heard and heard[-1] < episodes
    assert len(played.score) == len(set(played.score)) == episodes
    assert_array_equal(played.length, np.where(played.score % 2 == 0, 5, 7))


def test_a_reset_made_ahead_goes_down_with_its_worker():
    """One worker holds an environment in mid-episode and one that has been reset already."""
    with Traced(COUNTING, 2, 1, num_workers=1) as traced:
        over = [True, True]
        while over != [False, True]:
            over = is_last(traced.collect().after.row).tolist()
        (worker,) = traced.pool._workers

        def act_and_kill(*seen):
            worker.process.kill()
            worker.process.join()
            return act(*seen)

        told = pytest.warns(UserWarning, match="worker process died")
        with told:
            landed = traced.rollouts.collect(act_and_kill, traced.collectors)
        traced.landed.append(landed)
        assert_array_equal(landed.rollout.count, [1, 1])
        assert landed.rollout.rows.is_first.all()  # both began anew, the second a second time
        assert_array_equal(
            landed.after.env_state.count, np.add(landed.before.env_state.count, [1, 2])
        )
    check_alignment(*traced.lane(1))
