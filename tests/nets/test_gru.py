import equinox as eqx
import jax
import jax.numpy as jnp
from numpy.testing import assert_allclose

from mabl.nets.gru import GRU


def test_a_gru_is_equinoxs():
    key = jax.random.key(0)
    gru, theirs = GRU(5, 4, key), eqx.nn.GRUCell(5, 4, key=key)
    x, h = jnp.arange(5.0) / 5, jnp.arange(4.0) - 2
    assert_allclose(gru(x, h), theirs(x, h), rtol=1e-6, atol=1e-6)

    def gradient(net):
        return jax.grad(lambda net: (net(x, h) ** 2).sum())(net)

    ours, expected = gradient(gru), gradient(theirs)
    assert_allclose(ours.weight_in, expected.weight_ih.T, rtol=1e-5, atol=1e-7)
    assert_allclose(ours.weight_hidden, expected.weight_hh.T, rtol=1e-5, atol=1e-7)
    assert_allclose(ours.bias, expected.bias, rtol=1e-5, atol=1e-7)
    assert_allclose(ours.bias_new, expected.bias_n, rtol=1e-5, atol=1e-7)
