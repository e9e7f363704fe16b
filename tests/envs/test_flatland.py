"""Flatland's rules as this project has them, in the simulator itself."""

from itertools import pairwise

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from tests.tiny import SIZES, learn_a_cycle

from mabl.algorithms.presets import preset
from mabl.envs import flatland, registry
from mabl.envs.base import Discrete
from mabl.errors import UserError
from mabl.evaluation import baseline


@pytest.fixture(scope="module")
def env():
    return registry.make("flatland/5_agents").make()


def shortest_path(row, env):
    """Whichever way is nearer to the target."""
    action = np.zeros(len(row.alive), np.int32)
    for i, train in enumerate(env._trains):
        ways = [train.distance[way.node] for way in env._rails.exits[train.node][:2]]
        if len(ways) == 2 and row.available[i, 1] and ways[1] < ways[0]:
            action[i] = 1
    return action


def at_random(rng):
    return lambda row, env: np.array(
        [rng.choice(np.flatnonzero(a)) for a in row.available], np.int32
    )


def play(env, seed, policy):
    rows = [env.reset(seed)]
    while not (rows[-1].truncated or rows[-1].terminated.all()):
        rows.append(env.step(policy(rows[-1], env)))
    return rows


def test_sizes_are_those_of_table_5():
    five, ten = (registry.make(f"flatland/{n}_agents").spec for n in (5, 10))
    assert (five.n_agents, five.episode_limit, ten.n_agents, ten.episode_limit) == (5, 573, 10, 580)
    assert five.obs_dim == 205 and five.state_dim == 5 * 205
    assert five.action_space == Discrete(3) and five.score_name == "arrived"
    inner = registry.make("flatland/10_agents").make()._env
    assert (inner.width, inner.height, inner.number_of_agents) == (35, 35, 10)
    assert inner.malfunction_generator.get_process_data() == (1 / 150, 20, 50)
    cities = inner.rail_generator
    assert (cities.max_num_cities, cities.grid_mode) == (4, False)
    assert (cities.max_rails_between_cities, cities.max_rails_in_city) == (2, 4)


def test_a_seed_decides_the_episode_and_every_seed_its_own(env):
    first, again = (play(env, 5, at_random(np.random.default_rng(0))) for _ in range(2))
    assert len(first) == len(again)
    for one, other in zip(first, again, strict=True):
        jax.tree.map(assert_array_equal, one, other)
    fresh = registry.make("flatland/5_agents").make()
    assert_array_equal(fresh.reset(5).obs, first[0].obs)
    assert not np.array_equal(env.reset(6).obs, first[0].obs)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_rows_keep_their_promises(env, seed):
    rows = play(env, seed, at_random(np.random.default_rng(seed)))
    assert rows[0].is_first and not any(row.is_first for row in rows[1:])
    for before, row in pairwise(rows):
        over = before.terminated
        assert (row.terminated >= over).all()  # what is over stays over
        assert_array_equal(row.alive, ~over)
        assert not row.reward[over].any() and not row.obs[over].any()
        assert not row.available[row.terminated, 1:].any()
        assert row.available[:, 0].all()
    last = rows[-1]
    assert np.isnan(rows[-2].score) and 0 <= last.score <= 1
    assert last.truncated == (not last.terminated.all())
    assert len(rows) - 1 <= 573


def test_rewards_are_arrivals_progress_and_deadlocks(env):
    totals, arrived, stuck, gained = np.zeros(5), np.zeros(5), np.zeros(5), np.zeros(5)
    for seed in range(4):
        row = env.reset(seed)
        start = [train.distance[train.node] for train in env._trains]
        policy = shortest_path if seed < 2 else at_random(np.random.default_rng(seed))
        while not (row.truncated or row.terminated.all()):
            row = env.step(policy(row, env))
            totals += row.reward
        arrived += env._arrived
        stuck += env._stuck
        gained += np.subtract(start, [train.distance[train.node] for train in env._trains])
        assert row.score == pytest.approx(env._arrived.mean())
    assert arrived.sum() > 0 and stuck.sum() > 0
    assert_allclose(totals, 10 * arrived - 5 * stuck + 0.01 * gained, atol=1e-3)


def test_deadlocked_trains_never_move_again_whatever_they_try(env):
    """Their episode goes on in the simulator as long as that of others does."""
    seen = 0
    for seed in range(6):
        row, rng, held = env.reset(seed), np.random.default_rng(seed), {}
        while not (row.truncated or row.terminated.all()):
            row = env.step(at_random(rng)(row, env))
            for i in np.flatnonzero(env._stuck):
                place = env._env.agents[i].position
                assert held.setdefault(i, place) == place
        for _ in range(30):  # and with orders to all of them
            env._env.dones["__all__"] = False
            env._env.step({i: int(rng.integers(1, 4)) for i in held})
            for i, place in held.items():
                assert env._env.agents[i].position == place
        seen += len(held)
    assert seen >= 2


def test_the_heuristic_takes_the_shortest_path(env):
    heuristic = baseline("heuristic", registry.make("flatland/5_agents"))
    row, forks = env.reset(4), 0
    while not (row.truncated or row.terminated.all()):
        expected = shortest_path(row, env)
        _, action = heuristic.act(None, row, jax.random.key(0))
        np.testing.assert_array_equal(action, expected)
        forks += int((expected == 1).sum())
        row = env.step(expected)
    assert forks > 3


def test_nothing_to_decide_means_going_on(env):
    """Where 0 alone is available, the train does what it would do on its own."""
    row = env.reset(3)
    for _ in range(60):
        forced = [i for i in range(5) if row.alive[i] and not row.available[i, 1:].any()]
        ways = {i: env._rails.exits[env._trains[i].node] for i in forced}
        broken = {i for i in forced if env._trains[i].broken}
        assert all(len(ways[i]) == 1 for i in forced if i not in broken)
        for i in set(range(5)) - set(forced):
            fork = len(env._rails.exits[env._trains[i].node]) > 1
            assert row.available[i, 1] == (fork and row.alive[i] and not row.terminated[i])
        row = env.step(shortest_path(row, env))


def test_stopping_holds_a_train_and_keeps_it_from_departing(env):
    env.reset(0)
    for _ in range(5):
        row = env.step(np.full(5, 2, np.int32))
    assert all(train.ready for train in env._trains)
    assert (row.obs[:, 8] == 1).all() and not row.reward.any()
    env.step(np.zeros(5, np.int32))
    assert not any(train.ready for train in env._trains)


def test_the_shortest_path_beats_chance(env):
    best = np.mean([play(env, seed, shortest_path)[-1].score for seed in range(6)])
    chance = np.mean(
        [play(env, s, at_random(np.random.default_rng(s)))[-1].score for s in range(6)]
    )
    assert best > 0.5 > 0.35 > chance


def test_it_draws(env):
    env.reset(0)
    env.step(np.zeros(5, np.int32))
    picture = env.render()
    assert picture.ndim == 3 and picture.shape[-1] == 3 and picture.dtype == np.uint8
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 20


@pytest.mark.parametrize(("task", "steps"), [("5_agents", 100_000), ("10_agents", 450_000)])
def test_paper_presets_learn_for_a_cycle(task, steps):
    """Their schedule; networks and batches are small."""
    config = preset("paper", f"flatland/{task}", "mabl")
    assert config.total_steps == steps and not config.mappo.team_reward
    assert (config.training.model_updates, config.world_model.batch_length) == (40, 50)
    assert config.world_model.hidden == config.mappo.hidden == 400
    states = learn_a_cycle(config, replay_capacity=1_000)
    z_global = SIZES["world_model"]["n_categoricals"], SIZES["world_model"]["n_classes"]
    seen = states.learner.behaviour.critic.embed.weight  # with an axis of seeds
    assert seen.shape == (1, *z_global, SIZES["mappo"]["hidden"])


def test_another_version_is_named(monkeypatch):
    monkeypatch.setattr("importlib.metadata.version", lambda name: "4.3.0")
    with pytest.raises(UserError, match=r"flatland-rl 4.3.0 is installed.*rest on 2.2.2"):
        flatland.check_installed()
