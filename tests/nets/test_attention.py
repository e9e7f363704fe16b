import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mabl.nets.attention import SelfAttention


def identity(n_heads: int) -> SelfAttention:
    """Attention of width 2 whose four projections do nothing."""
    attention = SelfAttention(2, n_heads, jax.random.key(0))
    return eqx.tree_at(
        lambda a: [a.query.weight, a.key.weight, a.value.weight, a.out.weight],
        attention,
        [jnp.eye(2)] * 4,
    )


def test_one_head_by_hand():
    # Rows (1, 0) and (0, 1): scores 1/sqrt(2) with oneself, 0 with the other;
    # e^0.707107 / (e^0.707107 + 1) = 2.028115 / 3.028115 = 0.669762
    assert_allclose(
        identity(1)(jnp.eye(2)), [[0.669762, 0.330238], [0.330238, 0.669762]], rtol=1e-5
    )


def test_two_heads_by_hand():
    # Head 0 sees only column 0, the scalars 1 and 0, unscaled: row 0 attends to itself with
    # e / (e + 1) = 0.731059 and row 1, whose scores are 0, with 1/2. Head 1 is its mirror image.
    assert_allclose(identity(2)(jnp.eye(2)), [[0.731059, 0.5], [0.5, 0.731059]], rtol=1e-5)


@pytest.mark.parametrize("n_heads", [1, 2, 4])
def test_permuting_agents_permutes_the_output(n_heads):
    attention = SelfAttention(8, n_heads, jax.random.key(0))
    x = jax.random.normal(jax.random.key(1), (5, 8))
    order = jnp.array([3, 0, 4, 1, 2])
    out = attention(x)
    assert_allclose(attention(x[order]), out[order], rtol=1e-5, atol=1e-6)
    assert not np.allclose(out[order], out)  # the order does show


def test_every_agent_attends_to_every_other():
    attention = SelfAttention(4, 2, jax.random.key(0))
    influence = jax.jacobian(attention)(jax.random.normal(jax.random.key(1), (3, 4)))
    assert (np.abs(influence).sum((1, 3)) > 0).all()
