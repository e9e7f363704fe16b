import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mabl.nets.categorical import flatten, sample_index, sample_straight_through, unflatten

LARGEST_UNIFORM = 1 - 2**-23
"""jax.random.uniform in float32 yields multiples of 2^-23 below 1."""


def test_samples_are_exactly_one_hot():
    logits = 3 * jax.random.normal(jax.random.key(0), (50, 4, 5))
    z = np.asarray(sample_straight_through(logits, jax.random.key(1)))
    assert set(np.unique(z)) == {0.0, 1.0}
    assert_array_equal(z.sum(-1), 1.0)


def test_gradient_is_that_of_the_probabilities():
    # p = [1/4, 3/4]; d p_0 / d logits = p_0 [1 - p_0, -p_1] = [3/16, -3/16], whatever was drawn
    logits = jnp.log(jnp.array([[1.0, 3.0]]))
    for seed in range(5):
        gradient = jax.grad(
            lambda x, seed=seed: sample_straight_through(x, jax.random.key(seed))[0, 0]
        )
        assert_allclose(gradient(logits), [[0.1875, -0.1875]], rtol=1e-5)


def test_classes_are_drawn_as_often_as_they_are_probable():
    probs = np.array([0.5, 0.3, 0.15, 0.05])
    n = 20_000
    logits = jnp.broadcast_to(jnp.log(probs), (n, 1, 4))
    counts = np.asarray(sample_straight_through(logits, jax.random.key(0))).sum((0, 1))
    chi_square = ((counts - n * probs) ** 2 / (n * probs)).sum()
    assert chi_square < 16.3  # 3 degrees of freedom: exceeded once in a thousand


def test_neighbouring_categoricals_are_drawn_independently():
    z = sample_straight_through(jnp.zeros((20_000, 2, 2)), jax.random.key(0))
    both = np.asarray(z[:, 0, 0] * z[:, 1, 0]).mean()
    assert abs(both - 0.25) < 0.015  # five standard errors


@pytest.mark.parametrize("uniform", [0.0, 2**-23, 0.5, LARGEST_UNIFORM])
@pytest.mark.parametrize(
    "probs",
    [
        [0.0, 0.0, 0.4, 0.6],
        [0.4, 0.6, 0.0, 0.0],
        [0.0, 0.5, 0.0, 0.5, 0.0],
        [0.1] * 10 + [0.0],  # sums to a little more or less than 1 in float32
        [1 / 3, 1 / 3, 1 / 3, 0.0],
        [0.0, 1e-6, 0.0],
    ],
)
def test_classes_of_probability_zero_are_never_drawn(monkeypatch, probs, uniform):
    monkeypatch.setattr(jax.random, "uniform", lambda key, shape: jnp.full(shape, uniform))
    index = int(sample_index(jnp.array(probs), jax.random.key(0)))
    assert probs[index] > 0


def test_classes_of_probability_zero_are_never_drawn_at_random():
    probs = jnp.broadcast_to(jnp.array([0.0, 0.3, 0.0, 0.7, 0.0]), (20_000, 5))
    assert set(np.unique(sample_index(probs, jax.random.key(0)))) == {1, 3}


def test_flatten_and_unflatten_keep_categoricals_in_rows():
    logits = jnp.arange(6.0)
    assert_array_equal(unflatten(logits, 3), [[0, 1, 2], [3, 4, 5]])
    assert_array_equal(flatten(unflatten(logits, 3)), logits)
