import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mabl.nets.attention import SelfAttention, TransformerEncoder, drop, positions


def everybody(n: int) -> jax.Array:
    """All of `n` agents are alive."""
    return jnp.ones(n, bool)


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
    out = identity(1)(jnp.eye(2), everybody(2))
    assert_allclose(out, [[0.669762, 0.330238], [0.330238, 0.669762]], rtol=1e-5)


def test_two_heads_by_hand():
    # Head 0 sees only column 0, the scalars 1 and 0, unscaled: row 0 attends to itself with
    # e / (e + 1) = 0.731059 and row 1, whose scores are 0, with 1/2. Head 1 is its mirror image.
    out = identity(2)(jnp.eye(2), everybody(2))
    assert_allclose(out, [[0.731059, 0.5], [0.5, 0.731059]], rtol=1e-5)


def test_attention_among_the_living_by_hand():
    # Rows (1, 0), (0, 1) and (1, 1), the second of a dead agent. Scores are products over sqrt(2).
    # Row 0 sees itself and row 2, both with score 0.707107: half of each, (1, 0.5).
    # Row 2 sees row 0 with 0.707107 and itself with 1.414214, not row 1:
    # 1 / (1 + e^0.707107) = 1 / 3.028115 = 0.330238 of row 0, the rest of itself: (1, 0.669762).
    # Row 1 itself sees row 0 with 0, itself and row 2 with 0.707107: 1 : 2.028115 : 2.028115 of
    # 5.056230, which is 0.197776, 0.401112 and 0.401112: (0.598888, 0.802224).
    x, alive = jnp.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]), jnp.array([True, False, True])
    out = identity(1)(x, alive)
    assert_allclose(out, [[1, 0.5], [0.598888, 0.802224], [1, 0.669762]], rtol=1e-5)
    # Were it alive, row 0 would see it with score 0: the mirror image of row 1.
    assert_allclose(identity(1)(x, everybody(3))[0], [0.802224, 0.598888], rtol=1e-5)


@pytest.mark.parametrize("n_heads", [1, 2, 4])
def test_permuting_agents_permutes_the_output(n_heads):
    attention = SelfAttention(8, n_heads, jax.random.key(0))
    x = jax.random.normal(jax.random.key(1), (5, 8))
    order = jnp.array([3, 0, 4, 1, 2])
    out = attention(x, everybody(5))
    assert_allclose(attention(x[order], everybody(5)), out[order], rtol=1e-5, atol=1e-6)
    assert not np.allclose(out[order], out)  # the order does show
    alive = jnp.array([True, True, False, True, False])
    out = attention(x, alive)
    assert_allclose(attention(x[order], alive[order]), out[order], rtol=1e-5, atol=1e-6)


def test_every_agent_attends_to_every_other():
    attention = SelfAttention(4, 2, jax.random.key(0))
    x = jax.random.normal(jax.random.key(1), (3, 4))
    influence = jax.jacobian(attention)(x, everybody(3))
    assert (np.abs(influence).sum((1, 3)) > 0).all()


@pytest.mark.parametrize(
    ("alive", "heard"),
    # heard[i][j]: agent i's output depends on agent j's features.
    [
        ([True, False, True], [[1, 0, 1], [1, 1, 1], [1, 0, 1]]),
        ([False, False, True], [[1, 0, 1], [0, 1, 1], [0, 0, 1]]),
        ([False, False, False], [[1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    ],
)
def test_the_dead_are_heard_by_nobody_but_themselves(alive, heard):
    attention = SelfAttention(4, 2, jax.random.key(0))
    x = jax.random.normal(jax.random.key(1), (3, 4))
    influence = jax.jacobian(attention)(x, jnp.array(alive))
    assert_array_equal(np.abs(influence).sum((1, 3)) > 0, np.array(heard, bool))


def test_what_a_dead_agent_shows_changes_its_own_output_alone():
    attention = SelfAttention(8, 2, jax.random.key(0))
    x = jax.random.normal(jax.random.key(1), (4, 8))
    alive = jnp.array([True, False, True, True])
    before, after = attention(x, alive), attention(x.at[1].add(9.0), alive)
    others = np.array([0, 2, 3])
    assert_array_equal(before[others], after[others])
    assert not np.allclose(before[1], after[1])
    # It is as if it were not there ...
    assert_allclose(before[others], attention(x[others], everybody(3)), rtol=1e-5, atol=1e-6)
    # ... unless it lives.
    living = attention(x.at[1].add(9.0), everybody(4))
    for i in others:
        assert not np.allclose(living[i], after[i])


@pytest.mark.parametrize("n_heads", [1, 2])
def test_where_all_are_dead_everyone_sees_only_itself(n_heads):
    # The weight of oneself is 1 whatever the scores: with identities, the input comes out again.
    x = jnp.array([[1.0, 0.0], [0.0, 1.0], [-3.0, 2.0]])
    assert_array_equal(identity(n_heads)(x, jnp.zeros(3, bool)), x)
    # Gradients do not meet the -inf of the masked scores either.
    attention = SelfAttention(2, n_heads, jax.random.key(0))
    gradient = jax.grad(lambda a, x: a(x, jnp.zeros(3, bool)).sum(), argnums=(0, 1))(attention, x)
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(gradient))


def test_attention_drops_weights_only_with_a_key():
    attention = SelfAttention(8, 2, jax.random.key(0))
    x, alive = jax.random.normal(jax.random.key(1), (4, 8)), everybody(4)
    plain = attention(x, alive)
    assert_array_equal(attention(x, alive, 0.5), plain)
    assert_array_equal(attention(x, alive, 0.0, jax.random.key(2)), plain)
    assert not np.allclose(attention(x, alive, 0.5, jax.random.key(2)), plain)


# --- dropout and positions --------------------------------------------------------------------


def test_dropout_keeps_the_expectation_and_zeros_about_its_share():
    x = jnp.full((200, 200), 3.0)
    dropped = np.asarray(drop(x, 0.25, jax.random.key(0)))
    # What is kept is scaled by 1 / (1 - 0.25): each entry is 0 or 4.
    assert_array_equal(np.unique(dropped), [0, 4])
    # Five standard errors of 40,000 draws: 5 sqrt(0.25 0.75 / 40,000) = 0.011, four times that
    # for the mean.
    assert_allclose((dropped == 0).mean(), 0.25, atol=0.011)
    assert_allclose(dropped.mean(), 3.0, atol=0.044)
    assert (dropped != np.asarray(drop(x, 0.25, jax.random.key(1)))).any()


def test_nothing_is_dropped_without_a_key_or_at_rate_zero():
    x = jnp.arange(6.0)
    assert_array_equal(drop(x, 0.5, None), x)
    assert_array_equal(drop(x, 0.0, jax.random.key(0)), x)


def test_positions_by_hand():
    # Width 4: angles index / 10000^(0/4) = index for the first sin and cos, and
    # index / 10000^(2/4) = index / 100 for the second. Agent 0: sin 0 = 0, cos 0 = 1.
    # Agent 1: sin 1 = 0.841471, cos 1 = 0.540302, sin 0.01 = 0.00999983, cos 0.01 = 0.99995.
    assert_allclose(
        positions(2, 4),
        [[0, 1, 0, 1], [0.841471, 0.540302, 0.00999983, 0.99995]],
        rtol=1e-5,
    )


# --- the transformer --------------------------------------------------------------------------


def transformer(n_layers: int = 2, dropout: float = 0.5) -> TransformerEncoder:
    """Of width 8, with two heads."""
    return TransformerEncoder(8, n_layers, 2, dropout, jax.random.key(0))


def test_a_transformer_of_no_layers_adds_the_positions():
    x = jax.random.normal(jax.random.key(1), (3, 8))
    assert_allclose(transformer(0)(x, everybody(3)), x + positions(3, 8), rtol=1e-6)


def test_a_layer_with_silent_weights_normalises_twice():
    # With attention and hidden layer silenced, (3, 1, 3, 1) + positions (0, 1, 0, 1) = (3, 2, 3, 2)
    # becomes (1, -1, 1, -1) under LayerNorm: mean 2.5, deviations 0.5, and the same again.
    encoder = TransformerEncoder(4, 1, 2, 0.0, jax.random.key(0))
    encoder = eqx.tree_at(
        lambda e: [e.layers[0].attention.out.weight, e.layers[0].out.weight],
        encoder,
        [jnp.zeros((4, 4))] * 2,
    )
    out = encoder(jnp.array([[3.0, 1.0, 3.0, 1.0]]), everybody(1))
    assert_allclose(out, [[1, -1, 1, -1]], rtol=1e-4)  # LayerNorm's epsilon is 1e-5


def test_the_dead_are_left_out_through_all_layers():
    encoder = transformer(n_layers=3)
    x = jax.random.normal(jax.random.key(1), (4, 8))
    alive = jnp.array([True, False, True, False])
    influence = np.abs(jax.jacobian(encoder)(x, alive)).sum((1, 3)) > 0
    # A dead agent's own row goes on hearing the living and itself; no other hears it.
    assert_array_equal(influence, [[1, 0, 1, 0], [1, 1, 1, 0], [1, 0, 1, 0], [1, 0, 1, 1]])
    before, after = encoder(x, alive), encoder(x.at[1].add(9.0 * jnp.arange(8.0)), alive)
    others = np.array([0, 2, 3])
    assert_array_equal(before[others], after[others])
    assert not np.allclose(before[1], after[1])
    assert np.isfinite(encoder(x, jnp.zeros(4, bool))).all()


def test_a_transformer_is_deterministic_without_a_key_and_drops_with_one():
    encoder, x = transformer(), jax.random.normal(jax.random.key(1), (3, 8))
    plain = encoder(x, everybody(3))
    assert_array_equal(encoder(x, everybody(3)), plain)
    assert_array_equal(transformer(dropout=0.0)(x, everybody(3)), plain)
    assert_array_equal(transformer(dropout=0.0)(x, everybody(3), jax.random.key(2)), plain)
    one, other = (encoder(x, everybody(3), jax.random.key(seed)) for seed in (2, 3))
    assert not np.allclose(one, plain)
    assert not np.allclose(one, other)
    assert_array_equal(encoder(x, everybody(3), jax.random.key(2)), one)


def test_a_transformers_agents_are_told_apart_by_their_index():
    encoder = transformer()
    x = jax.random.normal(jax.random.key(1), (4, 8))
    order = jnp.array([3, 0, 1, 2])
    out, permuted = encoder(x, everybody(4)), encoder(x[order], everybody(4))
    assert not np.allclose(permuted, out[order], atol=0.01)
    # Position is all that tells: with each one's own moved along, permuting does permute.
    moved = x[order] + positions(4, 8)[order] - positions(4, 8)
    assert_allclose(encoder(moved, everybody(4)), out[order], rtol=1e-4, atol=1e-5)
    # Agents that show the same come out different.
    same = encoder(jnp.broadcast_to(x[:1], (4, 8)), everybody(4))
    assert not np.allclose(same[0], same[1], atol=0.01)
