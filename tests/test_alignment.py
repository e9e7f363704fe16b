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
from mabl.behaviour.mappo import MAPPO
from mabl.envs.base import Discrete
from mabl.envs.counting import CountingEnv
from mabl.imagination import Dream, ImaginationConfig, Imagined, imagine_trajectory
from mabl.replay import sample_sequences
from mabl.rows import is_last
from mabl.training.loop import Training, steps_in
from mabl.types import Trajectory
from mabl.world_models.base import WorldModelConfig
from mabl.world_models.heads import Predictions
from mabl.world_models.mabl import MABL
from mabl.world_models.sequences import observe_sequence

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

    def observe(self, latent, inputs, key, train=False):
        return Seen(latent.count + 1, *inputs), {"level": jnp.zeros((2, 1, 1))}


@pytest.fixture(scope="module")
def drawn():
    """Sequences `[32, LENGTH]` from a replay filled by `Training`, and what `Witness` saw.

    Then the replay, and of each `collect` the steps and the rollout.
    """
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
    training = Training(env, ModelBased(MABL, MAPPO(config.mappo), env.spec, config))

    @jax.jit
    def fill(key):
        state = training.init(key)
        collectors, replay, parts = state.collectors, state.replay, []
        for i in range(4):  # 40 rows in lanes of 25: the ring wraps around
            key_collect = jax.random.fold_in(key, i)
            collectors, collected = training.collect(state.learner, collectors, key_collect)
            replay = training.store(replay, collected)
            parts.append((steps_in(collected), collected))
        rows = sample_sequences(replay, jax.random.key(1), 32, LENGTH)
        latents, _ = jax.vmap(observe_sequence, in_axes=(None, 0, 0))(
            Witness(),
            rows,
            jax.random.split(jax.random.key(2), 32),
        )
        return rows, latents, replay, jax.tree.map(lambda *x: jnp.stack(x), *parts)

    return jax.device_get(fill(jax.random.key(0)))


def test_environment_steps_are_rows_that_are_not_resets(drawn):
    _, _, replay, (steps, _) = drawn
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


def test_collected_rewards_are_scaled_but_returns_of_episodes_are_not(drawn):
    *_, (_, collected) = drawn
    first = jax.tree.map(lambda x: x[0], collected)  # 10 rows from a reset on
    for lane in range(3):
        rows, episodes = jax.tree.map(lambda x, lane=lane: x[lane], (first.rows, first.episodes))
        end = int(episodes.ended.argmax())
        assert end == (5 if rows.state[0, 1] % 2 == 0 else 7)
        rewards = 100 * rows.state[1 : end + 1, :1] + rows.prev_action[1 : end + 1]
        assert_array_equal(rows.reward[1 : end + 1], 0.5 * rewards)
        assert episodes.episode_return[end] == rewards.mean(-1).sum()


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
def test_starts_pair_each_latent_with_its_own_rows_availability_life_and_end(drawn, n_starts):
    rows, seen, *_ = drawn
    t = rows.state[..., 0]
    rows = rows._replace(alive=np.stack([t % 2 == 0, t % 4 < 2], -1))
    (latent, available, alive), weight = starts(
        *jax.tree.map(jnp.asarray, (seen, rows)), jax.random.key(0), n_starts
    )
    latent = jax.device_get(latent)
    size = n_starts or 32 * LENGTH
    assert latent.count.shape == weight.shape == (size,)
    t, episode = latent.state[:, 0].astype(int), latent.state[:, 1].astype(int)
    assert_array_equal(latent.obs[:, :, 0], np.stack([t, t], -1))
    assert_array_equal(available, (np.arange(3) != t[:, None] % 3)[:, None].repeat(2, 1))
    assert_array_equal(alive, np.stack([t % 2 == 0, t % 4 < 2], -1))
    goes_on = np.where(episode % 2 == 0, t != 5, t != 7)
    assert_array_equal(weight, goes_on)
    if n_starts is None:
        # All rows, those that end an episode replaced by others.
        assert goes_on.all()
        ended = is_last(rows).ravel()
        assert ended.sum() > 1
        every = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), seen.state)
        assert_array_equal(latent.state[~ended], np.asarray(every)[~ended])
        assert len(np.unique(latent.state[ended], axis=0)) > 1


def test_starts_that_end_an_episode_are_drawn_last_and_none_twice(drawn):
    rows = jax.tree.map(jnp.asarray, drawn[0])
    number = jnp.arange(32 * LENGTH).reshape(32, LENGTH)
    t, episode = np.moveaxis(rows.state, -1, 0)
    going_on = int(np.where(episode % 2 == 0, t != 5, t != 7).sum())
    assert going_on < 32 * LENGTH
    for n_starts in (1, going_on, going_on + 1, 32 * LENGTH):
        start, weight = starts(number, rows, jax.random.key(0), n_starts)
        assert weight.sum() == min(n_starts, going_on)
        assert len(np.unique(start.latent)) == n_starts
    few = [
        tuple(np.asarray(starts(number, rows, jax.random.key(seed), 8)[0].latent))
        for seed in range(3)
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
    11 is the end with probability 1/4, 13 for certain. Agent 1 is dead at 12, and at 12 alone.
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
            alive=jnp.where((c == 12) & (jnp.arange(2) == 1), -0.1, 0.1),
            terminated=jnp.where(c == 13, 99.0, jnp.where(c == 11, -jnp.log(3.0), -99.0)),
            available=jnp.where(jnp.arange(3)[None] != c[:, None] % 3, 99.0, -99.0),
            action=jnp.zeros((2, 3)),
        )


def imagine(
    start: Imagined,
    model: Clockwork | None = None,
    logits: Array | None = None,
    weight: float = 1.0,
    seed: int = 3,
    step=Dream.step,
    **options,
) -> Trajectory:
    """What a policy with these logits lives through in a clockwork's imagination."""
    model = Clockwork() if model is None else model
    logits = jnp.zeros(3) if logits is None else logits
    dream = Dream(
        model,
        lambda features, available: MaskedCategorical.of(logits, available),
        Discrete(3),
        ImaginationConfig(**options),
        WorldModelConfig(),
        model.critic_features,
    )
    return imagine_trajectory(dream, start, jnp.float32(weight), jax.random.key(seed), step)


def at(count: int, available=(True, True, True), alive=(True, True)) -> Imagined:
    """Both agents at that count."""
    latent = Counter(jnp.full(2, count), jnp.array([0, 0]))
    return Imagined(latent, jnp.broadcast_to(jnp.array(available), (2, 3)), jnp.array(alive))


@pytest.mark.parametrize("horizon", [2, 6])
def test_imagined_fields_are_aligned_as_trajectory_documents(horizon):
    # At the start the real availability counts, here action 1 alone, whatever the model says.
    trajectory = imagine(at(10, (False, True, False)), weight=0.5, horizon=horizon)
    view = trajectory.view
    count = np.arange(10, 10 + horizon)
    assert_array_equal(view.actor_features, count[:, None, None].repeat(2, 1))
    assert_array_equal(view.critic_features, 10 * count[:, None, None].repeat(2, 1))
    for h in range(horizon):
        expected = [False, True, False] if h == 0 else np.arange(3) != count[h] % 3
        assert_array_equal(view.available[h], [expected] * 2)
        # Agent 1 dies at count 12 and stays dead, although the model says at 13 that it lives.
        assert_array_equal(view.alive[h], [True, count[h] < 12])
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


@pytest.mark.parametrize(
    ("count", "alive", "expected"),
    [
        # Dead at the start, whatever the model says of later rows.
        (20, [False, True], [[False, True]] * 5),
        (20, [False, False], [[False, False]] * 5),
        # Agent 1 dies on arriving at 12, the third row; agent 0 is dead already.
        (10, [False, True], [[False, True]] * 2 + [[False, False]] * 3),
        # At the start what is real counts, not what the model would say there.
        (12, [True, True], [[True, True]] * 5),
        # Only on arriving: the first imagined row is 12 itself.
        (11, [True, True], [[True, True]] + [[True, False]] * 4),
    ],
)
@pytest.mark.parametrize("sample", [True, False])
def test_nobody_comes_back_to_life_in_imagination(count, alive, expected, sample):
    # The model's mode counts, at logits of 0.1 and -0.1, never a sample.
    trajectory = imagine(at(count, alive=alive), horizon=5, sample_availability=sample)
    assert_array_equal(trajectory.view.alive, expected)


class Mortal(Clockwork):
    """A world model in which each agent dies with probability 0.2 a step, and agent 0 alone says
    that the episode ends, with probability 0.5."""

    def predict(self, latent):
        return (
            super()
            .predict(latent)
            ._replace(alive=jnp.full(2, jnp.log(4.0)), terminated=jnp.array([0.0, -99.0]))
        )


@pytest.mark.parametrize(("sample", "share"), [(True, 0.8), (False, 1.0)])
def test_imagined_death_is_a_latched_sample_or_the_mode(sample, share):
    lives = [
        np.asarray(imagine(at(0), Mortal(), seed=s, horizon=3, sample_life=sample).view.alive)
        for s in range(60)
    ]
    lives = np.stack(lives)  # [S, H, N]
    assert lives[:, 0].all()
    assert not (lives[:, 2] & ~lives[:, 1]).any()  # nobody comes back
    assert abs(lives[:, 1].mean() - share) < 0.1
    assert abs(lives[:, 2].mean() - share**2) < 0.12


@pytest.mark.parametrize(("team_end", "goes_on"), [(False, [0.5, 1.0]), (True, [0.75, 0.75])])
def test_imagined_episodes_end_for_each_agent_or_for_the_team(team_end, goes_on):
    trajectory = imagine(at(0), Mortal(), horizon=4, team_end=team_end)
    goes_on = np.array(goes_on)
    assert_allclose(trajectory.continues, [goes_on] * 3, rtol=1e-6)
    assert_allclose(trajectory.weight, [np.ones(2), goes_on, goes_on**2], rtol=1e-6)


def test_no_gradient_flows_through_imagination():
    def total(scale):
        return imagine(at(10), logits=scale * jnp.arange(3.0), horizon=3).log_prob.sum()

    assert jax.grad(total)(1.0) == 0


def test_imagination_moves_on_by_the_step_that_it_is_given():
    def leap(dream, state, action, key):
        """Two steps with the same action; what is said is said of where it lands."""
        return dream.step(dream.step(state, action, key)[0], action, key)

    trajectory = imagine(at(10), step=leap, horizon=4)
    assert_array_equal(trajectory.view.actor_features[:, :, 0], [[c] * 2 for c in (10, 12, 14, 16)])
    assert_array_equal(trajectory.view.alive[:, 1], [True, False, False, False])
    for h, count in enumerate((12, 14, 16)):
        assert_array_equal(trajectory.reward[h], 100 * count + trajectory.action[h])
    # From 11 agent 1 dies at 12, on the way to 13.
    assert_array_equal(imagine(at(11), step=leap, horizon=2).view.alive[:, 1], [True, False])


class Doubtful(Clockwork):
    """A world model that believes in every action with probability 0.6."""

    def predict(self, latent):
        return super().predict(latent)._replace(available=jnp.full((2, 3), jnp.log(1.5)))


@pytest.mark.parametrize(("sample", "share"), [(True, 0.6), (False, 1.0)])
def test_imagined_availability_is_a_sample_or_the_mode(sample, share):
    trajectory = imagine(at(0), Doubtful(), seed=0, horizon=200, sample_availability=sample)
    assert_allclose(trajectory.view.available[1:].mean(), share, atol=0.05)
