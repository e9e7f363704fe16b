"""The SMAX adapter against bare jaxmarl, its endings, and the ground that SMAX lacks."""

import subprocess
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxmarl.environments.smax import HeuristicEnemySMAX

from mabl.envs import registry, smax
from mabl.envs.smax_terrain import STOP, TerrainSMAX, attack_closest
from mabl.errors import UserError
from mabl.rows import is_last


class Played:
    """An environment with its compiled functions, shared by the tests of a scenario."""

    def __init__(self, name):
        self.env = smax.make(name)
        self.reset, self.step = jax.jit(self.env.reset), jax.jit(self.env.step)


@pytest.fixture(scope="module")
def marines():
    return Played("3m")


@pytest.fixture(scope="module")
def crawler():
    return Played("2s_vs_1sc")


def random_action(key, available):
    return jax.random.categorical(key, jnp.where(available, 0.0, -jnp.inf))


def rigged(env_state, **fields):
    return env_state._replace(game=replace(env_state.game, **fields))


def test_jaxmarl_beside_smax_is_left_to_those_who_ask_for_it():
    program = """
import sys
from mabl.envs import registry
registry.make("smax/3m")
assert not any("storm" in name for name in sys.modules)
import jaxmarl
env = jaxmarl.make("HeuristicEnemySMAX")
from mabl.envs.smax import SMAX
assert isinstance(env, jaxmarl.environments.MultiAgentEnv)
assert jaxmarl.environments.SMAX is SMAX
"""
    subprocess.run([sys.executable, "-c", program], check=True)


def test_every_row_equals_bare_jaxmarl(marines):
    env = marines.env
    bare = HeuristicEnemySMAX(scenario=smax.SCENARIOS["3m"].scenario, max_steps=10**6)
    with jax.numpy_rank_promotion("allow"):
        obs, bare_state = bare.reset(jax.random.key(3))
    env_state, row = marines.reset(jax.random.key(3))
    assert row.is_first and not row.reward.any() and not row.prev_action.any()
    assert row.prev_action.dtype == jnp.int32
    np.testing.assert_array_equal(row.obs, jnp.stack([obs[a] for a in bare.agents]))
    for t in range(env.spec.episode_limit):
        key_action, key_step = jax.random.split(jax.random.key(t))
        action = random_action(key_action, row.available)
        env_state, row = marines.step(key_step, env_state, action)
        actions = dict(zip(bare.agents, action, strict=True))
        with jax.numpy_rank_promotion("allow"):
            obs, bare_state, reward, done, _ = bare.step_env(key_step, bare_state, actions)
            available = bare.get_avail_actions(bare_state)
        game = bare_state.state
        np.testing.assert_array_equal(row.obs, jnp.stack([obs[a] for a in bare.agents]))
        np.testing.assert_array_equal(row.available, jnp.stack([available[a] for a in bare.agents]))
        np.testing.assert_array_equal(row.reward, jnp.stack([reward[a] for a in bare.agents]))
        np.testing.assert_array_equal(env_state.game.unit_positions, game.unit_positions)
        np.testing.assert_array_equal(row.alive, game.unit_alive[:3])
        np.testing.assert_array_equal(row.prev_action, action)
        assert row.terminated.all() == row.terminated.any() == done["__all__"]
        assert not row.is_first and not row.truncated
        assert jnp.isnan(row.score) == ~is_last(row)
        if done["__all__"]:
            break
    assert row.score == 0.0, "random marines lose"
    # The last row shows the end of the battle: the enemies far from where a reset puts them.
    assert (game.unit_positions[3:, 0] < 20.0).all()


@pytest.fixture(scope="module")
def last_stand(marines):
    """Three marines, each next to an enemy with one health point left."""
    env_state, _ = marines.reset(jax.random.key(0))
    allies = jnp.array([[10.0, 8.0], [10.0, 16.0], [10.0, 24.0]])
    return rigged(
        env_state,
        unit_positions=jnp.concatenate([allies, allies + jnp.array([[3.0, 0.0]])]),
        unit_health=jnp.array([45.0, 45.0, 45.0, 1.0, 1.0, 1.0]),
    )


def test_win_is_terminated_with_score_one(marines, last_stand):
    _, row = marines.step(jax.random.key(1), last_stand, jnp.array([5, 6, 7]))
    assert row.terminated.all() and not row.truncated and row.score == 1.0
    np.testing.assert_allclose(row.reward, 1.0 + 1 / 45, rtol=1e-5)


def test_win_on_the_last_step_is_no_truncation(marines, last_stand):
    at_limit = rigged(last_stand, step=jnp.array(marines.env.spec.episode_limit - 1))
    _, row = marines.step(jax.random.key(1), at_limit, jnp.array([5, 6, 7]))
    assert row.terminated.all() and not row.truncated and row.score == 1.0
    _, row = marines.step(jax.random.key(1), at_limit, jnp.array([STOP] * 3))
    assert not row.terminated.any() and row.truncated and row.score == 0.0


def test_the_dead_see_nothing_and_may_only_stop(marines, last_stand):
    health = last_stand.game.unit_health.at[1].set(0.0)
    dead = rigged(last_stand, unit_health=health, unit_alive=health > 0)
    env_state, row = marines.step(jax.random.key(1), dead, jnp.array([STOP, 2, STOP]))
    np.testing.assert_array_equal(row.alive, [True, False, True])
    assert not row.obs[1].any() and row.obs[0].any()
    np.testing.assert_array_equal(jnp.flatnonzero(row.available[1]), [STOP])
    assert not row.terminated.any()
    np.testing.assert_array_equal(env_state.game.unit_positions[1], [10.0, 16.0])


def test_limit_truncates_after_exactly_that_many_steps(crawler):
    env = crawler.env
    env_state, row = crawler.reset(jax.random.key(0))
    for t in range(1, env.spec.episode_limit + 1):
        env_state, row = crawler.step(jax.random.key(t), env_state, jnp.array([STOP, STOP]))
        assert not row.terminated.any()
        assert (
            row.truncated == is_last(row) == (t == env.spec.episode_limit) == ~jnp.isnan(row.score)
        )
    assert row.score == 0.0
    # Weapons unused for 150 s have cooldowns far below zero.
    assert row.state.min() >= 0.0 and row.state.max() <= 1.0
    np.testing.assert_allclose(row.state[1:3] * 32, env_state.game.unit_positions[0], rtol=1e-5)


def test_spine_crawler_is_rooted_and_hits_with_worked_out_damage(crawler):
    env_state, _ = crawler.reset(jax.random.key(0))
    start = env_state.game.unit_positions[2]
    env_state = rigged(env_state, unit_health=jnp.array([9e3, 9e3, 300.0]))
    closest = np.inf
    for t in range(30):
        way = start[None] - env_state.game.unit_positions[:2]
        up_or_right = jnp.where(abs(way[:, 1]) > abs(way[:, 0]), 0, 1)
        into_it = jnp.where(jnp.take_along_axis(way, 1 - up_or_right[:, None], 1)[:, 0] > 0, 0, 2)
        env_state, _ = crawler.step(jax.random.key(t), env_state, up_or_right + into_it)
        np.testing.assert_array_equal(env_state.game.unit_positions[2], start)
        closest = min(closest, jnp.linalg.norm(way, axis=1).min())
    assert closest < 0.875 + 0.625 + 0.1, "the stalkers touched it"
    lost = 9e3 - env_state.game.unit_health[:2]
    assert lost.sum() > 0 and (lost % 29.0 == 0).all()
    env_state, _ = crawler.step(jax.random.key(99), env_state, jnp.array([5, STOP]))
    assert env_state.game.unit_health[2] == 300.0 - 16.0


@pytest.mark.parametrize("name", smax.SCENARIOS)
def test_every_scenario_has_its_declared_shapes(name):
    env = registry.make(f"smax/{name}")
    spec, key = env.spec, jax.random.key(0)
    env_state, row = jax.eval_shape(env.reset, key)
    assert row.obs.shape == (spec.n_agents, spec.obs_dim)
    assert row.state.shape == (spec.state_dim,)
    assert row.available.shape == (spec.n_agents, spec.action_space.n)
    assert row.available.dtype == row.terminated.dtype == row.truncated.dtype == jnp.bool_
    action = jax.ShapeDtypeStruct((spec.n_agents,), jnp.int32)
    after = jax.eval_shape(env.step, key, env_state, action)
    same = jax.tree.map(
        lambda a, b: (a.shape, a.dtype) == (b.shape, b.dtype), after, (env_state, row)
    )
    assert jax.tree.all(same)


def test_names_and_sizes():
    rows = {row.name: row for row in registry.names()}
    assert rows["smax/3s_vs_4z"][1:] == (
        3, 88, 84, 9, 200, "win_rate", "3 stalkers against 4 zealots",
    )  # fmt: skip
    assert rows["smax/2s_vs_1sc"][1:6] == (2, 39, 39, 6, 300)
    assert rows["smax/corridor"][1:6] == (6, 387, 360, 29, 400)
    assert "test/counting" in rows
    for name in ("smax/3s_vs_6z", "3m", "smox/3m"):
        with pytest.raises(UserError, match=f"unknown environment '{name}'.*smax/3s_vs_4z"):
            registry.make(name)


GAP = (14.5, 17.5)


@pytest.fixture(scope="module")
def corridor_play():
    """150 steps of 32 episodes: 16 heuristic, 8 random, 8 random among units that do not die."""
    env = smax.make("corridor")
    allies = env.heuristic()

    def episode(key, is_random, is_immortal):
        key_reset, key = jax.random.split(key)
        env_state, row = env.reset(key_reset)
        health = jnp.where(is_immortal, 1e6, env_state.game.unit_health)
        env_state = rigged(env_state, unit_health=health)

        def body(carry, key):
            env_state, row, policy_state = carry
            key_allies, key_random, key_step = jax.random.split(key, 3)
            policy_state, heuristic = allies.act(policy_state, row, key_allies)
            action = jnp.where(is_random, random_action(key_random, row.available), heuristic)
            may = jnp.take_along_axis(row.available, heuristic[:, None], axis=1).all()
            env_state, row = env.step(key_step, env_state, action)
            return (env_state, row, policy_state), (env_state.game.unit_positions, row, may)

        carry = env_state, row, allies.initial(row)
        first = env_state.game.unit_positions
        positions, rows, may = jax.lax.scan(body, carry, jax.random.split(key, 150))[1]
        return jnp.concatenate([first[None], positions]), rows, may

    kind = jnp.arange(32)
    positions, rows, may = jax.jit(jax.vmap(episode))(
        jax.random.split(jax.random.key(0), 32), kind >= 16, kind >= 24
    )
    return np.asarray(positions), rows, may


def test_nobody_passes_a_wall_but_through_the_gap(corridor_play):
    positions, _, _ = corridor_play
    x, y = positions[..., 0], positions[..., 1]
    in_gap = (GAP[0] <= y) & (y <= GAP[1])
    in_band = (x > 13.0) & (x < 17.0)
    assert in_gap[in_band].all()
    crossed = ((x[:, :-1] <= 15.0) != (x[:, 1:] <= 15.0)) & ~(in_band[:, :-1] & in_band[:, 1:])
    near_gap = abs(y - 16.0) < 3.5
    assert (near_gap[:, :-1] & near_gap[:, 1:])[crossed].all()
    assert in_band[..., 6:].sum() > 100 and (x[..., 6:] < 13.0).sum() > 1000, "zerglings came"


def test_corridor_battles_end_by_elimination(corridor_play):
    _, rows, _ = corridor_play
    ended = np.asarray(rows.terminated[..., 0].any(axis=1))
    assert ended[:16].sum() >= 15, "heuristic allies"
    assert ended[16:24].sum() >= 7, "zerglings find allies who wander"
    assert not ended[24:].any()


def test_heuristic_allies_only_choose_available_actions(corridor_play):
    _, rows, may = corridor_play
    assert may.all() and not rows.alive.all(), "the dead among them"


def test_state_stays_within_the_unit_interval(corridor_play):
    _, rows, _ = corridor_play
    mortal = rows.state[:24]
    assert mortal.min() >= 0.0 and mortal.max() <= 1.0


@pytest.fixture(scope="module")
def ground():
    battle = smax.SCENARIOS["corridor"]
    return TerrainSMAX(battle.walls, scenario=battle.scenario)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ((12.9, 10.0), (13.1, 10.2), (12.9, 10.2)),  # along the wall
        ((12.9, 16.0), (13.1, 16.2), (13.1, 16.2)),  # into the gap
        ((15.0, 17.4), (15.2, 17.6), (15.2, 17.4)),  # along the gap's side
        ((12.9, 10.0), (13.1, 10.0), (12.9, 10.0)),  # head on
    ],
)
def test_slide(ground, old, new, expected):
    result = ground._slide(jnp.array([old]), jnp.array([new]))
    np.testing.assert_array_equal(result, np.array([expected], np.float32))


@pytest.mark.parametrize(
    ("position", "action", "expected"),
    [
        ((18.0, 20.0), 3, 2),  # left into the wall above the gap: down to the gap
        ((18.0, 10.0), 3, 0),  # below the gap: up
        ((12.0, 0.5), 1, 0),  # at the map's edge still towards the gap
        ((18.0, 16.0), 3, 3),  # through the gap
        ((14.0, 16.5), 0, 3),  # up inside the gap: out by the nearer end
        ((16.0, 15.0), 2, 1),
        ((18.0, 20.0), STOP, STOP),
        ((18.0, 20.0), 7, 7),  # attacks are no steps
    ],
)
def test_detour(ground, position, action, expected):
    assert ground.detour(jnp.array(position), jnp.array(action)) == expected


def test_the_enemy_does_not_chase_what_a_wall_hides(ground):
    zealot, zergling = jnp.array([12.9, 22.0]), jnp.array([17.5, 16.0])  # 7.6 apart, sight is 8
    initial, policy = attack_closest(ground, team=1)
    with jax.numpy_rank_promotion("allow"):
        _, state = ground.reset(jax.random.key(0))
        state = replace(
            state,
            unit_positions=state.unit_positions.at[0].set(zealot).at[6].set(zergling),
            unit_alive=jnp.isin(jnp.arange(30), jnp.array([0, 6])),
        )
        obs = ground.get_obs(state)
        enemy_obs = jnp.stack([obs[f"enemy_{i}"] for i in range(24)])
        actions, _ = jax.jit(policy)(jax.random.key(0), initial, enemy_obs)
    assert enemy_obs[0, :-10].any(), "it does see the zealot, for whom it would walk up"
    assert actions[0] == 3, "through the gap"


def test_walls_hide(ground):
    def hidden(a, b):
        return bool(ground.hidden(jnp.array(a), jnp.array(b)))

    assert hidden((18.0, 20.0), (12.0, 20.0)) and hidden((12.0, 20.0), (18.0, 16.0))
    assert not hidden((18.0, 16.0), (12.0, 16.0)) and not hidden((18.0, 20.0), (18.0, 2.0))
    assert not hidden((12.0, 20.0), (10.0, 20.0))
