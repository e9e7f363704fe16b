"""Schedules by the share of the run, minibatches, and what is told of a policy update."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mabl.behaviour.actor import MaskedCategorical, has_choice
from mabl.behaviour.base import annealed, divided, minibatch_steps, minibatches
from mabl.behaviour.mappo import MAPPO, MAPPOConfig, experience
from mabl.behaviour.ppo import PPORows, kl_of_choices, policy_loss
from mabl.envs.base import Discrete
from mabl.rows import TimeStep
from mabl.types import Replayed, TeamView, Trajectory


def test_a_coefficient_falls_geometrically_with_the_share_of_the_run():
    falls = [annealed(0.1, 0.001, share) for share in (0.0, 0.5, 1.0, 2.0)]
    assert_allclose(falls, [0.1, 0.01, 0.001, 0.001], rtol=1e-5)
    # To or from nothing it falls in a line.
    assert_allclose([annealed(0.1, 0.0, share) for share in (0.25, 1.0)], [0.075, 0.0], atol=1e-8)


@pytest.mark.parametrize(
    ("n_rows", "size", "epochs"), [(1600, 2000, 5), (1600, 400, 5), (10, 3, 2)]
)
def test_gradient_steps_are_the_minibatches_that_there_are(n_rows, size, epochs):
    made = minibatches(jax.random.key(0), n_rows, size, epochs)
    assert made.shape == (minibatch_steps(n_rows, size, epochs), min(size, n_rows))


@pytest.mark.parametrize(("n_rows", "n_parts"), [(320, 4), (10, 3), (2, 5)])
def test_an_epoch_divides_rows_among_parts_of_one_size(n_rows, n_parts):
    made = np.asarray(divided(jax.random.key(0), n_rows, n_parts, 2))
    size = max(n_rows // n_parts, 1)
    assert made.shape == (2 * n_parts, size)
    for epoch in np.split(made, 2):
        seen = np.unique(epoch)
        assert len(seen) == min(n_parts * size, n_rows)  # none twice while there are others
    if n_rows > 2:
        assert not np.array_equal(*np.split(made, 2))  # another shuffle in each epoch


def rows_of(available, alive, log_prob, action):
    """One joint row of two agents with three actions."""
    view = TeamView(jnp.zeros((1, 2, 1)), jnp.zeros((1, 2, 1)), available[None], alive[None])
    ones = jnp.ones((1, 2))
    return PPORows(view, action[None], log_prob[None], ones, ones, ones, ones)


AVAILABLE = jnp.array([[True, True, False], [True, True, True]])
PROBS = jnp.array([[0.8, 0.2, 0.0], [0.5, 0.25, 0.25]])
POLICY = MaskedCategorical.of(jnp.log(jnp.maximum(PROBS, 1e-20)), AVAILABLE)


def team(policy):
    return MaskedCategorical(policy.log_probs[None])


def test_the_share_of_entropy_is_of_the_uniform_policy_over_what_is_available():
    rows = rows_of(AVAILABLE, jnp.ones(2, bool), jnp.zeros(2), jnp.zeros(2, int))
    metrics = policy_loss(team(POLICY), rows, jnp.float32(0), 0.2)[1]
    # -(.8 ln .8 + .2 ln .2) = .500402 of ln 2 = .693147; 1.5 ln 2 = 1.039721 of ln 3 = 1.098612
    assert_allclose(metrics["behaviour/entropy"], (0.500402 + 1.039721) / 2, rtol=1e-5)
    expected = (0.500402 / 0.693147 + 1.039721 / 1.098612) / 2
    assert_allclose(metrics["behaviour/entropy_share"], expected, rtol=1e-5)


def test_the_kl_of_an_update_by_hand_and_of_none():
    action = jnp.array([0, 2])
    now = POLICY.log_prob(action)
    assert kl_of_choices(team(POLICY), rows_of(AVAILABLE, jnp.ones(2, bool), now, action)) == 0
    # Ratios .8 / .4 = 2 and .25 / .5 = .5: 2 - 1 - ln 2 = .306853, .5 - 1 + ln 2 = .193147
    old = jnp.log(jnp.array([0.4, 0.5]))
    both = kl_of_choices(team(POLICY), rows_of(AVAILABLE, jnp.ones(2, bool), old, action))
    assert_allclose(both, (0.306853 + 0.193147) / 2, rtol=1e-4)
    # The dead do not count, nor does who has no choice.
    one = kl_of_choices(team(POLICY), rows_of(AVAILABLE, jnp.array([True, False]), old, action))
    assert_allclose(one, 0.306853, rtol=1e-4)
    bound = AVAILABLE.at[0].set([True, False, False])
    other = kl_of_choices(team(POLICY), rows_of(bound, jnp.ones(2, bool), old, action))
    assert_allclose(other, 0.193147, rtol=1e-4)


def test_a_choice_is_more_than_one_action_or_a_dimension():
    available = jnp.array([[True, False, False], [True, True, False], [False, False, False]])
    assert_array_equal(has_choice(jnp.zeros(3, int), available), [False, True, True])
    assert_array_equal(has_choice(jnp.zeros((3, 3)), available), [True, True, False])


ONES = jnp.ones((4, 8, 2), bool)
TINY = MAPPOConfig(hidden=8, n_hidden=1, n_heads=2, n_epochs=2, batch_size=4, ent_coef=0.1)


def update(progress, **options):
    """State and metrics after an update from two steps of four random trajectories."""
    behaviour = MAPPO(replace(TINY, **options))
    keys = jax.random.split(jax.random.key(0), 6)
    shape = 3, 4, 2
    view = TeamView(
        jax.random.normal(keys[0], (*shape, 3)),
        jax.random.normal(keys[1], (*shape, 3)),
        jnp.ones((*shape, 3), bool),
        jnp.ones(shape, bool),
    )
    state = behaviour.init(jax.tree.map(lambda x: x[0, 0], view), Discrete(3), keys[2])
    here = jax.tree.map(lambda x: x[:-1], view)
    policy = jax.vmap(jax.vmap(jax.vmap(state.actor)))(here.actor_features, here.available)
    action = policy.sample(keys[3])
    ones = jnp.ones(action.shape)
    trajectory = Trajectory(
        view,
        action,
        policy.log_prob(action),
        jax.random.normal(keys[4], action.shape),
        ones,
        ones,
    )
    nothing = Replayed(view, TimeStep(*[jnp.zeros(())] * 10))
    return jax.jit(lambda state: behaviour.update(state, trajectory, nothing, keys[5], progress))(
        state
    )


def test_the_entropy_bonus_is_that_of_the_share_of_the_run_whatever_was_learned_before():
    for progress, expected in ((0.0, 0.1), (0.5, 0.01), (1.0, 0.001)):
        state, metrics = update(progress, ent_final=0.001)
        assert_allclose(state.ent_coef, expected, rtol=1e-5)
        assert metrics["behaviour/ent_coef"] == state.ent_coef
    # Without an end it falls by minibatch, as in the paper: two epochs of two.
    assert_allclose(update(0.5)[0].ent_coef, 0.1 * 0.99998**4, rtol=1e-6)


def test_advantages_are_not_divided_by_less_than_the_floor():
    shape = 4, 8, 2
    nothing = jnp.zeros((*shape, 1))
    view = TeamView(nothing, nothing, jnp.ones((*shape, 3), bool), ONES)
    reward = 0.1 * jnp.where(jax.random.bernoulli(jax.random.key(0), 0.5, (3, 8, 2)), 1.0, -1.0)
    ones = jnp.ones_like(reward)
    trajectory = Trajectory(view, jnp.zeros((3, 8, 2), int), 0 * ones, reward, ones, ones)

    def spread(floor):
        config = replace(TINY, gamma=0.0, team_reward=False, advantage_floor=floor)
        rows, _ = experience(lambda features: jnp.zeros(2), trajectory, config)
        return float(rows.advantage.std())

    # Rewards of .1 and -.1, nearly as many of each: their deviation is near .1.
    deviation = float(reward.std())
    assert_allclose(spread(0.0), 1.0, rtol=1e-3)
    assert_allclose(spread(deviation / 2), 1.0, rtol=1e-3)
    assert_allclose(spread(1.0), deviation, rtol=1e-3)
