"""The counting environment from collection to imagination: a row never meets another row's data."""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from numpy.testing import assert_allclose, assert_array_equal

from mabl.algorithms.model_based import ModelBased, starts
from mabl.algorithms.presets import preset
from mabl.behaviour.actor import MaskedCategorical
from mabl.envs.base import Discrete
from mabl.envs.counting import CountingEnv
from mabl.imagination import imagine_trajectory
from mabl.replay import sample_sequences
from mabl.training.loop import Training, steps_in
from mabl.world_models.base import observe_sequence
from mabl.world_models.heads import Predictions
from mabl.world_models.mabl import MABL

LENGTH = 6


class Seen(NamedTuple):
    """The latent of `Witness`: what it was shown last, and how many rows it has seen."""

    count: Array
    prev_action: Array
    obs: Array
    state: Array
    is_first: Array


class Witness(eqx.Module):
    """A world model whose latent is what it is given."""

    def initial(self):
        return Seen(
            jnp.int32(0), jnp.zeros(2, jnp.int32), jnp.zeros((2, 4)), jnp.zeros(2), jnp.bool_(False)
        )

    def encode(self, row):
        return row.prev_action, row.obs, row.state, row.is_first

    def observe(self, latent, inputs, key):
        return Seen(latent.count + 1, *inputs), {"level": jnp.zeros((2, 1, 1))}


@pytest.fixture(scope="module")
def drawn():
    """Sequences `[32, LENGTH]` from a replay filled by `Training`, and what `Witness` saw."""
    config = preset("quick", "test/counting", "mabl")
    config = replace(
        config,
        training=replace(
            config.training,
            num_envs=3,
            collect_steps=10,
            replay_capacity=3 * 25,
            reward_scale=0.5,
        ),
        world_model=replace(
            config.world_model, hidden=16, n_categoricals=2, n_classes=2, n_hidden=1
        ),
        mappo=replace(config.mappo, hidden=16, n_hidden=1),
    )
    env = CountingEnv()
    training = Training(env, ModelBased(MABL, env.spec, config))

    @jax.jit
    def fill(key):
        state = training.init(key)
        collectors, replay, steps = state.collectors, state.replay, []
        for i in range(4):  # 40 rows in lanes of 25: the ring wraps around
            key_collect = jax.random.fold_in(key, i)
            collectors, collected = training.collect(state.learner, collectors, key_collect)
            replay = training.store(replay, collected)
            steps.append(steps_in(collected))
        rows = sample_sequences(replay, jax.random.key(1), 32, LENGTH)
        latents, _ = jax.vmap(observe_sequence, in_axes=(None, 0, 0))(
            Witness(),
            rows,
            jax.random.split(jax.random.key(2), 32),
        )
        return rows, latents, replay, jnp.stack(steps)

    return jax.device_get(fill(jax.random.key(0)))


def test_environment_steps_are_rows_that_are_not_resets(drawn):
    _, _, replay, steps = drawn
    assert_array_equal(replay.size, [25] * 3)
    assert_array_equal(replay.cursor, [40 % 25] * 3)
    # 4 x 10 rows in 3 environments, episodes of 6 or 8 rows: 5 to 7 resets in each
    assert 120 - 21 <= steps.sum() <= 120 - 15


def test_sequences_count_on_within_episodes_and_begin_again_after_their_ends(drawn):
    rows, *_ = drawn
    t, episode = np.moveaxis(rows.state, -1, 0)
    for now, after in ((k, k + 1) for k in range(LENGTH - 1)):
        ended = np.where(episode[:, now] % 2 == 0, t[:, now] == 5, t[:, now] == 7)
        assert_array_equal(rows.is_first[:, after], ended)
        assert_array_equal(t[:, after], np.where(ended, 0, t[:, now] + 1))
        same = episode[:, after] == episode[:, now]
        assert same[~ended].all()
    assert ended.any()


def test_stored_rewards_are_scaled_and_belong_to_their_row(drawn):
    rows, *_ = drawn
    expected = 0.5 * (100 * rows.state[..., :1] + rows.prev_action)
    assert_array_equal(rows.reward, np.where(rows.is_first[..., None], 0, expected))


def test_actions_were_available_at_the_row_before(drawn):
    rows, *_ = drawn
    stepped = ~rows.is_first
    t = rows.state[..., :1]
    assert (rows.prev_action != (t - 1) % 3)[stepped].all()


def test_the_model_sees_row_t_with_the_action_that_led_to_it(drawn):
    rows, seen, *_ = drawn
    assert_array_equal(seen.count, np.broadcast_to(np.arange(1, LENGTH + 1), (32, LENGTH)))
    assert_array_equal(seen.obs, rows.obs)
    assert_array_equal(seen.state, rows.state)
    assert_array_equal(seen.is_first, rows.is_first)
    # The environment wrote into obs_t the action that it was given: a_{t-1}.
    assert_array_equal(seen.prev_action, seen.obs[..., 2].astype(int))


@pytest.mark.parametrize("n_starts", [None, 20, 150, 32 * LENGTH])
def test_starts_pair_each_latent_with_its_own_rows_availability_and_end(drawn, n_starts):
    rows, seen, *_ = drawn
    latent, available, weight = starts(
        jax.tree.map(jnp.asarray, (seen, rows)), jax.random.key(0), n_starts
    )
    latent = jax.device_get(latent)
    size = n_starts or 32 * LENGTH
    assert latent.count.shape == weight.shape == (size,)
    t, episode = latent.state[:, 0].astype(int), latent.state[:, 1].astype(int)
    assert_array_equal(latent.obs[:, :, 0], np.stack([t, t], -1))
    assert_array_equal(available, (np.arange(3) != t[:, None] % 3)[:, None].repeat(2, 1))
    assert_array_equal(weight, np.where(episode % 2 == 0, t != 5, t != 7))


def test_starts_that_end_an_episode_are_drawn_last_and_none_twice(drawn):
    rows = jax.tree.map(jnp.asarray, drawn[0])
    number = jnp.arange(32 * LENGTH).reshape(32, LENGTH)
    t, episode = np.moveaxis(rows.state, -1, 0)
    going_on = int(np.where(episode % 2 == 0, t != 5, t != 7).sum())
    assert going_on < 32 * LENGTH
    for n_starts in (1, going_on, going_on + 1, 32 * LENGTH):
        latent, _, weight = starts((number, rows), jax.random.key(0), n_starts)
        assert weight.sum() == min(n_starts, going_on)
        assert len(np.unique(latent)) == n_starts
    few = [
        tuple(np.asarray(starts((number, rows), jax.random.key(seed), 8)[0])) for seed in range(3)
    ]
    assert len(set(few)) == 3  # another key, other starts


# --- imagination ------------------------------------------------------------------------------


class Counter(NamedTuple):
    """The latent of `Clockwork`."""

    count: Array
    action: Array
    """That led here."""


class Clockwork(eqx.Module):
    """A world model that counts.

    At count c the reward is 100 c + the action that led there, action (c mod 3) is unavailable;
    11 is the end with probability 1/4, 13 for certain.
    """

    def actor_features(self, latent):
        return latent.count[:, None].astype(jnp.float32)

    def critic_features(self, latent):
        return 10.0 * latent.count[:, None]

    def imagine(self, latent, action, key):
        return Counter(latent.count + 1, action.argmax(-1))

    def predict(self, latent):
        c = latent.count
        return Predictions(
            obs=jnp.zeros((2, 1)),
            reward=100.0 * c + latent.action,
            agent_reward=jnp.full(2, -1.0),
            terminated=jnp.where(c == 13, 99.0, jnp.where(c == 11, -jnp.log(3.0), -99.0)),
            available=jnp.where(jnp.arange(3)[None] != c[:, None] % 3, 99.0, -99.0),
            action=jnp.zeros((2, 3)),
        )


@pytest.mark.parametrize("horizon", [2, 6])
def test_imagined_fields_are_aligned_as_trajectory_documents(horizon):
    start = Counter(jnp.array([10, 10]), jnp.array([0, 0]))
    # At the start the real availability counts, here action 1 alone, whatever the model says.
    available = jnp.broadcast_to(jnp.array([False, True, False]), (2, 3))
    trajectory = imagine_trajectory(
        Clockwork(),
        lambda features, available: MaskedCategorical.of(jnp.zeros(3), available),
        start,
        available,
        jnp.float32(0.5),
        jax.random.key(3),
        horizon,
        Discrete(3),
    )
    count = np.arange(10, 10 + horizon)
    assert_array_equal(trajectory.actor_features, count[:, None, None].repeat(2, 1))
    assert_array_equal(trajectory.critic_features, 10 * count[:, None, None].repeat(2, 1))
    for h in range(horizon):
        expected = [False, True, False] if h == 0 else np.arange(3) != count[h] % 3
        assert_array_equal(trajectory.available[h], [expected] * 2)
    for field in ("action", "log_prob", "reward", "continues", "weight"):
        assert getattr(trajectory, field).shape == (horizon - 1, 2), field
    for h in range(horizon - 1):  # the transition from row h to row h + 1
        action = trajectory.action[h]
        if h == 0:
            assert_array_equal(action, [1, 1])
        assert (action != count[h] % 3).all() or h == 0
        assert_allclose(trajectory.log_prob[h], np.log(1.0 if h == 0 else 0.5), atol=1e-6)
        assert_array_equal(trajectory.reward[h], 100 * count[h + 1] + action)
        assert_allclose(trajectory.continues[h], [[0.75, 1, 0, 1, 1][h]] * 2, rtol=1e-6)
        # The start counts for 1/2; rows 11 and 12 are reached with 3/4, none after 13.
        assert_allclose(trajectory.weight[h], [0.5 * [1, 0.75, 0.75, 0, 0][h]] * 2, rtol=1e-6)


def test_no_gradient_flows_through_imagination():
    def total(scale):
        trajectory = imagine_trajectory(
            Clockwork(),
            lambda features, available: MaskedCategorical.of(scale * jnp.arange(3.0), available),
            Counter(jnp.array([10, 10]), jnp.array([0, 0])),
            jnp.ones((2, 3), bool),
            jnp.float32(1.0),
            jax.random.key(3),
            3,
            Discrete(3),
        )
        return trajectory.log_prob.sum()

    assert jax.grad(total)(1.0) == 0


class Doubtful(Clockwork):
    """A world model that believes in every action with probability 0.6."""

    def predict(self, latent):
        return super().predict(latent)._replace(available=jnp.full((2, 3), jnp.log(1.5)))


@pytest.mark.parametrize(("sample", "share"), [(True, 0.6), (False, 1.0)])
def test_imagined_availability_is_a_sample_or_the_mode(sample, share):
    trajectory = imagine_trajectory(
        Doubtful(),
        lambda features, available: MaskedCategorical.of(jnp.zeros(3), available),
        Counter(jnp.array([0, 0]), jnp.array([0, 0])),
        jnp.ones((2, 3), bool),
        jnp.float32(1.0),
        jax.random.key(0),
        200,
        Discrete(3),
        sample,
    )
    assert_allclose(trajectory.available[1:].mean(), share, atol=0.05)
