import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from mabl.nets.mlp import MLP, Linear


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
