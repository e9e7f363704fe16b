import jax
import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose

from mabl.losses.ppo import clipped_surrogate

CLIP = 0.2

REGIMES = [
    # ratio, advantage, loss, gradient with respect to log pi_new (= -ratio A where not clipped)
    pytest.param(1.1, 2.0, -2.2, -2.2, id="good action, inside"),
    pytest.param(0.9, -2.0, 1.8, 1.8, id="bad action, inside"),
    pytest.param(1.5, 2.0, -2.4, 0.0, id="good action, already likelier: clipped at 1.2"),
    pytest.param(0.5, -2.0, 1.6, 0.0, id="bad action, already rarer: clipped at 0.8"),
    pytest.param(0.5, 2.0, -1.0, -1.0, id="good action that became rarer: not clipped"),
    pytest.param(1.5, -2.0, 3.0, 3.0, id="bad action that became likelier: not clipped"),
]


@pytest.mark.parametrize(("ratio", "advantage", "loss", "gradient"), REGIMES)
def test_clipped_surrogate_and_its_gradient(ratio, advantage, loss, gradient):
    old = jnp.float32(-1.3)
    new = old + jnp.log(ratio)
    value, slope = jax.value_and_grad(clipped_surrogate)(new, old, jnp.float32(advantage), CLIP)
    assert_allclose(value, loss, rtol=1e-5)
    assert_allclose(slope, gradient, rtol=1e-5)


def test_rows_are_independent():
    ratio = jnp.array([[1.1], [1.5]])
    loss = clipped_surrogate(jnp.log(ratio), jnp.zeros((2, 1)), jnp.full((2, 1), 2.0), CLIP)
    assert_allclose(loss, [[-2.2], [-2.4]], rtol=1e-5)
