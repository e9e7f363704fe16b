"""QMIX on real rows: its memory, TD(lambda) targets across episodes by hand, and what it learns."""

from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from numpy.testing import assert_allclose, assert_array_equal
from tests.tiny import tiny

from mabl.algorithms.base import Experience
from mabl.algorithms.recurrent_qmix import RecurrentQMIX
from mabl.behaviour.qmix import Values
from mabl.behaviour.recurrent_qmix import (
    ActionFilter,
    QNetworks,
    RecurrentQMIXConfig,
    replay_loss,
    td_targets,
)
from mabl.envs.base import Discrete, EnvSpec
from mabl.envs.counting import CountingEnv
from mabl.errors import UserError
from mabl.execution import LocalExecutor, executor_of
from mabl.nets.mlp import Linear
from mabl.replay import sample_sequences
from mabl.rollout import rollout, start
from mabl.rows import TimeStep
from mabl.training.programs import build

CONFIG = RecurrentQMIXConfig(gamma=0.5, td_lambda=0.5, burn_in=0, batch_length=8)


def leaves(tree: Any) -> list[np.ndarray]:
    return [np.asarray(x) for x in jax.tree.leaves(tree)]


class Numbered(eqx.Module):
    """A filter whose memory is the observation."""

    def initial(self) -> Array:
        return jnp.zeros(())

    def features(self, memory: Array) -> Array:
        return memory

    def unroll(self, memory: Array, action: Array, obs: Array, is_first: Array) -> Array:
        return obs


# --- the memory -------------------------------------------------------------------------------


def test_unrolling_is_what_execution_does_row_by_row():
    memory_filter = ActionFilter(4, 3, 8, jax.random.key(0))
    obs = jax.random.normal(jax.random.key(1), (6, 4))
    action = jnp.array([2, 1, 0, 2, 2, 1])
    is_first = jnp.array([False, False, True, False, False, True])
    encoded = Discrete(3).encode(action)
    unrolled = eqx.filter_jit(memory_filter.unroll)(jnp.zeros(8), encoded, obs, is_first)
    memory = jnp.zeros(8)
    for t in range(6):
        forgotten = is_first[t]  # the caller of a filter resets memory and action
        memory = memory_filter(
            jnp.where(forgotten, 0.0, memory),
            jnp.where(forgotten, 0.0, encoded[t]),
            obs[t],
            jax.random.key(0),
        )
        assert_allclose(unrolled[t], memory, rtol=1e-5, atol=1e-6)
    # The previous action is seen, except at a first row.
    other = eqx.filter_jit(memory_filter.unroll)(
        jnp.zeros(8), encoded.at[2].set(encoded[3]).at[4].set(encoded[2]), obs, is_first
    )
    assert_array_equal(other[:4], unrolled[:4])
    assert (other[4] != unrolled[4]).any()


@cache
def played() -> tuple[RecurrentQMIX, Any, TimeStep, Array]:
    """A learner, 24 rows of the counting environment, and memories with which it acted there."""
    config = tiny("qmix", "test/counting")
    env = CountingEnv()
    algorithm = RecurrentQMIX(env.spec, config)
    learner = jax.jit(algorithm.init)(jax.random.key(0))
    executor = executor_of(algorithm.policy(learner), env.spec.action_space)
    assert isinstance(executor, LocalExecutor)

    @jax.jit
    def run(key: Array) -> tuple[TimeStep, Array]:
        rows = rollout(env, executor, start(env, executor, key), key, 24)[1].rows

        def step(memory: Array, row: TimeStep) -> tuple[Array, Array]:
            memory, _ = executor.act(memory, row, key)
            return memory, memory

        first = jax.tree.map(lambda x: x[0], rows)
        return rows, jax.lax.scan(step, executor.initial(first), rows)[1]

    return algorithm, learner, *run(jax.random.key(1))


def test_learning_sees_the_memories_that_acting_had():
    _, learner, rows, memory = played()
    view = eqx.filter_jit(learner.online.view)(rows)
    assert_allclose(view.actor_features, learner.online.filter.features(memory), atol=1e-5)
    assert_array_equal(view.critic_features, rows.state)
    assert_array_equal(view.available, rows.available)
    assert rows.is_first.sum() >= 3


# --- targets ----------------------------------------------------------------------------------


def some_rows(**changes) -> TimeStep:
    """Eight rows of two agents with three actions: episodes 0 to 2, 3 to 5, and from 6 on.

    The first is terminated at row 2, the second truncated at row 5. Team rewards on arriving are
    1, 2, (reset), 3, 4, (reset), 5; agents differ by 2.
    """
    team = np.array([9, 1, 2, 0, 3, 4, 0, 5], np.float32)
    rows = TimeStep(
        prev_action=np.zeros((8, 2), np.int32),
        reward=team[:, None] + np.float32([-1, 1]),
        terminated=np.zeros((8, 2), bool),
        truncated=np.arange(8) == 5,
        obs=np.zeros((8, 2, 1), np.float32),
        state=np.arange(8, dtype=np.float32)[:, None],
        available=np.ones((8, 2, 3), bool),
        alive=np.ones((8, 2), bool),
        is_first=np.isin(np.arange(8), [0, 3, 6]),
        score=np.full(8, np.nan, np.float32),
    )
    rows.terminated[2] = True
    rows.terminated[1, 0] = True  # agent 0 is out, the team goes on
    return rows._replace(**changes)


VALUE = np.array([80, 8, 16, 24, 32, 40, 48, 56], np.float32)


def targets(rows: TimeStep, **options) -> tuple[np.ndarray, np.ndarray]:
    config = replace(CONFIG, **options)
    return jax.device_get(jax.jit(lambda v, r: td_targets(v, r, config))(VALUE, rows))


def test_targets_across_a_termination_and_a_truncation_by_hand():
    # From the back, gamma = lambda = 1/2, the values V as above:
    # y_6 = 5 + 0.5 V_7 = 5 + 28 = 33
    # Row 6 is a reset: y_5 does not count, and hands back V_5 = 40 to the truncated episode.
    # y_4 = 4 + 0.5 (0.5 V_5 + 0.5 * 40) = 4 + 20 = 24
    # y_3 = 3 + 0.5 (0.5 V_4 + 0.5 y_4) = 3 + 0.5 (16 + 12) = 17
    # Row 3 is a reset: y_2 hands back V_2 = 16, which the terminated episode does not take.
    # y_1 = 2
    # y_0 = 1 + 0.5 (0.5 V_1 + 0.5 y_1) = 1 + 0.5 (4 + 1) = 3.5
    # Row 0's own reward, 9, is not in any.
    target, weight = targets(some_rows())
    assert_allclose(target, [3.5, 2, 16, 17, 24, 40, 33])
    assert_array_equal(weight, [1, 1, 0, 1, 1, 0, 1])


def test_targets_with_lambda_0_are_one_step_and_with_1_are_returns():
    # 1 + 0.5 V_1, 2, -, 3 + 0.5 V_4, 4 + 0.5 V_5, -, 5 + 0.5 V_7
    assert_allclose(targets(some_rows(), td_lambda=0.0)[0], [5, 2, 16, 19, 24, 40, 33])
    # 1 + 0.5 * 2, 2, -, 3 + 0.5 * 24, 4 + 0.5 V_5, -, 5 + 0.5 V_7
    assert_allclose(targets(some_rows(), td_lambda=1.0)[0], [2, 2, 16, 15, 24, 40, 33])


@pytest.mark.parametrize(
    ("resets", "burn_in", "weight"),
    [
        # It begins at a reset: burning in is not needed.
        ([0, 3, 6], 3, [1, 1, 0, 1, 1, 0, 1]),
        # It begins in the middle: three rows fill the memory, the last of them before a reset
        ([3, 6], 3, [0, 0, 0, 1, 1, 0, 1]),
        # ... two of six, as rows from the reset at row 2 on count
        ([2, 6], 6, [0, 0, 1, 1, 1, 0, 1]),
        ([], 5, [0, 0, 0, 0, 0, 1, 1]),
        ([], 0, [1, 1, 1, 1, 1, 1, 1]),
    ],
)
def test_rows_that_fill_the_memory_and_transitions_to_resets_do_not_count(resets, burn_in, weight):
    rows = some_rows(is_first=np.isin(np.arange(8), resets))
    assert_array_equal(targets(rows, burn_in=burn_in)[1], weight)


# --- the loss ---------------------------------------------------------------------------------


class Table(NamedTuple):
    """Values looked up by the feature, the number of row and agent."""

    rows: Array

    def __call__(self, features: Array) -> Array:
        return self.rows[features[0].astype(int)]


def one_and_two(q: Array, state: Array) -> Array:
    """A mixer: agent 1 counts twice, and the state is added."""
    return q[0] + 2 * q[1] + state.sum()


# Rows 0, 1 and 2 of agents 0 and 1
ONLINE = [[1, 0, 0], [0, 3, 0], [1, 5, 9], [4, 2, 3], [1, 7, 2], [0, 0, 6]]
TARGET = [[0, 0, 0], [0, 0, 0], [10, 20, 30], [1, 2, 3], [8, 4, 16], [5, 6, 7]]


def networks(table: Any) -> QNetworks:
    return QNetworks(Numbered(), Values(Table(jnp.float32(table)), one_and_two))  # pyright: ignore


def three_rows() -> TimeStep:
    """Rows of one episode; agent 0 dies at the third. State 0, 1, 2."""
    rows = jax.tree.map(lambda x: x[:3].copy(), some_rows())
    rows.terminated[:] = False
    rows.obs[..., 0] = [[0, 1], [2, 3], [4, 5]]
    rows.prev_action[1:] = [[0, 1], [2, 0]]
    rows.available[1, 0, 2] = False
    rows.alive[2, 0], rows.available[2, 0] = False, [True, False, False]
    return rows


def loss_of(online: Any, rows: TimeStep, **options) -> tuple[float, dict[str, float]]:
    config = replace(CONFIG, batch_length=3, **options)
    batch = jax.tree.map(lambda x: x[None], rows)
    return jax.device_get(
        jax.jit(lambda table: replay_loss(networks(table), networks(TARGET), batch, config))(
            jnp.float32(online)
        )
    )


def test_the_double_q_loss_by_hand():
    # Row 1: online agent 0 would pick 2 (9), which is not available, so 1 (5); agent 1 picks 0 (4).
    # The targets value this 20 + 2 * 1 + 1 = 23. (Their own choice, of 20 and 3, would be 27, and
    # the online networks value theirs 5 + 2 * 4 + 1 = 14.)
    # Row 2: agent 0 is dead and has action 0 alone; agent 1 picks 2: 8 + 2 * 7 + 2 = 24.
    # gamma = 1/2. lambda = 0: y_0 = 1 + 0.5 * 23 = 12.5, y_1 = 2 + 0.5 * 24 = 14
    # Q_tot of the actions taken: row 0 (0, 1): 1 + 2 * 3 + 0 = 7; row 1 (2, 0): 9 + 2 * 4 + 1 = 18.
    # (Of past actions, targets ask nothing.) Loss: 0.5 (5.5^2 + 4^2) / 2 = 11.5625
    loss, metrics = loss_of(ONLINE, three_rows(), td_lambda=0.0)
    assert_allclose(loss, 11.5625, rtol=1e-6)
    assert_allclose(metrics["behaviour/critic_loss"], loss)
    assert_allclose(metrics["behaviour/value"], (7 + 18) / 2, rtol=1e-6)
    assert_allclose(metrics["behaviour/return"], (12.5 + 14) / 2, rtol=1e-6)
    # lambda = 1/2: y_0 = 1 + 0.5 (0.5 * 23 + 0.5 * 14) = 10.25: 0.5 (3.25^2 + 4^2) / 2
    assert_allclose(loss_of(ONLINE, three_rows())[0], 6.640625, rtol=1e-6)


def test_the_loss_leaves_out_burnt_in_rows():
    rows = three_rows()._replace(is_first=np.zeros(3, bool))
    # Row 1 alone: 0.5 * 4^2
    assert_allclose(loss_of(ONLINE, rows, burn_in=1)[0], 8.0, rtol=1e-6)
    # ... whatever was earned and done at row 0
    rows.reward[1], rows.prev_action[1] = 1e3, [1, 2]
    assert_allclose(loss_of(ONLINE, rows, burn_in=1)[0], 8.0, rtol=1e-6)


def test_values_of_unavailable_actions_matter_to_no_target():
    rows = three_rows()
    rows.prev_action[2] = [1, 0]  # what was taken is available
    expected = loss_of(ONLINE, rows)[0]
    for row, action in ((2, 2), (4, 1), (4, 2)):  # of agent 0 at rows 1 and 2
        online, target = np.float32(ONLINE), np.float32(TARGET)
        online[row, action] = target[row, action] = 1e4
        batch = jax.tree.map(lambda x: x[None], rows)
        config = replace(CONFIG, batch_length=3)
        assert replay_loss(networks(online), networks(target), batch, config)[0] == expected


# --- with real networks -----------------------------------------------------------------------

SPEC = EnvSpec("stub", 3, 5, 4, Discrete(4), 10, "score")


def a_batch(seed: int = 0) -> TimeStep:
    """Four sequences of ten random rows, in which episodes end; not all actions are available."""
    rng = np.random.default_rng(seed)
    shape = (4, 10, 3)
    rows = TimeStep(
        prev_action=rng.integers(0, 4, shape).astype(np.int32),
        reward=rng.normal(size=shape).astype(np.float32),
        terminated=np.zeros(shape, bool),
        truncated=np.zeros(shape[:2], bool),
        obs=rng.normal(size=(*shape, 5)).astype(np.float32),
        state=rng.normal(size=(*shape[:2], 4)).astype(np.float32),
        available=rng.random((*shape, 4)) < 0.7,
        alive=np.ones(shape, bool),
        is_first=np.zeros(shape[:2], bool),
        score=np.full(shape[:2], np.nan, np.float32),
    )
    rows.available[..., 0] = True
    rows.is_first[:, 6], rows.terminated[:2, 5], rows.truncated[2:, 5] = True, True, True
    return rows


@cache
def real() -> tuple[QNetworks, QNetworks, RecurrentQMIXConfig]:
    """Online and target networks that differ."""
    config = RecurrentQMIXConfig(
        hidden=8, mixer_hidden=4, hypernet_hidden=8, batch_length=10, burn_in=2
    )
    fresh = eqx.filter_jit(lambda key: QNetworks.fresh(SPEC, config, key))
    return fresh(jax.random.key(0)), fresh(jax.random.key(1)), config


def test_gradients_reach_every_parameter_of_memory_values_and_mixer_and_no_target():
    online, target, config = real()
    slope = eqx.filter_jit(
        eqx.filter_grad(lambda both, rows: replay_loss(*both, rows, config), has_aux=True)
    )
    of_online, of_target = slope((online, target), a_batch())[0]
    for gradient in leaves(of_online):
        assert np.abs(gradient).max() > 0
    for gradient in leaves(of_target):
        assert (gradient == 0).all()


def test_gradients_flow_back_to_a_reset_and_into_no_teammates_memory():
    online, *_ = real()
    rows = a_batch()  # with a reset at row 6

    @jax.jit
    @jax.grad
    def influence(obs: Array) -> Array:
        """On agent 0's value at row 8 of each sequence."""
        view = jax.vmap(online.view)(rows._replace(obs=obs))
        return jax.vmap(jax.vmap(jax.vmap(online.values.q)))(view.actor_features)[:, 8, 0].sum()

    felt = np.abs(influence(rows.obs)).max(-1)
    assert (felt[:, 6:9, 0] > 0).all()
    assert (felt[:, :6] == 0).all() and (felt[:, 9:] == 0).all() and (felt[..., 1:] == 0).all()


def test_q_tot_never_falls_when_an_agents_value_rises():
    online, _, _ = real()
    rows = jax.tree.map(lambda x: jnp.asarray(x[0]), a_batch())
    rng = np.random.default_rng(0)
    # Weights that no initialisation gives count as well.
    wild = jax.tree.map(lambda x: jnp.float32(rng.normal(size=x.shape)), online)

    @jax.jit
    def totals(networks: QNetworks, raised: Array) -> Array:
        """Q_tot `[T]` with something added to each agent's value of action 0."""
        view = networks.view(rows)
        q = jax.vmap(networks.values.agents)(view)[..., 0] + raised[None]
        return jax.vmap(networks.values.mixer)(q, view.critic_features)

    for networks in (online, wild):
        before = totals(networks, jnp.zeros(3))
        for agent in range(3):
            after = totals(networks, jnp.zeros(3).at[agent].set(2.0))
            assert (after >= before - 1e-5 * np.abs(before)).all()
            assert networks is wild or (after > before).all()  # ELU dies out far below zero


def test_unavailable_actions_are_never_chosen():
    _, _, rows, _ = played()  # mostly at random: epsilon begins at 1
    t, action = rows.obs[:-1, :, 0], rows.prev_action[1:]
    acted = ~rows.is_first[1:]
    assert (action != t % 3)[acted].all()  # action t mod 3 is not available at row t
    assert len(np.unique(action[acted])) == 3


def test_the_greedy_value_is_that_of_the_actions_that_execution_prefers():
    online, _, _ = real()
    rows = jax.tree.map(lambda x: jnp.asarray(x[0]), a_batch())
    view = online.view(rows)
    best = jax.vmap(online.values.best)(view)
    policy = RecurrentQMIX(SPEC, tiny("qmix")).policy  # greedy whatever epsilon is
    learner = type("Learner", (), {"online": online, "epsilon": jnp.float32(0.9)})
    choice = jax.vmap(jax.vmap(policy(learner).actor))(view.actor_features, view.available)  # pyright: ignore
    assert_array_equal(choice.mode(), best)
    assert np.take_along_axis(rows.available, np.asarray(best)[..., None], -1).all()
    assert_allclose(online.greedy(rows), jax.vmap(online.values.chosen)(view, best), rtol=1e-5)


# --- updates ----------------------------------------------------------------------------------


@cache
def updated() -> tuple[Any, Any, Any, dict[str, Array]]:
    """Algorithm, learner before and after one update of a replay, and metrics of it."""
    training = build(tiny("qmix", "test/counting"))
    algorithm = training.algorithm

    @jax.jit
    def run(key: Array) -> tuple:
        state = training.init(key)
        collectors, collected = training.collect(state.learner, state.collectors, key)
        replay = training.store(state.replay, collected)
        experience = Experience(replay, collectors, collected, jnp.float32(0.5))
        return state.learner, *algorithm.update_policy(state.learner, experience, key)

    return algorithm, *jax.device_get(run(jax.random.key(0)))


def test_an_update_moves_all_networks_and_the_targets_by_their_rate():
    algorithm, before, after, metrics = updated()
    rate = algorithm.config.recurrent_qmix.target_rate
    moved = zip(
        leaves(before.target),
        leaves(after.online),
        leaves(after.target),
        leaves(before.online),
        strict=True,
    )
    for old, new, target, started in moved:
        assert_array_equal(old, started)
        assert not np.array_equal(new, started)
        assert_allclose(target, old + rate * (new - old), rtol=1e-6, atol=1e-7)
    assert all(np.isfinite(value) for value in metrics.values())


def test_epsilon_is_a_share_of_the_run():
    algorithm, before, after, metrics = updated()
    config = algorithm.config.recurrent_qmix
    assert before.epsilon == config.epsilon_start == 1.0
    # Half the run is done, of the share .6 over which it falls from 1 to .5
    assert config.epsilon_share == 0.6 and config.epsilon_end == 0.5
    assert_allclose(after.epsilon, 1 - 0.5 * 0.5 / 0.6, rtol=1e-6)
    assert metrics["behaviour/epsilon"] == after.epsilon


def test_diagnostics_tell_the_greedy_value_at_resets_in_the_environments_units():
    config = tiny("qmix", "test/counting")
    training = build(replace(config, training=replace(config.training, reward_scale=4.0)))
    state = jax.jit(training.init)(jax.random.key(0))
    collected = jax.jit(training.collect)(state.learner, state.collectors, jax.random.key(1))[1]
    replay = training.store(state.replay, collected)
    told = training.algorithm.diagnose(state.learner, replay, jax.random.key(2))
    length = config.recurrent_qmix.batch_length
    rows = sample_sequences(replay, jax.random.key(2), 128, length)
    value = jax.vmap(state.learner.online.greedy)(rows)
    assert_allclose(told["behaviour/value_at_reset"], value[rows.is_first].mean() / 4, rtol=1e-5)


# --- mistakes ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("burn_in", "length"), [(-1, 10), (9, 10), (0, 1)])
def test_a_burn_in_that_leaves_nothing_to_learn_is_a_users_mistake(burn_in, length):
    with pytest.raises(UserError, match=f"--recurrent-qmix.burn-in is {burn_in}: give a number"):
        RecurrentQMIXConfig(burn_in=burn_in, batch_length=length)


@pytest.mark.parametrize("field", ["model_updates", "pretrain_updates"])
def test_updates_of_a_model_are_a_users_mistake(field):
    config = tiny("qmix")
    config = replace(config, training=replace(config.training, **{field: 3}))
    with pytest.raises(UserError, match="is 3: qmix has no model: give 0"):
        build(config)


def test_values_are_linear_in_memories():
    online, _, _ = real()
    (layer,) = online.values.q.layers
    assert isinstance(layer, Linear) and layer.weight.shape == (8, 4)
