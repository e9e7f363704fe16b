import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose

from mabl.losses.returns import lambda_returns, returns_across_resets

REWARD = jnp.array([1.0, 2.0, 3.0])
NEXT_VALUE = jnp.array([10.0, 20.0, 30.0])
# Discount 0.9, and the second of three transitions terminates.
DISCOUNT = jnp.array([0.9, 0.0, 0.9])


def test_returns_stop_at_a_termination_in_the_middle():
    returns = lambda_returns(REWARD, DISCOUNT, NEXT_VALUE, 0.5)
    # G_2 = 3 + 0.9 * 30 = 30
    # G_1 = 2: the values 20 and 30 lie beyond the end
    # G_0 = 1 + 0.9 (0.5 * 10 + 0.5 * 2) = 6.4
    assert_allclose(returns, [6.4, 2.0, 30.0], rtol=1e-6)


def test_lambda_zero_is_one_step_td():
    # 1 + 0.9 * 10, 2, 3 + 0.9 * 30
    assert_allclose(lambda_returns(REWARD, DISCOUNT, NEXT_VALUE, 0.0), [10, 2, 30], rtol=1e-6)


def test_lambda_one_is_monte_carlo_with_the_last_value_as_bootstrap():
    discount = jnp.full(3, 0.5)
    value = jnp.array([100.0, 100.0, 8.0])
    # G_2 = 3 + 0.5 * 8 = 7, G_1 = 2 + 0.5 * 7 = 5.5, G_0 = 1 + 0.5 * 5.5 = 3.75
    assert_allclose(lambda_returns(REWARD, discount, value, 1.0), [3.75, 5.5, 7.0], rtol=1e-6)


def test_trailing_axes_are_independent():
    def double(x):
        return jnp.stack([x, jnp.zeros(3)], axis=-1)[:, None]

    returns = lambda_returns(double(REWARD), double(DISCOUNT), double(NEXT_VALUE), 0.5)
    assert returns.shape == (3, 1, 2)
    assert_allclose(returns[:, 0, 0], [6.4, 2.0, 30.0], rtol=1e-6)
    assert_allclose(returns[:, 0, 1], 0.0)


@pytest.mark.parametrize(
    ("terminated", "returns"),
    # Row 2 is a reset, discount 0.5. G_2 = 3 + 0.5 * 40 = 23; G_1 hands back V_1 = 8.
    # Truncated at row 1: G_0 = 1 + 0.5 (0.5 * 8 + 0.5 * 8) = 5; terminated there: 1
    [(False, [5, 8, 23]), (True, [1, 8, 23])],
)
def test_returns_do_not_pass_a_reset(terminated, returns):
    value = jnp.array([100.0, 8.0, 200.0, 40.0])
    rewards = jnp.array([1.0, 7.0, 3.0])
    terminal = jnp.array([terminated, False, False])
    reset = jnp.array([False, True, False])
    assert_allclose(returns_across_resets(value, rewards, terminal, reset, 0.5, 0.5), returns)
