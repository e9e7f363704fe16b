"""Recurrent MAPPO on real rows: memories, chunks, their alignment, returns, gradients in time."""

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from numpy.testing import assert_allclose, assert_array_equal
from tests.tiny import tiny

from mabl.algorithms.base import Experience
from mabl.algorithms.model_free import ModelFree, PolicyLearner
from mabl.behaviour.mappo import PPORows
from mabl.behaviour.recurrent import (
    Chunks,
    RecurrentFilter,
    policies,
    recurrent_policy_loss,
    value_loss,
)
from mabl.envs.counting import CountingEnv
from mabl.errors import UserError
from mabl.execution import executor_of
from mabl.nets.normaliser import Normaliser
from mabl.rollout import Collector, Episodes, Rollout, advance
from mabl.rows import TimeStep
from mabl.training.programs import build
from mabl.types import TeamView

# --- the filter -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def memory_filter() -> RecurrentFilter:
    return RecurrentFilter(4, 8, jax.random.key(0))


def test_unrolling_is_stepping_row_by_row_and_forgets_at_first_rows(memory_filter):
    obs = jax.random.normal(jax.random.key(1), (7, 4))
    is_first = jnp.array([False, False, True, False, False, True, True])
    start = jax.random.normal(jax.random.key(2), (8,))
    before, after = jax.device_get(eqx.filter_jit(memory_filter.unroll)(start, obs, is_first))
    memory = start
    for t in range(7):
        if is_first[t]:
            memory = memory_filter.initial()
        assert_allclose(before[t], memory, rtol=1e-5, atol=1e-6)
        memory = memory_filter(memory, jnp.zeros(3), obs[t], jax.random.key(0))
        assert_allclose(after[t], memory, rtol=1e-5, atol=1e-6)
    # What a row begins with is what the row before it left, but for first rows: nothing.
    assert_array_equal(before[0], start)
    for t in (1, 3, 4):
        assert_array_equal(before[t], after[t - 1])
    for t in (2, 5, 6):
        assert_array_equal(before[t], np.zeros(8))


def test_nothing_from_before_a_first_row_is_remembered(memory_filter):
    obs = jax.random.normal(jax.random.key(1), (4, 4))
    is_first = jnp.array([False, False, True, False])
    unroll = eqx.filter_jit(memory_filter.unroll)
    _, one = jax.device_get(unroll(jnp.zeros(8), obs, is_first))
    _, other = jax.device_get(unroll(jnp.ones(8), obs.at[:2].add(1.0), is_first))
    assert not np.isclose(one[:2], other[:2]).all(-1).any()
    assert_array_equal(one[2:], other[2:])


# --- two rollouts of a real training ----------------------------------------------------------


class Played(NamedTuple):
    """A rollout, its chunks, and what the executor did row by row: `[E, R, ...]`."""

    experience: Experience
    chunks: Chunks
    began: Array
    """The executor's memory when it came to a row."""
    left: Array
    """Its memory when it acted there."""
    log_prob: Array
    """Of the action that it then took."""


ROWS, LENGTH = 18, 6
"""Of a rollout, and of a chunk."""


@cache
def play(env: str) -> tuple[ModelFree, PolicyLearner, list[Played]]:
    """Two rollouts in two environments, with a policy that prefers some actions."""
    config = tiny("mappo", f"test/{env}")
    config = replace(
        config,
        training=replace(config.training, num_envs=2, collect_steps=ROWS),
        recurrent_mappo=replace(
            config.recurrent_mappo, hidden=8, chunk_length=LENGTH, actor_out_scale=3.0
        ),
    )
    training = build(config)

    def stepped(learner: PolicyLearner, collector: Collector, key: Array) -> tuple:
        """What `rollout` does, with the executor in view."""
        policy = training.algorithm.policy(learner)
        executor = executor_of(policy, training.env.spec.action_space)

        def step(collector: Collector, t: Array) -> tuple[Collector, tuple]:
            after, _ = advance(training.env, executor, collector, jax.random.fold_in(key, t))
            features = jax.vmap(policy.filter.features)(after.memory)
            choice = jax.vmap(policy.actor)(features, collector.row.available)
            log_prob = choice.log_prob(after.row.prev_action)
            return after, (collector.memory, after.memory, log_prob, after.row)

        return jax.lax.scan(step, collector, jnp.arange(ROWS))[1]

    @jax.jit
    def run(key: Array) -> tuple:
        state = training.init(key)
        state = state._replace(replay=None)  # nothing of it is learned from
        collectors, played = state.collectors, []
        for seed in (1, 2):
            key = jax.random.key(seed)
            after, collected = training.collect(state.learner, collectors, key)
            experience = Experience(state.replay, collectors, collected)
            chunks, _ = training.algorithm.chunks(state.learner, experience)
            *seen, rows = jax.vmap(stepped, in_axes=(None, 0, 0))(
                state.learner, collectors, jax.random.split(key, 2)
            )
            played.append((Played(experience, chunks, *seen), rows))
            collectors = after
        return state.learner, played

    learner, played = run(jax.random.key(0))
    played = jax.device_get(played)
    for one, rows in played:  # the executor that we watched is the one that collected
        assert_array_equal(rows.prev_action, one.experience.newest.rows.prev_action)
        assert_array_equal(rows.obs, one.experience.newest.rows.obs)
    return training.algorithm, learner, [one for one, _ in played]


@pytest.fixture(scope="module", params=["counting", "coordination"])
def game(request):
    return play(request.param)


def joined(x: Array) -> np.ndarray:
    """Chunks `[M, L, ...]` as rows `[E, R, ...]` of the two environments again."""
    return np.asarray(x).reshape(2, ROWS, *x.shape[2:])


def test_the_first_ppo_ratio_is_one(game):
    _, learner, played = game

    @jax.jit
    def recomputed(chunks: Chunks, memory: Array) -> tuple[Array, dict[str, Array]]:
        """Log-probabilities of the actions, unrolled from a memory; metrics of the loss."""
        filter, actor = learner.policy
        unroll = jax.vmap(jax.vmap(filter.unroll, in_axes=(0, 1, None), out_axes=1))
        _, memory = unroll(memory, chunks.obs, chunks.is_first)
        now = policies(filter, actor, chunks.rows.view._replace(actor_features=memory))
        metrics = recurrent_policy_loss(learner.policy, chunks, jnp.float32(0.0), 0.2)[1]
        return now.log_prob(chunks.rows.action), metrics

    for one in played:
        chunks = one.chunks
        counts, old = joined(chunks.rows.weight) == 1, joined(chunks.rows.log_prob)
        log_prob, metrics = jax.device_get(recomputed(chunks, chunks.memory))
        # The chunks' own log-probabilities, and those with which the executor really acted
        assert_allclose(np.exp(joined(log_prob) - old)[counts], 1.0, atol=1e-5)
        assert_allclose(np.exp(joined(log_prob) - one.log_prob)[counts], 1.0, atol=1e-5)
        assert np.std(old[counts]) > 0.1  # a policy with preferences
        assert metrics["behaviour/clip_fraction"] == 0
        assert_allclose(metrics["behaviour/approx_kl"], 0, atol=1e-6)
        # It would show if memories were missing: the policy depends on them.
        blank, _ = jax.device_get(recomputed(chunks, 0 * chunks.memory))
        assert np.abs(joined(blank) - old)[counts].max() > 1e-2


def test_chunks_begin_with_the_memory_that_the_executor_had_there(game):
    _, _, played = game
    in_mid_episode = False
    for one in played:
        memory = np.asarray(one.chunks.memory).reshape(2, -1, 2, 8)
        is_first = np.asarray(one.chunks.is_first).reshape(2, ROWS)
        for lane in range(2):
            for chunk in range(ROWS // LENGTH):
                row = LENGTH * chunk
                expected = 0 * one.began[lane, row] if is_first[lane, row] else one.began[lane, row]
                assert_allclose(memory[lane, chunk], expected, rtol=1e-4, atol=1e-5)
        in_mid_episode |= (one is played[1]) and not is_first[:, 0].all()
        # The policy's features at each row are the memory with which it acted there.
        features = joined(one.chunks.rows.view.actor_features)
        assert_allclose(features, one.left, rtol=1e-4, atol=1e-5)
    assert in_mid_episode  # the second rollout goes on where the first one stopped


# --- time on the counting environment ---------------------------------------------------------


@pytest.fixture(scope="module")
def counted():
    return play("counting")


def test_an_action_is_paired_with_the_row_it_was_chosen_at(counted):
    *_, played = counted
    for one in played:
        chunks = one.chunks
        t, agent, _, episode = np.moveaxis(joined(chunks.obs), -1, 0)
        weight, action = joined(chunks.rows.weight), joined(chunks.rows.action)
        rows = one.experience.newest.rows
        # Rows start with the one that the rollout before left, and miss the newest.
        assert_array_equal(t[:, 0], one.experience.before.row.obs[..., 0])
        assert_array_equal(t[:, 1:], rows.obs[:, :-1, :, 0])
        assert_array_equal(agent, np.broadcast_to([0, 1], (2, ROWS, 2)))
        # An episode's last row (5 of the even, 7 of the odd; also where collection begins) weighs
        # nothing, all others count.
        last = np.where(episode % 2 == 0, t == 5, t == 7)
        last[:, 0] |= np.asarray(one.experience.before.row.truncated)[:, None]
        assert_array_equal(weight, 1.0 - last)
        assert last[:, 1:].any() and not last.all(1).any()
        # The action at row t is the one that the environment wrote into row t + 1.
        counts = weight == 1
        assert_array_equal(action[counts], np.asarray(rows.obs)[..., 2][counts])
        assert (action != t % 3)[counts].all()  # available at row t
        assert_array_equal(joined(chunks.rows.view.available), np.arange(3) != t[..., None] % 3)
        assert_array_equal(joined(chunks.is_first), (t == 0)[..., 0])


def test_critics_see_their_own_agents_observation_and_the_state(counted):
    *_, played = counted
    for one in played:
        chunks = one.chunks
        features = joined(chunks.rows.view.critic_features)
        obs = joined(chunks.obs)
        assert features.shape == (2, ROWS, 2, 4 + 2)
        assert_array_equal(features[..., :4], obs)
        assert_array_equal(features[..., 4:], obs[..., [0, 3]])  # (t, episode)


def test_returns_on_the_counting_environment_with_a_constant_critic(counted):
    # gamma = 1/2 and lambda = 1: the reward of the step, and half the return of the next; values of
    # 8 (normalised 4, standard deviation 1, mean 4) where the rollout or a truncated episode ends.
    algorithm, learner, played = counted
    config = algorithm.config
    algorithm = replace(
        algorithm,
        config=replace(
            config, recurrent_mappo=replace(config.recurrent_mappo, gamma=0.5, gae_lambda=1.0)
        ),
    )
    learner = learner._replace(
        critic=lambda features, alive: jnp.full(features.shape[0], 4.0),
        returns=Normaliser(jnp.float32(4), jnp.float32(1), jnp.float32(1)),
    )
    constant = jax.jit(lambda experience: algorithm.chunks(learner, experience))
    ends = set()
    for one in played:
        chunks, _ = jax.device_get(constant(one.experience))
        rows = jax.tree.map(np.asarray, one.experience.newest.rows)
        target, weight = joined(chunks.rows.target), joined(chunks.rows.weight)
        scale = config.training.reward_scale
        for lane in range(2):
            later = 8.0
            for row in reversed(range(ROWS)):  # the step that leads to rows.*[row]
                if rows.is_first[lane, row]:
                    later = 8.0  # and on it goes from the last row's value
                    continue
                t, action = rows.state[lane, row, 0], rows.prev_action[lane, row]
                if rows.terminated[lane, row].all():
                    later, ends = 0.0, ends | {"terminated"}
                elif rows.truncated[lane, row]:
                    later, ends = 8.0, ends | {"truncated"}
                later = scale * (100 * t + action.mean()) + 0.5 * later
                assert weight[lane, row].all()
                assert_allclose(target[lane, row], [later] * 2, rtol=1e-5)
    assert ends == {"terminated", "truncated"}


# --- rows by hand -----------------------------------------------------------------------------


@cache
def fresh() -> PolicyLearner:
    """Any learner: what is computed by hand depends on its critic alone."""
    config = tiny("mappo", "test/counting")
    config = replace(config, recurrent_mappo=replace(config.recurrent_mappo, hidden=8))
    return eqx.filter_jit(ModelFree(CountingEnv.spec, config).init)(jax.random.key(0))


def by_hand(end: str | None = None, **options) -> tuple[Chunks, dict[str, float]]:
    """Chunks of two rows from four newest rows after one, whose values are 1, 2, 4, 8 and 16.

    Both agents are paid 1, 6, 9 and 1, agent 1 two more at row 1. With `end` row 2 is an episode's
    last, and row 3 a reset.
    """
    config = tiny("mappo", "test/counting")
    options = {"gamma": 0.5, "gae_lambda": 0.5, "chunk_length": 2, "hidden": 8} | options
    config = replace(
        config,
        training=replace(config.training, collect_steps=4),
        recurrent_mappo=replace(config.recurrent_mappo, **options),
    )
    _, row = CountingEnv().reset(jax.random.key(0))
    rows: TimeStep = jax.tree.map(lambda x: np.zeros((1, 5, *x.shape), x.dtype), row)
    rows.state[0, :, 0] = np.arange(5)
    rows.available[:], rows.alive[:] = True, True
    rows.alive[0, 1, 1] = False
    rows.reward[0] = [[50, 50], [1, 3], [6, 6], [0 if end else 9] * 2, [1, 1]]
    rows.is_first[0, 3] = end is not None
    rows.terminated[0, 2], rows.truncated[0, 2] = end == "terminated", end == "truncated"
    return jax.device_get(chunks_of(ModelFree(CountingEnv.spec, config), fresh(), rows))


@eqx.filter_jit
def chunks_of(algorithm: ModelFree, learner: PolicyLearner, rows: TimeStep) -> tuple:
    """Of rows `[1, 5, ...]`, with 2^row as the critic's value; nothing is remembered before."""
    first, rest = (jax.tree.map(lambda x, at=at: x[:, at], rows) for at in (0, slice(1, None)))
    nobody = jnp.zeros(1)
    before = Collector(None, first, jnp.zeros((1, 2, 8)), nobody, nobody)
    newest = Rollout(rest, Episodes(*[nobody] * 4), jnp.array([4]))
    # The state's first number is the row; features are 4 of the observation, then the state.
    learner = learner._replace(critic=lambda features, alive: 2.0 ** features[:, 4])
    return algorithm.chunks(learner, Experience(None, before, newest))


TARGETS = {
    # Team rewards on arriving at rows 1 to 4: 2, 6, 9 and 1. G_3 = 1 + 0.5 * 16 = 9,
    # G_2 = 9 + 0.5 (0.5 * 8 + 0.5 * 9) = 13.25, G_1 = 6 + 0.5 (0.5 * 4 + 0.5 * 13.25) = 10.3125,
    # G_0 = 2 + 0.5 (0.5 * 2 + 0.5 * 10.3125) = 5.078125
    None: [5.078125, 10.3125, 13.25, 9],
    # Row 3 is a reset: its step hands back row 2's value, 4. After a real end nothing of it counts:
    # G_1 = 6, G_0 = 2 + 0.5 (0.5 * 2 + 0.5 * 6) = 4
    "terminated": [4, 6, 4, 9],
    # G_1 = 6 + 0.5 (0.5 * 4 + 0.5 * 4) = 8, G_0 = 2 + 0.5 (0.5 * 2 + 0.5 * 8) = 4.5
    "truncated": [4.5, 8, 4, 9],
}


@pytest.mark.parametrize("end", TARGETS)
def test_targets_and_advantages_by_hand(end):
    chunks, metrics = by_hand(end)
    rows = chunks.rows
    assert rows.target.shape == (2, 2, 2)  # two chunks of two rows of two agents
    target = np.array(TARGETS[end])
    assert_allclose(rows.target.reshape(4, 2), target[:, None].repeat(2, 1))
    weight = np.array([1.0, 1.0, end is None, 1.0])[:, None].repeat(2, 1)
    assert_array_equal(rows.weight.reshape(4, 2), weight)
    # Normalised over the rows that count, the row at which agent 1 is dead excepted
    advantage = (target - [1, 2, 4, 8])[:, None].repeat(2, 1)
    counted = weight.copy()
    counted[1, 1] = 0
    mean = (counted * advantage).sum() / counted.sum()
    std = np.sqrt((counted * (advantage - mean) ** 2).sum() / counted.sum())
    assert_allclose(rows.advantage.reshape(4, 2), (advantage - mean) / std, rtol=1e-4)
    assert_allclose(metrics["behaviour/advantage_std"], std, rtol=1e-5)
    assert_allclose(
        metrics["behaviour/return"], (weight[:, 0] * target).sum() / weight[:, 0].sum(), rtol=1e-6
    )


def test_without_team_reward_every_agent_keeps_its_own():
    rows = by_hand(team_reward=False)[0].rows
    # At row 1 agent 0 is paid 1, agent 1 3, where the team had 2.
    assert_allclose(rows.target.reshape(4, 2)[0], [4.078125, 6.078125])


def test_gamma_and_lambda_are_the_flags():
    rows = by_hand(gamma=0.25, gae_lambda=0.0)[0].rows
    # Rewards 2, 6, 9, 1 and a quarter of the values 2, 4, 8, 16
    assert_allclose(rows.target.reshape(4, 2)[:, 0], [2.5, 7, 11, 5])


def test_the_critics_loss_by_hand():
    # Returns of mean 2 and variance 8 - 4 = 4. The critic says 1, which means 2 + 2 * 1 = 4.
    returns = Normaliser(jnp.float32(2), jnp.float32(4), jnp.float32(1))
    view = TeamView(
        jnp.zeros((1, 3, 2, 1)),
        jnp.ones((1, 3, 2, 1)),
        jnp.ones((1, 3, 2, 1), bool),
        jnp.ones((1, 3, 2), bool),
    )
    target = jnp.array([[[4.0, 4.0], [2.0, 6.0], [30.0, -1e3]]])
    weight = jnp.array([[[1.0, 1.0], [2.0, 1.0], [1.0, 0.0]]])
    unused = jnp.zeros((1, 3, 2))
    rows = PPORows(view, unused, unused, unused, target, weight, weight)
    # Normalised targets 1, 1; 0, 2; 14: errors 0, 0; 1, -1; -13. Half the squares 0, 0; 0.5, 0.5;
    # the last is beyond 10: 10 (13 - 5) = 80. 0.5 (2 * 0.5 + 0.5 + 80) / 6 = 6.791667
    loss, metrics = jax.jit(
        lambda rows: value_loss(lambda features, alive: features[:, 0], rows, returns, 0.5)
    )(rows)
    assert_allclose(loss, 6.791667, rtol=1e-6)
    assert metrics["behaviour/critic_loss"] == loss


# --- gradients --------------------------------------------------------------------------------


def test_gradients_flow_back_through_time_within_a_chunk(counted):
    _, learner, played = counted
    chunk = jax.tree.map(lambda x: x[:1], played[1].chunks)
    rows = chunk.rows._replace(
        weight=np.float32(np.arange(2 * LENGTH) == 2 * LENGTH - 2).reshape(1, LENGTH, 2),
        advantage=np.ones((1, LENGTH, 2), np.float32),
    )
    chunk = chunk._replace(rows=rows)

    @jax.jit
    def influence(chunk: Chunks) -> tuple[Array, Array]:
        """Of each row's observations and of the memory on the loss of agent 0's last row."""

        def loss(obs: Array, memory: Array) -> Array:
            seen = chunk._replace(obs=obs, memory=memory)
            return recurrent_policy_loss(learner.policy, seen, jnp.float32(0.0), 0.2)[0]

        by_obs, by_memory = jax.grad(loss, argnums=(0, 1))(chunk.obs, chunk.memory)
        return jnp.abs(by_obs[0]).max(-1), jnp.abs(by_memory[0]).max(-1)

    by_obs, by_memory = jax.device_get(
        influence(chunk._replace(is_first=np.zeros((1, LENGTH), bool)))
    )
    assert (by_obs[:, 0] > 0).all() and by_memory[0] > 0
    assert (by_obs[:, 1] == 0).all() and by_memory[1] == 0  # a teammate's do not matter
    # Not across a reset
    by_obs, by_memory = jax.device_get(
        influence(chunk._replace(is_first=np.arange(LENGTH)[None] == 2))
    )
    assert (by_obs[2:, 0] > 0).all() and (by_obs[:2] == 0).all() and (by_memory == 0).all()


def test_an_update_learns_filter_actor_critic_and_the_returns_scale(counted):
    algorithm, learner, played = counted
    after, metrics = eqx.filter_jit(algorithm.update_policy)(
        learner, played[1].experience, jax.random.key(0)
    )
    old, new = (jax.tree.leaves((x.policy, x.critic, x.returns)) for x in (learner, after))
    for before, now in zip(old, new, strict=True):
        assert not np.array_equal(before, now)
    assert all(np.isfinite(value) for value in metrics.values())
    # The returns' moments are those of the rows that count.
    rows = played[1].chunks.rows
    mean = (rows.weight * rows.target).sum() / rows.weight.sum()
    assert_allclose(after.returns.moments()[0], mean, rtol=1e-3)


# --- mistakes ---------------------------------------------------------------------------------


@pytest.mark.parametrize("collect_steps", [25, 5, None])
def test_rows_that_do_not_divide_into_chunks_are_a_users_mistake(collect_steps):
    config = tiny("mappo")  # chunks of 10 rows
    config = replace(config, training=replace(config.training, collect_steps=collect_steps))
    with pytest.raises(UserError) as raised:
        build(config)
    message = str(raised.value)
    assert f"--training.collect-steps is {collect_steps}" in message
    assert "--recurrent-mappo.chunk-length" in message and "10 rows" in message
