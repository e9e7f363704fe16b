import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from mabl.nets.normaliser import Normaliser


def after(*batches: list[float], decay: float = 0.9) -> Normaliser:
    """A normaliser that has seen batches whose values all count alike."""
    normaliser = Normaliser.fresh()
    for batch in batches:
        normaliser = normaliser.update(jnp.array(batch), jnp.ones(len(batch)), decay)
    return normaliser


def test_a_fresh_one_changes_nothing():
    values = jnp.array([-1e6, 0.0, 0.25, 3.0])
    assert_array_equal(Normaliser.fresh().normalise(values), values)
    assert_array_equal(Normaliser.fresh().restore(values), values)


def test_after_one_batch_moments_are_the_batchs_however_slowly_it_forgets():
    # Mean of 1 and 3 is 2, their variance 1; the weight is what the batch replaced.
    for decay, share in ((0.9, 0.1), (0.99, 0.01), (0.0, 1.0)):
        normaliser = after([1.0, 3.0], decay=decay)
        assert_allclose(normaliser, [2, 1, share], rtol=1e-5)
        assert_allclose(normaliser.moments(), [2, 1], rtol=1e-4)
        assert_allclose(normaliser.normalise(jnp.array([1.0, 2.0, 5.0])), [-1, 0, 3], atol=1e-3)


def test_two_batches_by_hand():
    # The first batch has weight 0.9 * 0.1 = 0.09, the second 0.1. Mean (0.09 * 2 + 0.1 * 6) / 0.19
    # = 4.105263, mean square (0.09 * 5 + 0.1 * 36) / 0.19 = 21.315789; 21.315789 - 16.853186 =
    # 4.462604, whose root is 2.112488.
    normaliser = after([1.0, 3.0], [6.0])
    assert_allclose(normaliser, [4.105263, 4.462604, 0.19], rtol=1e-5)
    assert_allclose(normaliser.moments(), [4.105263, 2.112488], rtol=1e-5)
    # (10 - 4.105263) / 2.112488 = 2.790424
    assert_allclose(normaliser.normalise(jnp.array(10.0)), 2.790424, rtol=1e-5)


def test_what_was_seen_long_ago_is_forgotten():
    normaliser = after([1000.0, -1000.0], *[[1.0, 3.0]] * 200, decay=0.9)
    assert_allclose(normaliser.weight, 1.0, rtol=1e-5)
    assert_allclose(normaliser.moments(), [2, 1], rtol=1e-3)


def test_restoring_inverts_normalising():
    values = jax.random.normal(jax.random.key(0), (3, 4)) * 50.0
    for normaliser in (Normaliser.fresh(), after([1.0, 3.0], [6.0, -40.0])):
        assert_allclose(normaliser.restore(normaliser.normalise(values)), values, rtol=1e-5)
        assert_allclose(
            normaliser.normalise(normaliser.restore(values)), values, rtol=1e-5, atol=1e-5
        )


def test_values_of_weight_zero_do_not_count_and_others_count_by_theirs():
    def seen(values: list[float], weights: list[float]) -> np.ndarray:
        normaliser = Normaliser.fresh().update(jnp.array(values), jnp.array(weights), 0.9)
        return np.array(normaliser)

    assert_array_equal(
        seen([1.0, 3.0, 99.0], [1.0, 1.0, 0.0]), seen([1.0, 3.0, -7.0], [1.0, 1.0, 0.0])
    )
    assert_allclose(
        seen([1.0, 3.0, 99.0], [1.0, 1.0, 0.0]), seen([1.0, 3.0], [1.0, 1.0]), rtol=1e-6
    )
    # Mean (3 * 1 + 1 * 5) / 4 = 2, variance (3 * 1 + 1 * 9) / 4 = 3
    assert_allclose(seen([1.0, 5.0], [3.0, 1.0]), [2, 3, 0.1], rtol=1e-5)


def test_the_deviation_never_falls_below_a_tenth():
    normaliser = after([5.0, 5.0])
    assert_allclose(normaliser.moments(), [5, 0.1], rtol=1e-5)
    assert_allclose(normaliser.normalise(jnp.array(6.0)), 10.0, rtol=1e-4)


def test_a_small_deviation_beside_a_large_mean_is_kept():
    # In float32 the squares of 10,000 and 10,002 differ by less than their rounding shows of 1.
    normaliser = after(*[[10_000.0, 10_002.0]] * 300, decay=0.99)
    assert_allclose(normaliser.moments(), [10_001, 1], rtol=1e-3)


def test_it_passes_through_jit_and_scan():
    values = jnp.array([[1.0, 3.0], [6.0, 6.0]])

    def step(normaliser: Normaliser, batch: jax.Array):
        return normaliser.update(batch, jnp.ones(2), 0.9), None

    scanned, _ = jax.jit(lambda: jax.lax.scan(step, Normaliser.fresh(), values))()
    assert_allclose(scanned, after([1.0, 3.0], [6.0]), rtol=1e-5)


def test_a_batch_without_weight_changes_nothing():
    for normaliser in (Normaliser.fresh(), after([1.0, 3.0])):
        assert_array_equal(normaliser.update(jnp.array([9.0]), jnp.zeros(1), 0.9), normaliser)


def test_features_have_moments_of_their_own():
    # Rows (1, 10), (3, 30) and, without weight, (99, 99): means 2 and 20, variances 1 and 100.
    rows = jnp.array([[[1.0, 10.0], [3.0, 30.0], [99.0, 99.0]]])
    weights = jnp.array([[1.0, 1.0, 0.0]])
    normaliser = Normaliser.fresh(2).update(rows, weights, 0.9)
    assert_allclose(normaliser.mean, [2, 20], rtol=1e-5)
    assert_allclose(normaliser.variance, [1, 100], rtol=1e-5)
    assert_allclose(normaliser.normalise(jnp.array([4.0, 0.0])), [2, -2], rtol=1e-4)
    assert_allclose(normaliser.restore(jnp.array([[2.0, -2.0]])), [[4, 0]], atol=1e-3)
