import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mabl.losses.two_hot import MOST, N_BINS, beyond_bins, bins, two_hot_loss, two_hot_mean


def descended(loss):
    """Logits after gradient descent from equal ones."""

    def step(logits, _):
        return logits - jax.grad(loss)(logits), None

    return jax.lax.scan(step, jnp.zeros(N_BINS), length=20_000)[0]


def test_bins_are_symmetric_and_equally_spaced_in_symlog_units():
    values = np.asarray(bins(), np.float64)
    assert_allclose(values, -values[::-1], atol=1e-4)
    assert values[N_BINS // 2] == 0
    # The first beside 0 is at 0.2 symlog units, e^0.2 - 1 = 0.221403; the last at e^5 - 1.
    assert_allclose(values[N_BINS // 2 + 1], 0.221403, rtol=1e-4)
    assert_allclose(values[-1], 147.413159, rtol=1e-5)
    assert_allclose(np.diff(np.sign(values) * np.log1p(np.abs(values))), 0.2, rtol=1e-4)


def test_the_mean_is_over_bins_and_that_of_equal_logits_is_zero():
    assert_allclose(two_hot_mean(jnp.zeros((3, N_BINS))), np.zeros(3), atol=1e-5)
    # A fourth on 0, three fourths on the bin at 0.221403.
    half = N_BINS // 2
    logits = (
        jnp.full(N_BINS, -jnp.inf).at[jnp.array([half, half + 1])].set(jnp.log(jnp.array([1, 3])))
    )
    assert_allclose(two_hot_mean(logits), 0.75 * 0.221403, rtol=1e-4)


def test_the_loss_is_the_cross_entropy_against_the_two_bins_beside_the_target():
    half = N_BINS // 2
    logits = jnp.zeros(N_BINS).at[half].set(2.0).at[half + 1].set(1.0)
    total = np.log(N_BINS - 2 + np.exp(2) + np.exp(1))
    # 0.221403 / 4 lies a fourth of the way from bin 0 to the next.
    loss = two_hot_loss(logits, jnp.array(0.221403 / 4))
    assert_allclose(loss, total - (0.75 * 2 + 0.25 * 1), rtol=1e-4)
    assert_allclose(two_hot_loss(logits, jnp.array(0.0)), total - 2, rtol=1e-5)


@pytest.mark.parametrize("target", [0.0, 0.05, -0.3, 10.1, -77.0, MOST])
def test_gradient_descent_leads_to_the_target(target):
    logits = descended(lambda x: two_hot_loss(x, jnp.array(target)))
    assert_allclose(two_hot_mean(logits), target, atol=0.02 + 0.01 * abs(target))


def test_the_best_prediction_of_a_rare_reward_is_its_expected_value():
    """Nine rows of reward 0 and one of 10, which the same input cannot tell apart."""
    rewards = jnp.array([0.0] * 9 + [10.0])

    def loss(logits):
        return two_hot_loss(jnp.broadcast_to(logits, (10, N_BINS)), rewards).mean()

    logits = descended(loss)
    assert_allclose(two_hot_mean(logits), 1.0, rtol=0.02)


def test_targets_beyond_the_bins_count_as_the_outermost_and_are_reported():
    logits = jax.random.normal(jax.random.key(0), (N_BINS,))
    far, edge = (two_hot_loss(logits, jnp.array(x)) for x in (1e6, MOST))
    assert_allclose(far, edge, rtol=1e-4)
    assert beyond_bins(jnp.array([0.0, 1e6, -1e6, 3.0])) == 0.5
    assert beyond_bins(jnp.array([0.0, 100.0])) == 0
