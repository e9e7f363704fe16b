import jax
import jax.numpy as jnp
import pytest
from jax.test_util import check_grads
from numpy.testing import assert_allclose, assert_array_equal

from mabl.losses.kl import balanced_kl, categorical_kl

# KL([1/2, 1/2] || [1/4, 3/4]) = 1/2 ln 2 + 1/2 ln 2/3 = 1/2 ln 4/3 = 0.143841
# KL([9/10, 1/10] || [1/2, 1/2]) = ln 2 - 0.325083 (the entropy of a coin of 9/10) = 0.368064
POSTERIOR = jnp.log(jnp.array([[0.5, 0.5], [0.9, 0.1]]))
PRIOR = jnp.log(jnp.array([[0.25, 0.75], [0.5, 0.5]]))


def test_kl_of_each_categorical_is_posterior_against_prior():
    assert_allclose(categorical_kl(POSTERIOR, PRIOR), [0.143841, 0.368064], rtol=1e-5)


def test_kl_is_not_symmetric_and_keeps_leading_axes():
    # KL([1/4, 3/4] || [1/2, 1/2]) = 1/4 ln 1/2 + 3/4 ln 3/2 = 0.130812
    # KL([1/2, 1/2] || [9/10, 1/10]) = 1/2 ln 5/9 + 1/2 ln 5 = 0.510826
    kl = categorical_kl(PRIOR[None, None], POSTERIOR[None, None])
    assert_allclose(kl, [[[0.130812, 0.510826]]], rtol=1e-5)


def test_kl_does_not_depend_on_how_logits_are_shifted():
    assert_allclose(
        categorical_kl(POSTERIOR + 7.0, PRIOR - 3.0), categorical_kl(POSTERIOR, PRIOR), rtol=1e-4
    )


def test_kl_of_equals_is_zero():
    assert_array_equal(categorical_kl(PRIOR, PRIOR), [0.0, 0.0])


@pytest.mark.parametrize(
    ("reduction", "expected"),
    [
        ("mean", 0.255952),  # (0.143841 + 0.368064) / 2
        ("sum", 0.511905),
    ],
)
def test_balanced_kl_is_the_kl_when_weights_add_up_to_one(reduction, expected):
    assert_allclose(balanced_kl(POSTERIOR, PRIOR, 0.8, 0.2, reduction), expected, rtol=1e-5)


def test_balanced_kl_adds_both_weights():
    # (0.5 + 0.25) * 0.511905
    assert_allclose(balanced_kl(POSTERIOR, PRIOR, 0.5, 0.25, "sum"), 0.383929, rtol=1e-5)


def test_balanced_kl_reduces_over_categoricals_only():
    assert balanced_kl(jnp.zeros((5, 4, 3, 2)), jnp.zeros((5, 4, 3, 2)), 0.8, 0.2).shape == (5, 4)


@pytest.mark.parametrize(
    ("free_nats", "expected"),
    [
        (0.5, 0.511905),  # the sum lies above: nothing is free
        (2.0, 2.0),  # 0.8 * 2 + 0.2 * 2
    ],
)
def test_free_nats_bound_the_reduced_kl_from_below(free_nats, expected):
    kl = balanced_kl(POSTERIOR, PRIOR, 0.8, 0.2, "sum", free_nats)
    assert_allclose(kl, expected, rtol=1e-5)


def gradients(prior_weight, posterior_weight, free_nats=0.0):
    """With respect to the logits of q = [1/2, 1/2] and of p = [1/4, 3/4]."""
    return jax.grad(balanced_kl, argnums=(0, 1))(
        POSTERIOR[:1], PRIOR[:1], prior_weight, posterior_weight, "sum", free_nats
    )


def test_gradients_of_the_two_parts_are_the_known_ones():
    posterior, prior = gradients(0.8, 0.2)
    # d KL / d logits of p = p - q = [-1/4, 1/4], times 0.8
    assert_allclose(prior, [[-0.2, 0.2]], rtol=1e-5)
    # d KL / d logits of q = q (ln q/p - KL) = 1/2 (ln 2 - 0.143841) = 0.274653, times 0.2
    assert_allclose(posterior, [[0.0549306, -0.0549306]], rtol=1e-5)


def test_prior_weight_trains_the_prior_alone():
    posterior, prior = gradients(0.8, 0.0)
    assert_array_equal(posterior, [[0.0, 0.0]])
    assert_allclose(prior, [[-0.2, 0.2]], rtol=1e-5)


def test_posterior_weight_trains_the_posterior_alone():
    posterior, prior = gradients(0.0, 0.2)
    assert_array_equal(prior, [[0.0, 0.0]])
    assert_allclose(posterior, [[0.0549306, -0.0549306]], rtol=1e-5)


def test_below_the_free_nats_nothing_is_trained():
    for gradient in gradients(0.8, 0.2, free_nats=1.0):
        assert_array_equal(gradient, [[0.0, 0.0]])


def by_definition(posterior, prior, prior_weight, posterior_weight, reduction, free_nats):
    """`balanced_kl` as it is written in the paper, its gradients left to JAX."""
    stop, reduce = jax.lax.stop_gradient, {"mean": jnp.mean, "sum": jnp.sum}[reduction]
    train_prior = reduce(categorical_kl(stop(posterior), prior), axis=-1)
    train_posterior = reduce(categorical_kl(posterior, stop(prior)), axis=-1)
    return prior_weight * jnp.maximum(train_prior, free_nats) + posterior_weight * jnp.maximum(
        train_posterior, free_nats
    )


@pytest.mark.parametrize("weights", [(0.8, 0.2), (0.5, 0.25), (1.0, 0.0), (0.0, 1.0)])
@pytest.mark.parametrize(
    ("reduction", "free_nats", "free"),
    [
        ("mean", 0.0, 0),
        ("sum", 0.0, 0),
        ("mean", 0.8, 14),  # of 20
        ("sum", 2.4, 14),
        ("mean", 100.0, 20),
        ("sum", 100.0, 20),
    ],
)
@pytest.mark.parametrize("way", ["leading axes", "vmaps"])
def test_balanced_kl_and_its_gradients_are_those_of_its_definition(
    weights, reduction, free_nats, free, way
):
    key_posterior, key_prior = jax.random.split(jax.random.key(0))
    posterior = jax.random.normal(key_posterior, (4, 5, 3, 4))
    prior = jax.random.normal(key_prior, (4, 5, 3, 4))
    row_weights = jnp.linspace(-1, 2, 20).reshape(4, 5)

    def computed(kl):
        def one(posterior, prior):
            return kl(posterior, prior, *weights, reduction, free_nats)

        each = jax.vmap(jax.vmap(one)) if way == "vmaps" else one
        gradients = jax.grad(lambda *x: (row_weights * each(*x)).sum(), argnums=(0, 1))
        return jax.jit(each)(posterior, prior), jax.jit(gradients)(posterior, prior)

    value, (to_posterior, to_prior) = computed(balanced_kl)
    expected, (to_posterior_expected, to_prior_expected) = computed(by_definition)
    assert jnp.isclose(expected, sum(weights) * free_nats, rtol=1e-6).sum() == free
    assert_allclose(value, expected, rtol=1e-5)
    assert_allclose(to_posterior, to_posterior_expected, rtol=1e-5, atol=1e-6)
    assert_allclose(to_prior, to_prior_expected, rtol=1e-5, atol=1e-6)


def test_balanced_kl_of_certain_categoricals_has_finite_gradients():
    posterior, prior = jnp.array([[200.0, 0.0, 0.0]]), jnp.array([[0.0, 200.0, 0.0]])
    to_posterior, to_prior = jax.grad(balanced_kl, (0, 1))(posterior, prior, 0.8, 0.2)
    assert_array_equal(to_posterior, [[0.0, 0.0, 0.0]])
    assert_allclose(to_prior, [[-0.8, 0.8, 0.0]], rtol=1e-5)


def test_one_prior_for_several_posteriors_is_trained_by_all():
    posteriors = jax.random.normal(jax.random.key(0), (5, 3, 4))
    prior = jax.random.normal(jax.random.key(1), (3, 4))

    def gradient(kl):
        each = jax.vmap(lambda q, p: kl(q, p, 0.8, 0.2, "sum", 0.0), (0, None))
        return jax.grad(lambda p: each(posteriors, p).sum())(prior)

    assert_allclose(gradient(balanced_kl), gradient(by_definition), rtol=1e-5, atol=1e-6)


def test_kl_gradient_agrees_with_finite_differences():
    def total(posterior, prior):
        return categorical_kl(jnp.asarray(posterior), jnp.asarray(prior)).sum()

    check_grads(total, (POSTERIOR, PRIOR), order=1, rtol=2e-2)
