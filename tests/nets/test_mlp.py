import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mabl.nets.categorical import Code, CodeShape, draw
from mabl.nets.mlp import MLP, Linear, activate, dense, parts_of, widths_of


def largest(layer: Linear) -> float:
    return float(np.abs(layer.weight).max())


def test_linear_starts_xavier_uniform_with_zero_bias():
    layer = Linear(30, 24, jax.random.key(0))  # sqrt(6 / 54) = 1/3
    assert 0.32 < largest(layer) <= 1 / 3
    assert abs(float(layer.weight.mean())) < 0.03
    assert_allclose(layer.weight.std(), 1 / 3 / 3**0.5, rtol=0.05)  # of a uniform distribution
    assert_array_equal(layer.bias, np.zeros(24))


def test_out_scale_shrinks_the_last_layer_alone():
    # sqrt(6 / 24) = 1/2, sqrt(6 / 24) = 1/2, and 0.01 sqrt(6 / 24) = 0.005
    mlp = MLP(12, 12, 12, 2, jax.random.key(0), out_scale=0.01)
    first, second, last = (largest(layer) for layer in mlp.layers)
    assert 0.45 < first <= 0.5
    assert 0.45 < second <= 0.5
    assert 0.0045 < last <= 0.005


def test_layers_start_different():
    mlp = MLP(4, 4, 4, 2, jax.random.key(0))
    assert not np.allclose(mlp.layers[0].weight, mlp.layers[1].weight)


def test_mlp_by_hand():
    mlp = MLP(2, 1, 2, 1, jax.random.key(0))
    weights = [jnp.array([[1.0, -1.0], [2.0, 0.5]]), jnp.array([[3.0], [5.0]])]
    biases = [jnp.array([0.5, 0.25]), jnp.array([-1.0])]
    mlp = eqx.tree_at(
        lambda m: [layer.weight for layer in m.layers] + [layer.bias for layer in m.layers],
        mlp,
        weights + biases,
    )
    # x = (1, 1): hidden (1 + 2 + 0.5, -1 + 0.5 + 0.25) = (3.5, -0.25) -> (3.5, 0); 3.5 * 3 - 1
    assert_allclose(mlp(jnp.array([1.0, 1.0])), [9.5])
    # x = (-1, -1): hidden (-2.5, 0.75) -> (0, 0.75); 0.75 * 5 - 1
    assert_allclose(mlp(jnp.array([-1.0, -1.0])), [2.75])
    # the output is not rectified: x = (-0.5, 0): hidden (0, 0.75)...; x = (0, -0.25): (0, 0.125)
    assert_allclose(mlp(jnp.array([0.0, -0.25])), [-0.375])


LATENT = CodeShape(3, 4)
PARTS = (LATENT, 2, LATENT, 5)
"""Of 31 entries."""


def some_parts(key: jax.Array) -> tuple:
    """Parts of these widths: codes drawn and vectors."""
    one, other, first, second = jax.random.split(key, 4)
    return (
        draw(jax.random.normal(one, LATENT), first),
        jax.random.normal(one, 2),
        draw(jax.random.normal(other, LATENT), second),
        jax.random.normal(other, 5),
    )


def stacked(blocks: tuple) -> np.ndarray:
    """Blocks of weights as one matrix, by hand."""
    return np.concatenate([np.asarray(block).reshape(-1, block.shape[-1]) for block in blocks])


@pytest.mark.parametrize("scale", [1.0, 0.01])
def test_a_layer_starts_from_the_same_weights_in_parts_or_in_one(scale):
    whole = Linear(31, 7, jax.random.key(0), scale)
    layer = Linear(PARTS, 7, jax.random.key(0), scale)
    assert [block.shape for block in layer.weight] == [(3, 4, 7), (2, 7), (3, 4, 7), (5, 7)]
    assert_array_equal(stacked(layer.weight), whole.weight)
    assert_array_equal(layer.bias, whole.bias)


@pytest.mark.parametrize("n_in", [12, (12,), LATENT, (LATENT,)])
def test_one_part_has_one_array_of_weights(n_in):
    layer = Linear(n_in, 7, jax.random.key(0))
    assert layer.weight.shape == ((12, 7) if n_in in (12, (12,)) else (3, 4, 7))
    assert_array_equal(layer.weight.reshape(12, 7), Linear(12, 7, jax.random.key(0)).weight)


@pytest.mark.parametrize("n_hidden", [0, 2])
def test_networks_start_from_the_same_weights_in_parts_or_in_one(n_hidden):
    whole = MLP(31, 7, 6, n_hidden, jax.random.key(0), out_scale=0.1)
    mlp = MLP(PARTS, 7, 6, n_hidden, jax.random.key(0), out_scale=0.1)
    assert_array_equal(stacked(mlp.layers[0].weight), whole.layers[0].weight)
    assert len(mlp.layers) == n_hidden + 1
    for layer, expected in zip(mlp.layers[1:], whole.layers[1:], strict=True):
        assert_array_equal(layer.weight, expected.weight)


def test_a_layer_of_parts_by_hand():
    layer = Linear((CodeShape(1, 2), 1), 2, jax.random.key(0))
    layer = eqx.tree_at(
        lambda x: (*x.weight, x.bias),
        layer,
        (jnp.array([[[1.0, 2], [3, 4]]]), jnp.array([[10.0, 20]]), jnp.array([0.5, 0.25])),
    )
    # class 1 and 2: 3 + 20 + 0.5, 4 + 40 + 0.25
    assert_allclose(layer(Code(jnp.array([1]), None, 2), jnp.array([2.0])), [23.5, 44.25])


@pytest.mark.parametrize("n_hidden", [None, 0, 2])
def test_parts_are_as_good_as_their_concatenation(n_hidden):
    def build(n_in) -> Linear | MLP:
        key = jax.random.key(0)
        return Linear(n_in, 7, key) if n_hidden is None else MLP(n_in, 7, 6, n_hidden, key)

    net, whole = build(PARTS), build(31)
    parts = some_parts(jax.random.key(1))
    assert_allclose(net(*parts), whole(dense(parts)), rtol=1e-5, atol=1e-6)
    batch = jax.vmap(some_parts)(jax.random.split(jax.random.key(2), 5))
    expected = jax.vmap(whole)(dense(batch))
    assert_allclose(jax.vmap(net)(*batch), expected, rtol=1e-5, atol=1e-6)


def test_gradients_of_parts_are_those_of_their_concatenation():
    keys = jax.random.split(jax.random.key(1), 5)

    def loss(net: MLP, vectors: jax.Array, whole: bool) -> jax.Array:
        def one(key: jax.Array, x: jax.Array) -> jax.Array:
            code, *_ = some_parts(key)
            parts = (draw(x[:12].reshape(3, 4), key), x[12:14], code, x[14:])
            return net(dense(parts)) if whole else net(*parts)

        return jnp.sin(jax.vmap(one)(keys, vectors)).sum()

    vectors = jax.random.normal(jax.random.key(2), (5, 19))
    gradient = eqx.filter_grad(lambda nets: loss(*nets, False))
    of_whole = eqx.filter_grad(lambda nets: loss(*nets, True))
    key = jax.random.key(0)
    mlp, to_vectors = gradient((MLP(PARTS, 7, 6, 1, key), vectors))
    expected, to_vectors_expected = of_whole((MLP(31, 7, 6, 1, key), vectors))
    close = {"rtol": 1e-5, "atol": 1e-6}
    assert jnp.abs(to_vectors_expected).max() > 0.01
    assert_allclose(to_vectors, to_vectors_expected, **close)
    assert_allclose(stacked(mlp.layers[0].weight), expected.layers[0].weight, **close)
    assert_allclose(mlp.layers[0].bias, expected.layers[0].bias, **close)
    assert_allclose(mlp.layers[1].weight, expected.layers[1].weight, **close)


def test_a_layer_refuses_more_or_fewer_parts_than_it_has_blocks():
    layer = Linear((3, 3), 7, jax.random.key(0))
    for n in (1, 3):
        with pytest.raises(ValueError, match="zip"):
            layer(*[jnp.zeros(3)] * n)


def test_widths_of_parts_build_a_layer_for_them():
    parts = some_parts(jax.random.key(1))
    assert widths_of(parts) == PARTS
    assert widths_of(parts[0]) == (LATENT,)
    assert widths_of(parts[1]) == (2,)
    batch = jax.vmap(some_parts)(jax.random.split(jax.random.key(2), 6))
    assert widths_of(batch) == PARTS
    assert Linear(widths_of(parts), 7, jax.random.key(0))(*parts).shape == (7,)


def test_features_are_parts_or_one_alone():
    x = jnp.ones(2)
    assert parts_of(x) == (x,)
    assert parts_of((x,)) == (x,)
    parts = some_parts(jax.random.key(0))
    assert parts_of(parts) is parts
    assert parts_of(parts[0]) == (parts[0],)


def test_parts_as_one_vector_by_hand():
    code, x = Code(jnp.array([[1, 0], [2, 2]]), None, 2), jnp.array([[0.5], [7.0]])
    assert_array_equal(dense((code, x)), [[0, 1, 1, 0, 0.5], [0, 0, 0, 0, 7]])
    assert_array_equal(dense((x, code)), [[0.5, 0, 1, 1, 0], [7, 0, 0, 0, 0]])
    assert_array_equal(dense(code), [[0, 1, 1, 0], [0, 0, 0, 0]])
    assert_array_equal(dense(x), x)


def test_hidden_layers_may_be_normalised_by_their_root_mean_square_and_pass_through_silu():
    # (3, -4, 0, 0): mean square 25 / 4, root 2.5; normalised (1.2, -1.6, 0, 0). SiLU of x is
    # x / (1 + exp(-x)): 1.2 / 1.301194 = 0.922230, -1.6 / 5.953032 = -0.268771.
    x = jnp.array([3.0, -4.0, 0.0, 0.0])
    assert_allclose(activate(x, "rms_silu"), [0.922230, -0.268771, 0, 0], rtol=1e-4)
    # The size of what comes in does not matter.
    assert_allclose(activate(100 * x, "rms_silu"), activate(x, "rms_silu"), rtol=1e-4)
    assert_allclose(activate(x, "relu"), [3, 0, 0, 0])
    assert_allclose(activate(jnp.zeros(4), "rms_silu"), jnp.zeros(4))


@pytest.mark.parametrize("activation", ["relu", "rms_silu"])
def test_an_mlp_activates_its_hidden_layers_and_an_embedding_its_output_too(activation):
    mlp = MLP(3, 4, 5, 2, jax.random.key(0), activation=activation)
    x = jnp.array([0.3, -1.0, 2.0])
    first, second, last = mlp.layers
    expected = last(activate(second(activate(first(x), activation)), activation))
    assert_allclose(mlp(x), expected, rtol=1e-6)
    assert_allclose(mlp.embed(x), activate(expected, activation), rtol=1e-6)
