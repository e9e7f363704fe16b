"""Environments with PettingZoo's Parallel interface, row by row against what they really did."""

import jax
import mpe2.simple_spread_v3 as spread
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from tests.envs.leaving import Arms
from tests.tiny import tiny

from mabl.envs import registry
from mabl.envs.base import Continuous, Discrete
from mabl.errors import UserError
from mabl.training.programs import programs

OWN = "pettingzoo:tests.envs.leaving"


def opened(name, *kwargs):
    hosted = registry.make(name, kwargs)
    return hosted.spec, hosted.make()


def test_rows_are_what_the_environment_gave():
    spec, env = opened("pettingzoo:mpe2.simple_spread_v3", "max_cycles=4")
    assert (spec.n_agents, spec.obs_dim, spec.state_dim) == (3, 18, 54)
    assert spec.action_space == Discrete(5) and spec.episode_limit == 4
    bare = spread.parallel_env(max_cycles=4)
    obs, _ = bare.reset(seed=7)
    row = env.reset(7)
    total, rng = 0.0, np.random.default_rng(0)
    for t in range(5):
        assert_allclose(row.obs, [obs[agent] for agent in bare.possible_agents], rtol=1e-6)
        assert_allclose(row.state, bare.state(), rtol=1e-6)
        assert row.alive.all() and row.available.all() and not row.terminated.any()
        assert row.is_first == (t == 0) and row.truncated == (t == 4)
        if t == 4:
            break
        assert np.isnan(row.score)
        action = rng.integers(0, 5, 3).astype(np.int32)
        row = env.step(action)
        obs, rewards, *_ = bare.step(
            {agent: int(a) for agent, a in zip(bare.possible_agents, action, strict=True)}
        )
        assert_array_equal(row.prev_action, action)
        assert_allclose(row.reward, list(rewards.values()), rtol=1e-6)
        total += np.mean(list(rewards.values()))
    assert_allclose(row.score, total, rtol=1e-5)


def test_agents_that_differ_are_padded_masked_and_told_who_they_are():
    spec, env = opened("pettingzoo:mpe2.simple_speaker_listener_v4")
    assert spec.agent_ids == ("speaker_0", "listener_0")
    assert (spec.obs_dims, spec.action_dims) == ((3, 11), (3, 5))
    assert spec.obs_dim == 11 + 2 and spec.action_space == Discrete(5)
    row = env.reset(0)
    assert_array_equal(row.available, [[1, 1, 1, 0, 0], [1, 1, 1, 1, 1]])
    assert_array_equal(row.obs[:, 11:], np.eye(2))
    assert row.obs[0, :3].all() and not row.obs[0, 3:11].any() and row.obs[1, 3:8].any()


@pytest.mark.parametrize("masked", ["obs", "info"])
def test_agents_that_leave_do_not_come_back(masked):
    _, env = opened(f"{OWN}:Leaving", f"masked={masked}")
    row = env.reset(0)
    assert row.alive.all() and row.obs.shape == (3, 2)
    assert_array_equal(row.available, [[0, 1, 1]] * 3)
    row = env.step(np.array([1, 2, 2], np.int32))
    assert_array_equal(row.reward, [12, 13, 13])  # actions 0, 1, 2 are 1, 2, 3 there
    assert_array_equal(row.terminated, [1, 0, 0])
    assert_array_equal(row.alive, [1, 1, 1])  # it ends on this row, and is gone from the next
    assert_array_equal(row.obs, [[0, 1], [1, 1], [2, 1]])
    assert_array_equal(row.available, [[1, 0, 0], [1, 0, 1], [1, 0, 1]])
    row = env.step(np.array([0, 0, 2], np.int32))
    assert_array_equal(row.reward, [0, 21, 23])
    assert_array_equal(row.terminated, [1, 1, 0])
    assert_array_equal(row.alive, [0, 1, 1])
    assert_array_equal(row.obs, [[0, 0], [1, 2], [2, 2]])
    assert not row.truncated and np.isnan(row.score)
    row = env.step(np.array([0, 0, 1], np.int32))
    assert_array_equal(row.terminated, [1, 1, 1])
    assert not row.truncated
    assert row.score == pytest.approx((12 + 13 + 13 + 21 + 23 + 32) / 3)


def test_a_limit_truncates_and_what_ended_before_stays_ended():
    spec, env = opened(f"{OWN}:Leaving", "stay=1")
    env.reset(0)
    for t in range(1, 6):
        row = env.step(np.full(3, (t + 1) % 3, np.int32))
        assert row.truncated == (t == 5)
    assert_array_equal(row.terminated, [1, 1, 0])
    assert spec.episode_limit == 1000  # it does not say


def test_agents_that_are_truncated_and_stay_listed_are_truncated():
    _, env = opened(f"{OWN}:Lingering")
    env.reset(0)
    assert [bool(env.step(np.full(3, (t + 1) % 3, np.int32)).truncated) for t in range(1, 6)] == [
        *[False] * 4,
        True,
    ]


def test_continuous_agents_that_are_gone_have_no_dimensions():
    _, env = opened("pettingzoo:tests.envs.leaving:Arms", "stay=1")
    env.reset(0)
    row = env.step(np.zeros((2, 2), np.float32))
    assert row.terminated[0] and row.alive[0] and not row.available[0].any()
    assert_array_equal(row.available[1], [True, True])


def test_a_limit_of_ones_own_comes_first_and_scores_of_infos_count():
    spec, env = opened(f"{OWN}:Leaving", "stay=2", "episode_limit=2", "score=0.25")
    assert spec.episode_limit == 2
    env.reset(0)
    assert not env.step(np.zeros(3, np.int32)).truncated
    row = env.step(np.zeros(3, np.int32))
    assert row.truncated and row.score == 0.25


def test_continuous_actions_fill_their_own_bounds():
    spec, env = opened(f"{OWN}:Arms")
    assert spec.action_space == Continuous(2) and spec.action_dims == (1, 2)
    row = env.reset(0)
    assert_array_equal(row.available, [[1, 0], [1, 1]])
    assert_array_equal(row.state, [0, 7])
    inner = env._env
    assert isinstance(inner, Arms)
    env.step(np.array([[-1.0, 9.0], [0.5, 3.0]], np.float32))
    assert_array_equal(inner.taken["walker_0"], [0.0])
    assert_allclose(inner.taken["walker_1"], [7.5, 10.0])  # beyond the bounds: clipped


@pytest.mark.parametrize(
    ("name", "kwargs", "message"),
    [
        ("pettingzoo:", (), "names no module: give module:factory"),
        ("pettingzoo:no.such.module", (), "No module named 'no'"),
        (f"{OWN}:Missing", (), "has no Missing: give module:factory"),
        (f"{OWN}:nothing", (), "made object, which has no possible_agents"),
        (f"{OWN}:Odd", ("which=sequence",), "walker_0 observes .*, which has no fixed size"),
        (f"{OWN}:Odd", ("which=several",), r"walker_0 acts in MultiDiscrete\(.*Discrete or Box"),
        (f"{OWN}:Odd", ("which=mixed",), "mixes discrete and continuous actions"),
        (f"{OWN}:Leaving", ("stay",), "--env-kwargs 'stay': give KEY=VALUE"),
        (f"{OWN}:Leaving", ("colour=red",), "cannot be made with colour=red"),
        ("pettingzoo:os:system", (), "cannot be made with no arguments .*'command'"),
        ("pettingzoo:os:sep", (), "sep of os is no factory: give module:factory"),
        ("petting:x", (), "unknown environment 'petting:x'.*pettingzoo:module:factory"),
    ],
)
def test_mistakes_are_named(name, kwargs, message):
    with pytest.raises(UserError, match=message):
        registry.make(name, kwargs)


@pytest.mark.parametrize("algo", ["mabl", "mappo"])
def test_it_is_learned_in(algo):
    config = tiny(algo, f"{OWN}:Leaving")
    run = programs(config)
    states = run.init(jax.random.key(0)[None])
    with run.open_cycle(config) as cycle:
        for n_model in (0, 1, 1):
            states, metrics = cycle(states, n_model if algo == "mabl" else 0, 1 if n_model else 0)
    assert all(np.isfinite(value).all() for value in jax.device_get(metrics).values())
    assert metrics["episodes/count"][0] == 10 and metrics["episodes/length"][0] % 3 == 0
