"""Continuous policies: normal within the bounds, and on them what lies beyond."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mabl.behaviour.actor import (
    Actor,
    CensoredNormal,
    ContinuousActor,
    MaskedCategorical,
    actor_for,
)
from mabl.behaviour.ppo import PPORows, policy_loss
from mabl.envs.base import Continuous, Discrete
from mabl.types import TeamView


def one(mean, std) -> CensoredNormal:
    """A policy of one dimension."""
    return CensoredNormal(jnp.array([mean]), jnp.array([std]), jnp.ones(1, bool))


def test_log_probabilities_by_hand():
    policy = one(0.0, 1.0)
    # -ln sqrt(2 pi) = -0.918939; less 0.5^2 / 2
    assert_allclose(policy.log_prob(jnp.array([0.5])), -0.918939 - 0.125, rtol=1e-5)
    # Phi(-1) = 0.158655 lies beyond either bound
    assert_allclose(policy.log_prob(jnp.array([1.0])), np.log(0.158655), rtol=1e-5)
    assert_allclose(policy.log_prob(jnp.array([-1.0])), np.log(0.158655), rtol=1e-5)
    # the mean at the upper bound: half of it; two standard deviations from the lower one
    assert_allclose(one(1.0, 1.0).log_prob(jnp.array([1.0])), np.log(0.5), rtol=1e-5)
    assert_allclose(one(1.0, 1.0).log_prob(jnp.array([-1.0])), np.log(0.0227501), rtol=1e-4)


@pytest.mark.parametrize(("mean", "std"), [(0.0, 0.5), (0.9, 0.3), (-2.0, 1.0)])
def test_probabilities_sum_to_one(mean, std):
    policy = one(mean, std)
    inside = np.linspace(-1, 1, 20_001)[1:-1]
    density = jnp.exp(jax.vmap(policy.log_prob)(jnp.asarray(inside)[:, None]))
    bounds = sum(float(jnp.exp(policy.log_prob(jnp.array([b])))) for b in (-1.0, 1.0))
    assert float(density.sum()) * (inside[1] - inside[0]) + bounds == pytest.approx(1, abs=2e-3)


def test_samples_are_as_likely_as_said_and_stay_within_bounds():
    policy = one(0.5, 0.5)
    keys = jax.random.split(jax.random.key(0), 20_000)
    actions = np.asarray(jax.vmap(policy.sample)(keys))
    assert actions.min() >= -1 and actions.max() == 1
    above = float(jnp.exp(policy.log_prob(jnp.array([1.0]))))  # Phi(-1)
    assert np.mean(actions == 1) == pytest.approx(above, abs=0.01)
    assert np.mean(actions < 0.5) == pytest.approx(0.5, abs=0.015)


def test_the_mode_is_the_mean_within_bounds():
    assert_allclose(one(0.3, 1.0).mode(), [0.3])
    assert_array_equal(one(-7.0, 1.0).mode(), [-1.0])


def test_entropy_is_the_normal_distributions():
    # ln(0.5) + 0.5 ln(2 pi e) = -0.693147 + 1.418939
    assert_allclose(one(3.0, 0.5).entropy(), 0.725792, rtol=1e-5)


def test_dimensions_that_an_agent_lacks_are_zero_and_do_not_count():
    exists = jnp.array([True, False])
    both = CensoredNormal(jnp.array([0.2, 0.9]), jnp.array([1.0, 2.0]), exists)
    action = both.sample(jax.random.key(0))
    assert action[1] == 0 and action[0] != 0 and both.mode()[1] == 0
    alone = one(0.2, 1.0)
    assert_allclose(both.log_prob(action), alone.log_prob(action[:1]), rtol=1e-6)
    assert_allclose(both.entropy(), alone.entropy(), rtol=1e-6)


@pytest.mark.parametrize("mean", [-30.0, 0.0, 30.0])
@pytest.mark.parametrize("action", [-1.0, 0.0, 1.0])
def test_gradients_stay_finite_and_point_to_the_action(mean, action):
    def log_prob(mean, std):
        return one(mean, std).log_prob(jnp.array([action]))

    by_mean, by_std = jax.grad(log_prob, argnums=(0, 1))(mean, 0.5)
    assert np.isfinite([by_mean, by_std]).all()
    if mean != action and abs(mean) > 1 and np.sign(mean) != np.sign(action):
        assert np.sign(by_mean) == -np.sign(mean)
    if mean == 0:
        assert np.sign(by_mean) == np.sign(action)


def test_an_actor_is_made_for_its_space():
    make = lambda space: actor_for(space, 5, 16, 1, 0.01, 0.3, jax.random.key(0))  # noqa: E731
    discrete, continuous = make(Discrete(3)), make(Continuous(3))
    assert isinstance(discrete, Actor) and isinstance(continuous, ContinuousActor)
    features, available = jnp.ones(5), jnp.ones(3, bool)
    assert isinstance(discrete(features, available), MaskedCategorical)
    policy = continuous(features, available)
    assert_allclose(policy.std, [0.3] * 3, rtol=1e-6)
    assert_allclose(policy.mean, np.zeros(3), atol=0.05)


def test_one_dimension_is_a_choice_where_one_action_is_none():
    available = jnp.array([[True, False], [True, True], [False, False]])
    assert_array_equal(CensoredNormal.free(available), [True, True, False])
    assert_array_equal(MaskedCategorical.free(available), [False, True, True])


def test_ppo_moves_the_mean_towards_what_paid():
    def loss(mean):
        policy = CensoredNormal(mean, jnp.full((4, 1, 1), 0.5), jnp.ones((4, 1, 1), bool))
        action = jnp.array([-1.0, -0.2, 0.3, 1.0])[:, None, None]
        view = TeamView(
            jnp.zeros((4, 1, 1)), jnp.zeros((4, 1, 1)), policy.exists, jnp.ones((4, 1), bool)
        )
        old = jax.lax.stop_gradient(policy.log_prob(action))
        advantage = jnp.array([-1.0, -1.0, 1.0, 1.0])[:, None]
        ones = jnp.ones((4, 1))
        rows = PPORows(view, action, old, advantage, jnp.zeros((4, 1)), ones, ones)
        return policy_loss(policy, rows, jnp.float32(0), 0.2)[0]

    gradient = jax.grad(loss)(jnp.zeros((4, 1, 1)))
    assert (gradient < 0).all()  # every row asks for a larger mean
