"""The counting environment, traced through `rollout` with actions known beforehand."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from numpy.testing import assert_array_equal

from mabl.envs.counting import CountingEnv
from mabl.rollout import Rollout, rollout, start
from mabl.rows import TimeStep

ENV = CountingEnv()


class Log(NamedTuple):
    """Step and `is_first` of every row that the executor was shown, in order."""

    count: Array
    seen: Array


class Scripted(NamedTuple):
    """At row t agent i plays (t + 1 + i) mod 3, which is never the unavailable t mod 3."""

    def initial(self, row: TimeStep) -> Log:
        return Log(jnp.int32(0), jnp.full((100, 2), -1))

    def act(self, memory: Log, row: TimeStep, key: Array) -> tuple[Log, Array]:
        t = row.obs[:, 0].astype(jnp.int32)
        shown = jnp.stack([t[0], row.is_first.astype(jnp.int32)])
        seen = memory.seen.at[memory.count].set(shown)
        return Log(memory.count + 1, seen), (t + 1 + jnp.arange(2)) % 3


@eqx.filter_jit
def begin(key):
    return start(ENV, Scripted(), key)


@eqx.filter_jit
def collect(collector, key, n_rows, one_episode=False):
    return rollout(ENV, Scripted(), collector, key, n_rows, one_episode)


def joined(parts: list[Rollout]) -> tuple[TimeStep, object]:
    """The valid rows and episode entries of several rollouts in a row, in numpy."""
    cut = [
        jax.tree.map(lambda x, n=int(part.count): np.asarray(x[:n]), (part.rows, part.episodes))
        for part in parts
    ]
    return jax.tree.map(lambda *x: np.concatenate(x), *cut)


def check_alignment(rows: TimeStep, episodes) -> list[int]:
    """Check every field of every row against the environment's definition; lengths of episodes.

    An even episode terminates at 5 with return 1505.5, an odd one is truncated at 7 with 2807.5:
    100 (1 + ... + t), plus the actions, which both agents cycle through:
    (1+2+0+1+2 and 2+0+1+2+0) / 2 = 5.5, and two more steps (0+1 and 1+2) / 2 = 2.
    """
    lengths, t, number, over = [], None, None, True
    for k in range(len(rows.is_first)):
        row = jax.tree.map(lambda x, k=k: x[k], rows)
        if over:  # the row after an end is a reset
            t, number = 0, int(row.state[1])
            assert row.is_first
            assert_array_equal(row.prev_action, [0, 0])
            assert_array_equal(row.reward, [0, 0])
        else:
            t += 1
            assert not row.is_first
            assert_array_equal(row.prev_action, [t % 3, (t + 1) % 3])
            assert_array_equal(row.reward, [100 * t + t % 3, 100 * t + (t + 1) % 3])
        assert_array_equal(row.state, [t, number])
        for agent in range(2):
            assert_array_equal(row.obs[agent], [t, agent, row.prev_action[agent], number])
            assert_array_equal(row.available[agent], np.arange(3) != t % 3)
        terminated, truncated = t == 5 and number % 2 == 0, t == 7
        assert_array_equal(row.terminated, [terminated] * 2)
        assert row.truncated == truncated
        over = terminated or truncated
        assert episodes.ended[k] == over
        if over:
            lengths.append(t)
            assert row.score == episodes.score[k] == number
            assert episodes.length[k] == t
            assert episodes.episode_return[k] == {5: 1505.5, 7: 2807.5}[t]
        else:
            assert np.isnan(row.score)
            assert episodes.length[k] == episodes.episode_return[k] == episodes.score[k] == 0
    return lengths


def test_a_fixed_number_of_rows_crosses_episodes_and_keeps_their_last_rows():
    _, collected = collect(begin(jax.random.key(0)), jax.random.key(1), 60)
    assert collected.count == 60
    lengths = check_alignment(*joined([collected]))
    assert set(lengths) == {5, 7}  # both kinds of ends occurred


def test_going_on_after_any_number_of_rows_leaves_no_seam():
    collector, parts = begin(jax.random.key(0)), []
    for i in range(12):
        collector, part = collect(collector, jax.random.key(i), 5)
        assert part.count == 5
        parts.append(part)
    assert set(check_alignment(*joined(parts))) == {5, 7}


def test_one_episode_is_a_reset_its_steps_and_nothing_more():
    collector, parts = begin(jax.random.key(0)), []
    for i in range(12):
        collector, part = collect(collector, jax.random.key(i), 8, one_episode=True)
        (length,) = check_alignment(*joined([part]))
        assert part.count == length + 1
        padding = jax.tree.map(lambda x, n=int(part.count): x[n:], (part.rows, part.episodes))
        assert all(not np.asarray(x).any() for x in jax.tree.leaves(padding))
        parts.append(part)
    assert {int(part.count) for part in parts} == {6, 8}


def test_one_episode_is_cut_at_the_number_of_rows_and_goes_on_later():
    collector, parts = begin(jax.random.key(0)), []
    for i in range(8):
        collector, part = collect(collector, jax.random.key(i), 4, one_episode=True)
        parts.append(part)
    # 6 or 8 rows in calls of 4: the first of two calls is full, the second ends the episode
    assert [int(part.count) for part in parts[::2]] == [4] * 4
    assert len(check_alignment(*joined(parts))) == 4


@pytest.mark.parametrize("n_rows", [6, 30])
def test_the_executor_sees_every_row_exactly_once_in_order(n_rows):
    collector, parts = begin(jax.random.key(0)), []
    for i in range(60 // n_rows):
        collector, part = collect(collector, jax.random.key(i), n_rows)
        parts.append(part)
    rows, _ = joined(parts)
    assert collector.memory.count == 60
    seen = np.asarray(collector.memory.seen[:60])
    # First comes the row of `start`, which is never emitted; the newest row is yet to be shown.
    assert_array_equal(seen[0], [0, 1])
    assert_array_equal(seen[1:, 0], rows.state[:-1, 0])
    assert_array_equal(seen[1:, 1], rows.is_first[:-1])


def test_environments_side_by_side_do_not_mix():
    @jax.jit
    @jax.vmap
    def play(key):
        return rollout(ENV, Scripted(), start(ENV, Scripted(), key), key, 8, True)[1]

    collected = jax.device_get(play(jax.random.split(jax.random.key(0), 3)))
    for lane in range(3):
        part = jax.tree.map(lambda x, lane=lane: x[lane], collected)
        assert len(check_alignment(*joined([part]))) == 1
