from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from numpy.testing import assert_allclose, assert_array_equal

from mabl.algorithms.base import Experience
from mabl.algorithms.model_based import Learner, ModelBased, starts
from mabl.algorithms.presets import preset
from mabl.behaviour import mappo
from mabl.behaviour.actor import MaskedCategorical
from mabl.behaviour.mappo import MAPPO, ActorCritic, MAPPOConfig
from mabl.envs.base import Discrete
from mabl.envs.coordination import CoordinationEnv
from mabl.imagination import imagine_trajectory
from mabl.replay import sample_sequences
from mabl.training.loop import Training
from mabl.types import Replayed, TeamView, Trajectory
from mabl.world_models.mabl import MABL
from mabl.world_models.sequences import observe_sequence

TINY = MAPPOConfig(hidden=16, n_hidden=1, n_heads=2)


def leaves(tree) -> list[np.ndarray]:
    return [np.asarray(x) for x in jax.tree.leaves(tree)]


def same(a, b) -> bool:
    """Bitwise equality of all leaves."""
    return all(np.array_equal(x, y) for x, y in zip(leaves(a), leaves(b), strict=True))


@pytest.fixture(scope="module")
def fresh() -> ActorCritic:
    return MAPPO(TINY).init(some_view(2), Discrete(4), key=jax.random.key(1))


def some_view(*shape: int) -> TeamView:
    """Random features of 5 and 7 for teams `shape` `[..., N]`; four actions, all alive."""
    keys = jax.random.split(jax.random.key(5))
    return TeamView(
        actor_features=jax.random.normal(keys[0], (*shape, 5)),
        critic_features=jax.random.normal(keys[1], (*shape, 7)),
        available=jnp.ones((*shape, 4), bool),
        alive=jnp.ones(shape, bool),
    )


# --- the policy -------------------------------------------------------------------------------


def test_masked_actions_have_probability_zero_and_the_rest_are_renormalised():
    logits = jnp.log(jnp.array([1.0, 2.0, 3.0, 4.0]))
    policy = MaskedCategorical.of(logits, jnp.array([True, False, True, False]))
    assert_allclose(jnp.exp(policy.log_probs), [0.25, 0, 0.75, 0], rtol=1e-6)
    assert float(jnp.exp(policy.log_probs[1])) == 0.0
    assert policy.mode() == 2
    assert_allclose(policy.log_prob(jnp.array(0)), np.log(0.25), rtol=1e-6)
    # 1/4 ln 4 + 3/4 ln 4/3 = 0.562335; 0 log 0 counts as 0
    assert_allclose(policy.entropy(), 0.562335, rtol=1e-5)


def test_without_any_available_action_none_is_masked():
    logits = jnp.log(jnp.array([[1.0, 3.0], [1.0, 3.0]]))
    policy = MaskedCategorical.of(logits, jnp.array([[False, False], [True, False]]))
    assert_allclose(jnp.exp(policy.log_probs), [[0.25, 0.75], [1, 0]], rtol=1e-6)


def test_masking_keeps_gradients_finite():
    def loss(logits):
        policy = MaskedCategorical.of(logits, jnp.array([True, False, True]))
        return policy.entropy() + policy.log_prob(jnp.array(0))

    gradient = jax.grad(loss)(jnp.array([1.0, 2.0, 0.5]))
    assert np.isfinite(gradient).all()
    assert gradient[1] == 0


def test_sampling_follows_the_probabilities():
    policy = MaskedCategorical.of(
        jnp.broadcast_to(jnp.log(jnp.array([1.0, 5.0, 3.0])), (8000, 3)),
        jnp.broadcast_to(jnp.array([True, False, True]), (8000, 3)),
    )
    counts = np.bincount(policy.sample(jax.random.key(0)), minlength=3)
    assert_allclose(counts / 8000, [0.25, 0, 0.75], atol=0.025)  # five standard errors


# --- experience -------------------------------------------------------------------------------


def reset_row():
    """A row of a team of two, for its shapes."""
    return CoordinationEnv().reset(jax.random.key(0))[1]


class ConstantCritic(NamedTuple):
    value: float

    def __call__(self, features: Array) -> Array:
        return jnp.full(features.shape[0], self.value)


def two_steps() -> Trajectory:
    """Three rows, two transitions, one start, two agents; features show row and agent."""
    rows = jnp.arange(3.0)[:, None, None, None]
    return Trajectory(
        view=TeamView(
            actor_features=jnp.broadcast_to(rows, (3, 1, 2, 5)),
            critic_features=jnp.broadcast_to(10 * rows, (3, 1, 2, 7)),
            available=jnp.ones((3, 1, 2, 4), bool).at[1, 0, 0, 3].set(False),
            alive=jnp.array([[[True, True]], [[True, False]], [[False, False]]]),
        ),
        action=jnp.array([[[0, 1]], [[2, 3]]]),
        log_prob=jnp.log(jnp.array([[[0.1, 0.2]], [[0.3, 0.4]]])),
        reward=jnp.array([[[1.0, 3.0]], [[2.0, 2.0]]]),
        continues=jnp.array([[[0.5, 0.5]], [[0.25, 0.25]]]),
        weight=jnp.array([[[1.0, 1.0]], [[0.5, 0.5]]]),
    )


BY_HAND = replace(TINY, gamma=0.5, gae_lambda=0.5, normalise_advantage=False)


def experience(config: MAPPOConfig, trajectory: Trajectory):
    critic = ConstantCritic(2.0)
    return mappo.experience(critic, trajectory, config)


def test_experience_by_hand():
    rows, metrics = experience(BY_HAND, two_steps())
    # Team rewards 2 and 2; discounts 0.5 * 0.5 and 0.5 * 0.25; values 2.
    # G_1 = 2 + 0.125 * 2 = 2.25, G_0 = 2 + 0.25 (0.5 * 2 + 0.5 * 2.25) = 2.53125
    assert_allclose(rows.target, [[2.53125] * 2, [2.25] * 2])
    assert_allclose(rows.advantage, [[0.53125] * 2, [0.25] * 2])
    assert_allclose(rows.weight, [[1, 1], [0.5, 0.5]])
    assert_array_equal(rows.action, [[0, 1], [2, 3]])
    assert_allclose(jnp.exp(rows.log_prob), [[0.1, 0.2], [0.3, 0.4]], rtol=1e-6)
    assert_array_equal(rows.view.actor_features[:, 0, 0], [0, 1])
    assert_array_equal(rows.view.critic_features[:, 0, 0], [0, 10])
    assert_array_equal(rows.view.available[:, :, 3], [[True, True], [False, True]])
    assert_array_equal(rows.view.alive, [[True, True], [True, False]])
    assert_allclose(metrics["behaviour/imagined_reward"], 2.0)
    assert_allclose(metrics["behaviour/value"], 2.0)
    assert_allclose(metrics["behaviour/imagined_return"], 2.53125)


def test_without_team_reward_every_agent_keeps_its_own():
    rows, _ = experience(replace(BY_HAND, team_reward=False), two_steps())
    # G_1 = 2.25 for both; G_0 = 1 or 3 + 0.25 * 2.125 = 0.53125
    assert_allclose(rows.target, [[1.53125, 3.53125], [2.25, 2.25]])


class RowCritic:
    """Values that tell which row they are of: 1, 2, 4, 8."""

    def __call__(self, features: Array) -> Array:
        return 2.0 ** features[:, 0]


@pytest.mark.parametrize(
    ("end", "targets"),
    # Team rewards on arriving at rows 1 to 3: 2, 6 and 9. G_2 is cut or bootstraps from value 8.
    # None: G_2 = 9 + 0.5 * 8 = 13, G_1 = 6 + 0.5 (0.5 * 4 + 0.5 * 13) = 10.25,
    #       G_0 = 2 + 0.5 (0.5 * 2 + 0.5 * 10.25) = 5.0625
    # Row 3 is a reset: its step hands back the value of row 2, 4, which ended the episode.
    # Terminated: G_1 = 6, G_0 = 2 + 0.5 (0.5 * 2 + 0.5 * 6) = 4
    # Truncated: G_1 = 6 + 0.5 (0.5 * 4 + 0.5 * 4) = 8, G_0 = 2 + 0.5 (0.5 * 2 + 0.5 * 8) = 4.5
    [
        (None, [5.0625, 10.25, 13]),
        ("terminated", [4, 6, 4]),
        ("truncated", [4.5, 8, 4]),
    ],
)
def test_replayed_values_by_hand(end, targets):
    blank = jax.tree.map(lambda x: jnp.zeros((4, *x.shape), x.dtype), reset_row())
    rows = blank._replace(
        is_first=jnp.array([True, False, False, end is not None]),
        reward=jnp.array([[0.0, 0.0], [1.0, 3.0], [6.0, 6.0], [9.0, 9.0]]),
        terminated=jnp.zeros((4, 2), bool).at[2].set(end == "terminated"),
        truncated=jnp.zeros(4, bool).at[2].set(end == "truncated"),
    )
    features = jnp.broadcast_to(jnp.arange(4.0)[:, None, None], (4, 2, 7))
    alive = jnp.arange(4)[:, None] + jnp.arange(2)[None] < 3
    replayed = Replayed(some_view(4, 2)._replace(critic_features=features, alive=alive), rows)
    real = mappo.replayed_values(RowCritic(), replayed, BY_HAND)
    assert_allclose(real.target, [[target] * 2 for target in targets])
    assert_array_equal(real.value_weight, [[1, 1], [1, 1], [end is None] * 2])
    assert_array_equal(real.view.critic_features[:, 0, 0], [0, 1, 2])
    assert_array_equal(real.view.alive, [[True, True], [True, True], [True, False]])
    alone = mappo.replayed_values(RowCritic(), replayed, replace(BY_HAND, team_reward=False))
    assert_allclose(alone.target[0], [targets[0] - 1, targets[0] + 1])


def test_normalised_advantages_by_hand():
    rows, _ = experience(replace(BY_HAND, normalise_advantage=True), two_steps())
    # Of the living: mean (2 * 0.53125 + 0.5 * 0.25) / 2.5 = 0.475, deviations 0.05625 and -0.225,
    # variance (2 * 0.05625^2 + 0.5 * 0.225^2) / 2.5 = 0.0126563, root 0.1125
    assert_allclose(rows.advantage, [[0.5] * 2, [-2.0] * 2], rtol=2e-4)


def random_trajectory(h: int, b: int, reward: Array | None = None) -> Trajectory:
    keys = jax.random.split(jax.random.key(0), 6)
    shape = (h - 1, b, 2)
    return Trajectory(
        view=TeamView(
            actor_features=jax.random.normal(keys[0], (h, b, 2, 5)),
            critic_features=jax.random.normal(keys[1], (h, b, 2, 7)),
            available=jnp.ones((h, b, 2, 4), bool),
            alive=jnp.ones((h, b, 2), bool),
        ),
        action=jax.random.randint(keys[2], shape, 0, 4),
        log_prob=jnp.full(shape, jnp.log(0.25)),
        reward=jax.random.normal(keys[3], shape) if reward is None else reward,
        continues=jax.random.uniform(keys[4], shape),
        weight=jax.random.uniform(keys[5], shape),
    )


def test_normalised_advantages_have_mean_zero_and_variance_one_under_the_weights():
    config = replace(TINY, normalise_advantage=True, team_reward=False)
    rows, _ = experience(config, random_trajectory(5, 8))
    weight = rows.weight / rows.weight.sum()
    assert_allclose((weight * rows.advantage).sum(), 0.0, atol=1e-5)
    assert_allclose((weight * rows.advantage**2).sum(), 1.0, rtol=1e-3)


def test_a_start_of_weight_zero_never_counts():
    def metrics(reward_of_start_1):
        trajectory = random_trajectory(5, 3)
        _, metrics = experience(
            BY_HAND,
            trajectory._replace(
                reward=trajectory.reward.at[:, 1].set(reward_of_start_1),
                weight=trajectory.weight.at[:, 1].set(0.0),
            ),
        )
        return {name: float(value) for name, value in metrics.items()}

    assert metrics(0.0) == metrics(1e3)


def test_losses_count_rows_by_their_weight(fresh):
    rows, _ = experience(BY_HAND, random_trajectory(3, 4))
    only = jnp.zeros_like(rows.weight).at[5, 1].set(0.3)
    rows = rows._replace(weight=only, value_weight=only)
    value = float(fresh.critic(rows.view.critic_features[5])[1])
    loss, _ = mappo.critic_loss(fresh.critic, rows, 0.5)
    assert_allclose(loss, 0.5 * (value - float(rows.target[5, 1])) ** 2, rtol=1e-5)
    policy = jax.vmap(fresh.actor)(rows.view.actor_features[5], rows.view.available[5])
    ratio = float(jnp.exp(policy.log_prob(rows.action[5]) - rows.log_prob[5])[1])
    loss, _ = mappo.actor_loss(fresh.actor, rows, jnp.float32(0.0), 9.0)  # nothing is clipped
    assert_allclose(loss, -ratio * float(rows.advantage[5, 1]), rtol=1e-5)


def test_the_dead_never_count_in_the_policy_loss(fresh):
    rows, _ = experience(BY_HAND, random_trajectory(3, 4))
    alive = jnp.ones_like(rows.view.alive).at[::2, 1].set(False)
    rows = rows._replace(view=rows.view._replace(alive=alive))

    def loss(reward_of_the_dead: float) -> float:
        advantage = jnp.where(alive, rows.advantage, reward_of_the_dead)
        return float(
            mappo.actor_loss(
                fresh.actor, rows._replace(advantage=advantage), jnp.float32(0.1), 0.2
            )[0]
        )

    assert loss(0.0) == loss(1e3)
    everyone = rows._replace(view=rows.view._replace(alive=jnp.ones_like(alive)))
    other, _ = mappo.actor_loss(fresh.actor, everyone, jnp.float32(0.1), 0.2)
    assert float(other) != loss(0.0)


# --- updates ----------------------------------------------------------------------------------


def test_zero_advantages_leave_the_actor_alone_while_the_critic_learns(fresh):
    # All rewards and all values equal, every transition ends the episode: advantages are equal,
    # and normalised to zero. The critic is off by 1 everywhere.
    trajectory = random_trajectory(3, 4, reward=jnp.ones((2, 4, 2)))
    trajectory = trajectory._replace(continues=jnp.zeros((2, 4, 2)), weight=jnp.ones((2, 4, 2)))
    critic = eqx.tree_at(lambda c: c.mlp.layers[-1].weight, fresh.critic, replace_fn=jnp.zeros_like)
    config = replace(TINY, ent_coef=0.0, actor_weight_decay=0.0, batch_size=8)
    before = fresh._replace(critic=critic, ent_coef=jnp.float32(0.0))
    after, _ = mappo.update(before, trajectory, jax.random.key(0), config)
    assert same(after.actor, before.actor)
    assert not same(after.critic, before.critic)
    value = jax.vmap(after.critic)(trajectory.view.critic_features[0])
    assert (value > 0).all()  # on its way from 0 to 1


def test_advantages_move_the_actor_towards_the_better_action(fresh):
    # Action 1 pays 1, all others 0; episodes end at once.
    trajectory = random_trajectory(2, 64)
    trajectory = trajectory._replace(
        reward=(trajectory.action == 1).astype(jnp.float32), continues=jnp.zeros((1, 64, 2))
    )
    config = replace(TINY, actor_learning_rate=1e-2, team_reward=False)

    def probability(actor):
        view = trajectory.view
        policy = jax.vmap(jax.vmap(actor))(view.actor_features[0], view.available[0])
        return float(jnp.exp(policy.log_probs[..., 1]).mean())

    after, _ = mappo.update(fresh, trajectory, jax.random.key(0), config)
    assert probability(after.actor) > probability(fresh.actor) + 0.02


def test_the_entropy_bonus_decays_with_every_minibatch(fresh):
    # 2 transitions x 4 starts = 8 rows: two minibatches of 3 in each of 3 epochs
    config = replace(TINY, batch_size=3, n_epochs=3)
    trajectory = random_trajectory(3, 4)
    after, metrics = mappo.update(fresh, trajectory, jax.random.key(0), config)
    assert_allclose(after.ent_coef, 0.001 * 0.99998**6, rtol=1e-6)
    assert metrics["behaviour/ent_coef"] == after.ent_coef


def test_the_entropy_bonus_alone_makes_the_policy_more_uniform(fresh):
    trajectory = random_trajectory(3, 16, reward=jnp.ones((2, 16, 2)))
    rows, _ = experience(TINY, trajectory)
    rows = rows._replace(advantage=jnp.zeros_like(rows.advantage))

    def entropy(actor):
        return float(mappo.actor_loss(actor, rows, jnp.float32(1.0), 0.2)[1]["behaviour/entropy"])

    gradient, _ = eqx.filter_grad(mappo.actor_loss, has_aux=True)(
        fresh.actor, rows, jnp.float32(1.0), 0.2
    )
    moved = eqx.apply_updates(fresh.actor, jax.tree.map(lambda g: -0.1 * g, gradient))
    assert entropy(moved) > entropy(fresh.actor)


def as_good_as_same(a, b):
    """But for rounding, which Adam makes larger where a gradient is zero but for rounding."""
    jax.tree.map(lambda x, y: assert_allclose(x, y, rtol=0, atol=2e-4), a, b)


def test_replayed_rows_teach_the_critic_by_their_weight_and_never_the_actor(fresh):
    trajectory = random_trajectory(3, 4)
    view = some_view(6, 2)._replace(critic_features=jnp.ones((6, 2, 7)))
    real = mappo.ValueRows(view, jnp.full((6, 2), 9.0), jnp.ones((6, 2)))

    def value(state):
        return state.critic(view.critic_features[0])

    def updated(coef, replayed):
        config = replace(TINY, replay_value_coef=coef)
        return mappo.update(fresh, trajectory, jax.random.key(0), config, replayed)

    (plain, _), (taught, metrics), (deaf, _) = (
        updated(0.0, None),
        updated(1.0, real),
        updated(0.0, real),
    )
    other, _ = updated(1.0, real._replace(target=-real.target))
    assert same(other.actor, taught.actor) and not same(other.critic, taught.critic)
    as_good_as_same(plain.actor, taught.actor)
    as_good_as_same(plain.critic, deaf.critic)
    assert (value(taught) > value(plain)).all()
    assert metrics["behaviour/replay_critic_loss"] > 10  # 0.5 (9 - about 0)^2, falling
    nothing = real._replace(value_weight=jnp.zeros((6, 2)))
    as_good_as_same(plain.critic, updated(1.0, nothing)[0].critic)


@pytest.mark.parametrize("critic_rows", ["all", "starts"])
def test_imagined_rows_past_the_start_teach_the_critic_only_if_they_are_to(fresh, critic_rows):
    """They teach the policy in both cases. Without discounting a target is its row's reward."""
    config = replace(TINY, critic_rows=critic_rows, gamma=0.0, n_epochs=40)
    pay = jnp.full((3, 6, 2), 5.0).at[0].set(1.0)

    def updated(pay):
        trajectory = random_trajectory(4, 6, reward=pay)
        trajectory = trajectory._replace(weight=jnp.ones_like(trajectory.weight))
        return mappo.update(fresh, trajectory, jax.random.key(0), config)[0]

    before, after = updated(pay), updated(pay.at[1:].add(jax.random.normal(jax.random.key(2))))
    assert same(before.critic, after.critic) == (critic_rows == "starts")
    other = updated(pay.at[1:, :3].add(1.0))
    assert not same(before.actor, other.actor)
    start = random_trajectory(4, 6).view.critic_features[0]
    value = jax.vmap(before.critic)(start).mean()
    assert (abs(value - 1.0) < 0.5) == (critic_rows == "starts")


@pytest.mark.parametrize(("value_decay", "learned"), [(0.9, True), (1.0, False)])
def test_normalised_returns_of_any_size_are_learned(fresh, value_decay, learned):
    config = replace(TINY, gamma=0.0, value_decay=value_decay)
    pay = jnp.full((2, 16, 2), 500.0).at[:, 0].set(700.0)
    trajectory = random_trajectory(3, 16, reward=pay)
    state = fresh
    for number in range(3):
        state, _ = mappo.update(state, trajectory, jax.random.key(number), config)
    value = jax.vmap(state.value)(trajectory.view.critic_features[0])
    assert (abs(value.mean() - 512.5) < 100) == learned
    mean, std = state.returns.moments()
    weight = trajectory.weight
    expected = (weight * pay).sum() / weight.sum()
    assert_allclose(
        [mean, std],
        [expected, jnp.sqrt((weight * (pay - expected) ** 2).sum() / weight.sum())]
        if learned
        else [0, 1],
        rtol=1e-3,
    )


def some_replayed(b: int, t: int) -> Replayed:
    """Sequences `[B, T]` of one episode each, in which every row pays 1."""
    blank = jax.tree.map(lambda x: jnp.zeros((b, t, *x.shape), x.dtype), reset_row())
    return Replayed(some_view(b, t, 2), blank._replace(reward=jnp.ones((b, t, 2))))


@pytest.mark.parametrize("coef", [0.0, 1.0])
def test_the_behaviour_updates_from_the_values_of_replayed_rows_if_they_count(fresh, coef):
    config = replace(TINY, replay_value_coef=coef)
    trajectory, replayed, key = random_trajectory(3, 4), some_replayed(3, 5), jax.random.key(0)
    after, metrics = MAPPO(config).update(fresh, trajectory, replayed, key)
    # 3 sequences of 5 rows: 4 joint rows of each, side by side
    sequences = [jax.tree.map(lambda x, b=b: x[b], replayed) for b in range(3)]
    values = [mappo.replayed_values(fresh.critic, sequence, config) for sequence in sequences]
    real = jax.tree.map(lambda *x: jnp.concatenate(x), *values)
    assert real.target.shape == real.view.alive.shape == (12, 2)
    expected, _ = mappo.update(fresh, trajectory, key, config, real if coef else None)

    def heard(state):
        """What the networks say; biases of keys, which say nothing, are moved by rounding alone."""
        view = jax.tree.map(lambda x: x[0], trajectory.view)
        policy = jax.vmap(jax.vmap(state.actor))(view.actor_features, view.available)
        return policy.log_probs, jax.vmap(state.critic)(view.critic_features)

    for x, y in zip(heard(after), heard(expected), strict=True):
        assert_allclose(x, y, rtol=1e-4, atol=1e-5)
    assert not np.allclose(heard(after)[1], heard(fresh)[1], atol=1e-3)
    assert ("behaviour/replay_critic_loss" in metrics) == (coef > 0)


def test_the_behaviour_offers_its_actor_its_value_and_all_that_a_model_has_for_critics(fresh):
    behaviour, view = MAPPO(TINY), some_view(2)
    assert behaviour.actor(fresh) is fresh.actor
    for alive in ([True, True], [True, False]):
        value = behaviour.value(fresh, view._replace(alive=jnp.array(alive)))
        assert_array_equal(value, fresh.critic(view.critic_features))

    class Doubling:
        def critic_features(self, latent):
            return 2 * latent

    features = behaviour.critic_features(Doubling(), view.critic_features)
    assert_array_equal(features, 2 * view.critic_features)


def test_the_critic_hears_everybody_or_those_that_it_is_to_hear(fresh):
    features = some_view(3).critic_features
    moved = features.at[1].add(9.0)
    heard, others = jnp.array([True, False, True]), np.array([0, 2])
    assert_array_equal(fresh.critic(features, heard)[others], fresh.critic(moved, heard)[others])
    assert fresh.critic(features, heard)[1] != fresh.critic(moved, heard)[1]
    assert (fresh.critic(features) != fresh.critic(moved)).all()


# --- with a real world model ------------------------------------------------------------------


class Setting(NamedTuple):
    algorithm: ModelBased
    learner: Learner
    experience: Experience


@pytest.fixture(scope="module")
def coordination() -> Setting:
    """A tiny MABL and a replay of random play."""
    config = preset("quick", "test/coordination", "mabl")
    config = replace(
        config,
        training=replace(config.training, num_envs=2, collect_steps=30, replay_capacity=60),
        world_model=replace(
            config.world_model,
            hidden=16,
            n_hidden=1,
            n_categoricals=2,
            n_classes=4,
            batch_size=4,
            batch_length=5,
        ),
        mappo=replace(config.mappo, hidden=16, n_hidden=1, n_heads=2),
        imagination=replace(config.imagination, n_starts=None),
    )
    env = CoordinationEnv()
    algorithm = ModelBased(MABL, MAPPO(config.mappo), env.spec, config)
    training = Training(env, algorithm)

    @eqx.filter_jit
    def begin(key):
        state = training.init(key)
        _, collected = training.collect(state.learner, state.collectors, key)
        replay = training.store(state.replay, collected)
        return state.learner, Experience(replay, state.collectors, collected)

    return Setting(algorithm, *begin(jax.random.key(0)))


@pytest.fixture(scope="module")
def imagined(coordination) -> Trajectory:
    """Imagined trajectories, made as `update_policy` makes them."""
    algorithm, learner, experience = coordination

    @eqx.filter_jit
    def imagine(learner, replay):
        rows = sample_sequences(replay, jax.random.key(1), 4, 5)
        latents, _ = jax.vmap(observe_sequence, in_axes=(None, 0, 0))(
            learner.model, rows, jax.random.split(jax.random.key(2), 4)
        )
        start, weight = starts(latents, rows, jax.random.key(3), None)
        dream = algorithm.dream(learner)
        return jax.vmap(lambda *start: imagine_trajectory(dream, *start), out_axes=1)(
            start, weight, jax.random.split(jax.random.key(4), 20)
        )

    return imagine(learner, experience.replay)


def test_the_first_ppo_ratio_is_one(coordination, imagined):
    algorithm, learner, _ = coordination
    horizon = algorithm.config.imagination.horizon
    assert imagined.action.shape == (horizon - 1, 20, 2)
    assert imagined.view.alive.shape == (horizon, 20, 2)
    config = algorithm.config.mappo
    rows, _ = mappo.experience(learner.behaviour.critic, imagined, config)
    view = rows.view
    policy = jax.vmap(jax.vmap(learner.behaviour.actor))(view.actor_features, view.available)
    assert_allclose(jnp.exp(policy.log_prob(rows.action) - rows.log_prob), 1.0, atol=1e-5)
    _, metrics = mappo.actor_loss(
        learner.behaviour.actor, rows, jnp.float32(0.0), algorithm.config.mappo.clip
    )
    assert metrics["behaviour/clip_fraction"] == 0
    assert_allclose(metrics["behaviour/approx_kl"], 0, atol=1e-6)


def test_imagined_actions_were_available(imagined):
    available, action = np.asarray(imagined.view.available), np.asarray(imagined.action)
    taken = np.take_along_axis(available[:-1], action[..., None], -1)[..., 0]
    none_available = ~available[:-1].any(-1)
    assert (taken | none_available).all()
    assert (available[0] == [True, True, True, False]).all()


def test_the_imagined_are_alive_at_the_start_and_nobody_comes_back(imagined):
    alive = np.asarray(imagined.view.alive)
    assert alive[0].all()  # as in the rows: nobody dies in this environment
    assert (alive[1:] <= alive[:-1]).all()


@pytest.mark.parametrize("replay_value_coef", [0.0, 1.0])
def test_updating_the_policy_leaves_the_world_model_alone(coordination, replay_value_coef):
    algorithm, learner, experience = coordination
    config = replace(algorithm.config.mappo, replay_value_coef=replay_value_coef)
    algorithm = algorithm._replace(behaviour=MAPPO(config))
    update = eqx.filter_jit(algorithm.update_policy)
    after, metrics = update(learner, experience, jax.random.key(0))
    assert same((learner.model, learner.model_opt), (after.model, after.model_opt))
    assert not same(learner.behaviour.actor, after.behaviour.actor)
    assert not same(learner.behaviour.critic, after.behaviour.critic)
    assert all(np.isfinite(v) for v in metrics.values())
    assert ("behaviour/replay_critic_loss" in metrics) == (replay_value_coef > 0)


def test_updating_the_model_leaves_actor_and_critic_alone(coordination):
    algorithm, learner, experience = coordination
    after, metrics = eqx.filter_jit(algorithm.update_model)(learner, experience, jax.random.key(0))
    assert same(learner.behaviour, after.behaviour)
    pairs = zip(leaves(learner.model), leaves(after.model), strict=True)
    changed = [not np.array_equal(before, now) for before, now in pairs]
    assert all(changed)  # every parameter of the model is trained
    assert all(np.isfinite(v) for v in metrics.values())
